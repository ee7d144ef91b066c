"""`chordlab export`: a stored session for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lab.cli.completing import sessions
from lab.cli.output import JsonFlag, QuietFlag, complain, emit, progress_bar, say


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A session folder.", autocompletion=sessions)],
    to: Annotated[str, typer.Option(help="Formats, with commas between: csv, mcap (Foxglove), mp4.")] = "csv,mcap,mp4",
    out: Annotated[Path | None, typer.Option(help="Where the files go; default ./NAME_export.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Which pictures of the film go into the mcap: every N-th.")] = 3,
    overlay: Annotated[bool, typer.Option("--overlay", help="Draw the track over the mp4.")] = False,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Write a session for other programs, and only read it.

    As CSV tables, as MCAP for Foxglove, and its film as one mp4.

    Example: chordlab export sessions/2026-11-23T1042_eiffel_ab12 --to csv,mcap
    """
    from lab.export.write import export_folder, export_session, kinds_of
    from lab.store.reader import SessionReader

    kinds = kinds_of(to)
    session = SessionReader(folder)
    done = export_session(
        session,
        export_folder(session, out),
        kinds,
        lambda label: progress_bar(label, quiet=quiet),
        every=every,
        overlay=overlay,
    )
    if as_json:
        emit(
            {
                "folder": folder,
                "out": done.out,
                "files": {path.name: path.stat().st_size for path in done.files},
                "messages": done.messages,
                "copied": done.copied,
                "left_out": done.remarks,
            }
        )
        return
    for path in done.files:
        say(f"{path}  {path.stat().st_size / 1e6:.1f} MB")
    for remark in () if quiet else done.remarks:
        complain(remark)
