"""`chordlab recover`: a session's folder, mended after a cut."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.cli.completing import sessions
from lab.cli.output import JsonFlag, QuietFlag, emit, say, show_table

if TYPE_CHECKING:
    from lab.reopen.recover import Recovery


def recover(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A session folder.", autocompletion=sessions)],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what is to be done, and leave it.")] = False,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Mend a session's folder after a kill or a power cut. Nothing is deleted.

    Example: chordlab recover sessions/2026-11-23T1042_eiffel_ab12
    """
    from lab.reopen.recover import recover as mend
    from lab.store.writer import disk_faults

    with disk_faults(folder):
        found = mend(folder, dry_run=dry_run)
    if as_json:
        emit(_plain(found, dry_run=dry_run))
        return
    for what in found.done:
        say(f"{'to be done: ' if dry_run else ''}{what}")
    if not (found.done or quiet):
        say("nothing to mend")
    for what in found.changed:
        say(f"not as SHA256SUMS says: {what}")
    if found.state and not quiet:  # else the log cannot be looked at before the manifest is in its place
        show_table(f"{folder.name}: {found.state}", ("", ""), _rows(found))


def _rows(found: Recovery) -> list[tuple[str, str]]:
    rows = [
        ("runs lost", in_ranges(found.lost_lines) or "none known"),
        ("torn bytes", str(found.torn_bytes)),
        ("set aside", "\n".join(found.set_aside) or "nothing"),
        ("runs whole", str(found.runs)),
        ("lines across the shape", str(found.lines)),
    ]
    if found.estimate is not None:
        size = found.estimate
        rows.append(("A, cm²", f"{size.area_cm2:.1f} ± {size.sigma_area_cm2:.1f}"))
        rows.append(("P, cm", f"{size.perimeter_cm:.1f} ± {size.sigma_perimeter_cm:.1f}"))
    return rows


def in_ranges(numbers: Sequence[int]) -> str:
    """Ascending numbers, those in a row drawn together: ``3, 7-9``."""
    runs = itertools.groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0])
    groups = [[number for _, number in run] for _, run in runs]
    return ", ".join(str(group[0]) if len(group) == 1 else f"{group[0]}-{group[-1]}" for group in groups)


def _plain(found: Recovery, *, dry_run: bool) -> dict[str, Any]:
    from lab.reopen.recover import Recovery

    estimate = found.estimate
    figures = None if estimate is None else {
        "area_cm2": estimate.area_cm2,
        "sigma_area_cm2": estimate.sigma_area_cm2,
        "perimeter_cm": estimate.perimeter_cm,
        "sigma_perimeter_cm": estimate.sigma_perimeter_cm,
    }  # fmt: skip
    return {**{name: getattr(found, name) for name in Recovery.__slots__}, "estimate": figures, "dry_run": dry_run}
