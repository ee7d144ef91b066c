"""`chordlab calibrate camera` and `chordlab calibrate projector`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.completing import settings_files
from lab.cli.output import JsonFlag, QuietFlag, complain, emit, say, show_table

if TYPE_CHECKING:
    from lab.calibrate.stage import Operator, Step


SessionArgument = Annotated[
    Path | None,
    typer.Argument(metavar="[SESSION.toml]", help="The bench; none: the virtual.", autocompletion=settings_files),
]


def camera(
    session: SessionArgument = None,
    board: Annotated[Path | None, typer.Option(help="The PDF that the board was printed from; none: for A4.")] = None,
    make_board: Annotated[
        Path | None, typer.Option(metavar="PDF", help="Only write a board to print, and stop.")
    ] = None,
    paper: Annotated[str, typer.Option(help="Paper of --make-board: A4 or A3; the larger, the better.")] = "A4",
    ruler_cm: Annotated[
        float | None, typer.Option(min=5, max=20, help="What the printed ruler of 10 cm really measures.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=8, max=200, help="Views of the held board; 25 when not given.")
    ] = None,
    stored: Annotated[
        Path | None,
        typer.Option("--from", metavar="VIDEO|DIR", help="Views in a video or a folder of pictures, not live."),
    ] = None,
    origin_s: Annotated[
        float | None, typer.Option(min=0, help="When the board lies at the origin, in a video; none: at its end.")
    ] = None,
    out: Annotated[Path, typer.Option(help="The calibration to write.")] = Path("camera.json"),
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Find the camera's lens and pose, with a printed board.

    Example: chordlab calibrate camera --make-board board.pdf; chordlab calibrate camera bench.toml --out camera.json
    """
    from lab.calibrate.optics import VIEWS, calibrate_camera
    from lab.settings.load import load_settings
    from tracking.board import RULER_CM, Board, print_board, read_board
    from tracking.calibration import save_calibration

    if make_board is not None:
        made = print_board(make_board, paper)
        if as_json:
            emit({"board": make_board, "columns": made.columns, "rows": made.rows, "square_cm": made.square_cm})
        else:
            say(str(make_board))
        return
    printed = (read_board(board) if board is not None else Board()).scaled(
        1.0 if ruler_cm is None else ruler_cm / RULER_CM
    )
    if origin_s is not None and stored is None:
        raise RequestError("--origin-s is a time in a video; name it by --from")
    check_writable(out)
    settings = load_settings(session)
    done = calibrate_camera(
        settings,
        printed,
        person(),
        views=frames or VIEWS,
        source=stored,
        origin_s=origin_s,
        say=_teller(quiet or as_json),
    )
    save_calibration(done.calibration, out)
    summary = done.fit.summary()
    if as_json:
        emit({**summary, "out": out})
        return
    if quiet:
        say(str(out))
        return
    rows = [
        (name, f"{value['value']:.5g}", f"{value['std']:.2g}" if value["std"] else "held")
        for name, value in summary["lens"].items()
    ]
    position = zip("xyz", summary["position_cm"], summary["position_std_cm"], strict=True)
    rows += [(f"{axis} of the camera, cm", f"{value:.2f}", f"{std:.2g}") for axis, value, std in position]
    show_table("camera", ("", "value", "±"), rows)
    kept = [view for view in done.fit.views if view.kept]
    worst = max(kept, key=lambda view: view.rms_px)
    say(
        f"{len(kept)} of {len(done.fit.views)} views fit to {done.fit.rms_px:.3f} pixels "
        f"(worst: {worst.name}, {worst.rms_px:.3f})"
    )
    say(str(out))


def projector(
    session: SessionArgument = None,
    raised_cm: Annotated[
        float | None,
        typer.Option(min=1, max=100, help="Height of a flat sheet to lay down as a second plane; 10 cm is good."),
    ] = None,
    by_hand: Annotated[bool, typer.Option("--by-hand", help="Without a camera: measure five crosses by tape.")] = False,
    out: Annotated[Path, typer.Option(help="The calibration to write.")] = Path("projector.json"),
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Find the projector's pose and lens. By the calibrated camera, or with a tape.

    Example: chordlab calibrate projector bench.toml --raised-cm 10 --out projector.json
    """
    from lab.calibrate.optics import calibrate_by_hand, calibrate_projector
    from lab.settings.load import load_settings
    from tracking.calibration import Calibration, save_calibration

    if by_hand and raised_cm is not None:
        raise RequestError("--by-hand measures on the floor alone; leave --raised-cm out")
    check_writable(out)
    settings = load_settings(session)
    tell = _teller(quiet or as_json)
    if by_hand:
        done = calibrate_by_hand(settings, person(), say=tell)
    else:
        done = calibrate_projector(settings, person(), raised_cm=raised_cm, say=tell)
    # The same file as a camera's; its LED's height is the plane that the projector serves.
    save_calibration(Calibration(done.fit.optics, settings.sensor.height_cm), out)
    summary = done.summary()
    if as_json:
        emit({**summary, "out": out})
        return
    if quiet:
        say(str(out))
        return
    planes = " and ".join("the floor" if height == 0 else f"{height:g} cm above it" for height in done.fit.planes_cm)
    say(f"seen on {planes}: {done.fit.points} points fit to {10 * done.fit.rms_cm:.2f} mm")
    verified = summary["verified"]
    if verified is not None:
        say(
            f"verified with {verified['markers']} points not used in the fit: "
            f"{verified['rms_mm']:.2f} mm, at worst {verified['worst_mm']:.2f} mm"
        )
    say(f"in the sensor's plane, {settings.sensor.height_cm:g} cm up: ± {done.sensor_std_mm:.2f} mm by the fit")
    if done.assumed is not None:
        say(f"assumed: {done.assumed}; a sheet on --raised-cm measures it")
    say(str(out))


def person() -> Operator:
    """Somebody at the keyboard: told on stderr, answers on stdin."""
    from lab.calibrate.stage import Operator

    async def ask(step: Step) -> None:
        complain(f"{step} Then press Enter.")
        await asyncio.to_thread(_answer)

    async def measure(number: int) -> tuple[float, float]:
        complain(f"cross {number + 1}, x and y in cm:")
        words = (await asyncio.to_thread(_answer)).replace(",", " ").split()
        try:
            x_cm, y_cm = (float(word) for word in words)
        except ValueError as error:
            raise RequestError(
                f"cross {number + 1}: {' '.join(words)!r} is not two numbers of cm; write, for example, -52.3 31.0"
            ) from error
        return x_cm, y_cm

    return Operator(ask, measure)


def _answer() -> str:
    try:
        return input()
    except EOFError as error:
        raise RequestError(
            "nobody is at the keyboard to move the board; run it in a terminal, or with --from"
        ) from error


def check_writable(out: Path) -> None:
    """Before minutes of work: raise RequestError where ``out`` has no folder to go to."""
    if not out.parent.is_dir():
        raise RequestError(f"{out}: there is no folder {out.parent}; make it, or name another file")


def _teller(quiet: bool) -> Callable[[str], None]:
    def tell(text: str) -> None:
        if not quiet:
            complain(text)

    return tell
