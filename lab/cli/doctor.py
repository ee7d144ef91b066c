"""`chordlab doctor`: what this machine lacks, and the cure; and one archive of it for a bug report."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.completing import sessions
from lab.cli.output import JsonFlag, QuietFlag, emit, progress_bar, say, show_table

if TYPE_CHECKING:
    from lab.doctor.finding import Finding


def doctor(
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE.zip]", help="With --bundle: the archive's name.", show_default=False)
    ] = None,
    bundle: Annotated[
        bool, typer.Option("--bundle", help="Also write one archive for a bug report, without personal paths.")
    ] = False,
    session: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="With --bundle: put a session's manifest and log into it.", autocompletion=sessions
        ),
    ] = None,
    with_light: Annotated[
        bool, typer.Option("--with-light", help="With --bundle: the session's raw light samples too.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Where sessions would be stored.")] = Path("sessions"),
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Say what this machine lacks, and the cure. Exit code 1 where no virtual session can run.

    It looks at Python, packages, Bluetooth, cameras, displays, disk and clocks.

    Example: chordlab doctor --bundle report.zip --session sessions/2026-11-23T1042_eiffel_ab12
    """
    from lab.doctor.bundle import write_bundle
    from lab.doctor.examine import examine

    if not bundle and (file is not None or session is not None or with_light):
        raise RequestError("FILE.zip, --session and --with-light go with --bundle; add it")
    if with_light and session is None:
        raise RequestError("--with-light takes a session's samples; name it by --session DIR")
    with progress_bar("looking", quiet=quiet) as update:
        findings = examine(out, update)
    broken = [finding for finding in findings if finding.state == "broken"]
    archive = None
    if bundle:
        target = file or Path(f"chordlab-bundle-{datetime.now():%Y%m%dT%H%M%S}.zip")
        archive = write_bundle(target, findings, session=session, with_light=with_light)
    if as_json:
        emit({"ok": not broken, "findings": [asdict(finding) for finding in findings], "bundle": archive})
    else:
        if not quiet:
            show_table("This machine", ("check", "state", "found", "cure"), _rows(findings))
        say(_verdict(findings))
        if archive is not None:
            say(f"{archive}  {archive.stat().st_size / 1e3:.0f} kB; look through it before you send it")
    if broken:
        raise typer.Exit(1)


def _rows(findings: list[Finding]) -> list[tuple[str, str, str, str]]:
    """One row a check; the packages that are as they should be share one."""
    fine = [finding.check for finding in findings if finding.area == "package" and finding.state == "ok"]
    rows = [(f.check, f.state, f.found, f.cure) for f in findings if f.check not in fine]
    if fine:
        rows.insert(1, ("packages", "ok", f"{len(fine)} as required", ""))
    return rows


def _verdict(findings: list[Finding]) -> str:
    states = [finding.state for finding in findings]
    if "broken" in states:
        return f"A session cannot run here: {states.count('broken')} broken."
    if "missing" in states:
        return f"The virtual bench runs here; for the real one {states.count('missing')} things are missing."
    return "All is here, for the virtual bench and the real one."
