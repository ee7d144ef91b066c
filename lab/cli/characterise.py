"""`chordlab robot characterise`: what no source states of a robot, measured on the floor at hand."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.cli.output import JsonFlag, QuietFlag, complain, emit, progress_bar, say, show_table

if TYPE_CHECKING:
    from robot.finding import Finding


def characterise(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The advertised name, such as SB-1234, or `virtual`.")],
    settings: Annotated[
        Path | None,
        typer.Option(metavar="SESSION.toml", help="The bench it is on: projector and camera; none: the robot alone."),
    ] = None,
    out: Annotated[Path, typer.Option(help="The profile to write or bring up to date.")] = Path("robot-profile.toml"),
    runs: Annotated[
        int | None, typer.Option(min=4, max=500, help="Long runs for scales and drift; 20 when not given.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the headings and phases that are tried.")] = 1,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Measure a robot, and write its profile. Speeds, latencies, scales and signs, in some five minutes.

    Put the robot in mid-arena, walls around it, and leave it there.

    Example: chordlab robot characterise virtual --out robot-profile.toml
    """
    from analysis.montecarlo import available_cores
    from lab.calibrate.characterise import RUNS, characterise_robot, settings_for
    from lab.calibrate.robot import profile_to_update
    from robot.profile import RobotProfile

    bench = settings_for(name, settings)
    # Now, since a file that cannot be written is better told before five minutes of rolling than after.
    profile, comments = profile_to_update(out, bench.profile() if bench is not None else RobotProfile())

    def hush(_text: str) -> None:
        return

    with progress_bar("tracking the runs", quiet=quiet) as update:
        found = characterise_robot(
            name,
            bench,
            profile,
            seed=seed,
            runs=runs or RUNS,
            workers=max(1, available_cores() // 2),
            say=hush if quiet or as_json else complain,
            progress=update,
        )
    found.save(out, comments)
    if as_json:
        emit(
            {
                "robot": found.robot,
                "profile": out,
                "robot_seconds": found.robot_s,
                "findings": [asdict(finding) for finding in found.findings],
            }
        )
        return
    if quiet:
        say(str(out))
        return
    rows = [(finding.key, *_figures(finding), str(finding.n)) for finding in found.findings]
    show_table(f"{found.robot}, measured in {found.robot_s:.0f} s", ("key", "value", "±", "n"), rows)
    for finding in found.findings:
        if finding.value is None:
            say(f"{finding.key}: {finding.comment}")
    say(str(out))


def _figures(finding: Finding) -> tuple[str, str]:
    """Value and error as a table shows them."""
    value, error = finding.value, finding.error
    if value is None:
        return "not measured", ""
    if isinstance(value, tuple):
        return ", ".join(value), ""
    text = f"{value:.5g}" if isinstance(value, float) else str(value)
    return text, "" if error is None else f"{error:.2g}"
