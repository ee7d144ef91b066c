"""`chordlab doctor`: what this machine lacks, and the cure."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lab.cli.output import JsonFlag, emit, say, show_table
from lab.doctor import examine


def doctor(
    out: Annotated[Path, typer.Option(help="Where sessions would be stored.")] = Path("sessions"),
    as_json: JsonFlag = False,
) -> None:
    """Check Python, packages, fonts, Bluetooth, camera, display, disk and clock. Exit 1 when a session cannot run.

    Example: chordlab doctor
    """
    findings = examine(out)
    broken = [finding for finding in findings if finding.state == "broken"]
    if as_json:
        emit({"ok": not broken, "findings": [asdict(finding) for finding in findings]})
    else:
        rows = [(f.check, f.state, f.found, f.cure) for f in findings]
        show_table("This machine", ("check", "state", "found", "cure"), rows)
        missing = sum(finding.state == "missing" for finding in findings)
        say(
            f"A session cannot run here: {len(broken)} broken."
            if broken
            else f"The virtual bench runs here; for the real one {missing} things are missing."
            if missing
            else "All is here, for the virtual bench and the real one."
        )
    if broken:
        raise typer.Exit(1)
