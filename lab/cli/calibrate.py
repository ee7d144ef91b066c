"""`chordlab calibrate`: the bench's devices against each other."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.cli import calibrate_optics
from lab.cli.completing import sessions, settings_files
from lab.cli.output import JsonFlag, QuietFlag, complain, emit, progress_bar, say, show_table

if TYPE_CHECKING:
    from lab.calibrate.robot import Scales
    from robot.profile import RobotProfile


app = typer.Typer(help="Calibrate the bench's devices.", no_args_is_help=True)


app.command("camera")(calibrate_optics.camera)
app.command("projector")(calibrate_optics.projector)


@app.callback()
def calibrate() -> None:
    """Calibrate the bench's devices."""


@app.command("robot")
def robot(
    session: Annotated[
        Path | None,
        typer.Argument(metavar="[SESSION.toml]", help="The bench; none: the virtual.", autocompletion=settings_files),
    ] = None,
    runs: Annotated[int | None, typer.Option(help="How many runs to roll; 20 when not given.")] = None,
    stored: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="DIR", help="Take a stored, filmed session instead of rolling.", autocompletion=sessions
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="The profile to write or bring up to date.")] = Path("robot-profile.toml"),
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Find the robot's scales and drift by the camera. Of speed and odometer; they are put into its profile.

    Example: chordlab calibrate robot --runs 20 --out robot-profile.toml
    """
    from analysis.montecarlo import available_cores
    from lab.calibrate.robot import calibrate_robot, profile_to_update, scales_of_session
    from lab.settings.load import load_settings
    from robot.finding import applied, comments_of
    from robot.profile import save_profile

    if stored is not None and (session is not None or runs is not None):
        raise RequestError(
            "--from takes the bench and the runs of the stored session; leave SESSION.toml and --runs out"
        )
    workers = max(1, available_cores() // 2)
    settings = load_settings(session)
    profile, comments = profile_to_update(out, settings.profile())

    def tell(text: str) -> None:
        if not (quiet or as_json):
            complain(text)

    with progress_bar("tracking the runs", quiet=quiet) as update:
        if stored is not None:
            scales = scales_of_session(stored, workers=workers, progress=update)
        else:
            scales = calibrate_robot(settings, profile, runs or 20, workers=workers, say=tell, progress=update)
    findings = scales.findings()
    calibrated = applied(profile, findings)
    save_profile(calibrated, out, {**comments, **comments_of(findings)})
    effects = effects_of(profile, calibrated)
    if as_json:
        emit(
            {
                "runs": len(scales.runs),
                "cm_s_per_unit": asdict(scales.cm_s_per_unit),
                "locator_scale": asdict(scales.locator_scale),
                "drift_rad_per_cm": asdict(scales.drift_rad_per_cm),
                "effects": effects,
                "table": scales.runs.to_dict(orient="records"),
                "profile": out,
            }
        )
        return
    if not quiet:
        _show(scales, profile, effects)
    say(str(out))


def effects_of(before: RobotProfile, after: RobotProfile) -> dict[str, dict[str, float]]:
    """What new scales do to a session's figures, by where its chord lengths come from: A ∝ scale², P ∝ scale."""
    ratios = {
        "time": after.cm_s_per_unit / before.cm_s_per_unit,
        "odometry": after.locator_scale / before.locator_scale,
    }
    return {source: {"area": ratio**2, "perimeter": ratio} for source, ratio in ratios.items()}


def _show(scales: Scales, before: RobotProfile, effects: dict[str, dict[str, float]]) -> None:
    """The figures as a table, and what they do to A and P."""
    rows = [
        (key, f"{old:.5g}", f"{figure.value:.5g}", f"{figure.error:.2g}", f"{figure.scatter:.2g}", str(figure.n))
        for key, old, figure in (
            ("cm/s per unit", before.cm_s_per_unit, scales.cm_s_per_unit),
            ("true cm per odometer cm", before.locator_scale, scales.locator_scale),
            ("drift, rad/cm clockwise", before.drift_rad_per_cm, scales.drift_rad_per_cm),
        )
    ]
    show_table(f"{len(scales.runs)} runs", ("scale", "before", "now", "±", "from run to run", "n"), rows)
    for source, factor in effects.items():
        say(f"lengths by {source}: A × {factor['area']:.4f}, P × {factor['perimeter']:.4f}")
