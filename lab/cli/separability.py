"""`chordlab shapes separability`: what can be told apart, and in how many lines."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.cli.choosing import (
    CollectionOption,
    ConfidenceOption,
    FontOption,
    ShapeArguments,
    chosen_shapes,
    leaving,
    picture_path,
)
from lab.cli.output import JsonFlag, QuietFlag, emit, lines_needed, progress_bar, say, show_table
from projector.catalogue import PAPER

if TYPE_CHECKING:
    from lab.recognise.separability import PairProspects, Prospect, Separability
    from projector.dictionary import Shape


def show_separability(
    shapes: ShapeArguments = None,
    collection: CollectionOption = None,
    lines: Annotated[int, typer.Option("--lines", min=1, max=10**8, help="Crossing lines N.")] = 100,
    confidence: ConfidenceOption = 0.95,
    sensor: Annotated[bool, typer.Option("--sensor", help="Through the default robot's sensor, not ideally.")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random lines.")] = 1,
    font: FontOption = None,
    out: Annotated[Path | None, typer.Option("--out", help="Plot of the (P, A) plane, .svg, .png or .pdf.")] = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Say which entries are confusable after N lines. And how many lines each needs.

    Twice: by (P, A), as in the paper, and line by line, as a session recognises. Mirror twins are one class.

    Example: chordlab shapes separability --collection letters --lines 1000 --out letters.svg
    """
    import numpy as np

    from analysis.figures.separability import separability_figure
    from analysis.figures.style import save_figure
    from analysis.figures.values import Entry
    from lab.recognise.recognisers import sensor_model
    from lab.recognise.separability import separability
    from lab.settings.settings import Settings

    target = picture_path(out) if out else None
    chosen = chosen_shapes(shapes, collection or (None if shapes else PAPER), font)
    dictionary = {shape.name: shape for shape in chosen}
    with progress_bar("entries", quiet=quiet) as update:
        found = separability(
            dictionary,
            np.random.default_rng(seed),
            n=lines,
            confidence=confidence,
            model=sensor_model(Settings()) if sensor else None,
            progress=update,
        )
    if target is not None:
        entries = {name: Entry.of(_label(dictionary[name]), moments) for name, moments in found.moments.items()}
        apart = [entry.name for entry in found.entries if not entry.plane.confusable]
        with leaving(target):
            save_figure(separability_figure(entries, n=lines, level=confidence, apart=apart), target)
    if as_json:
        emit(
            {
                "lines": found.n,
                "confidence": found.confidence,
                "classes": found.classes,
                "entries": [asdict(entry) for entry in found.entries],
                "worst_pairs_by_plane": [asdict(pair) for pair in found.plane_pairs],
                "worst_pairs_by_line": [asdict(pair) for pair in found.line_pairs],
                "picture": target,
            }
        )
        return
    if target is None or not quiet:
        _show_separability(found)
    if target is not None:
        say(str(target))


def _label(shape: Shape) -> str:
    return shape.name.removeprefix("text:") if shape.font is not None else shape.title.partition(" (")[0]


def _show_separability(found: Separability) -> None:
    import numpy as np

    show_table(
        f"After {found.n} lines, and lines for {100 * found.confidence:g} % right",
        ("entry", "(P, A): right", "lines", "taken for", "by line: right", "lines", "taken for"),
        [
            (e.name, *_prospect_cells(e.plane), *_prospect_cells(e.line))
            for e in sorted(found.entries, key=lambda e: -np.inf if e.line.lines is None else -e.line.lines)
        ],
    )
    for title, pairs in (("Worst pairs by (P, A)", found.plane_pairs), ("Worst pairs by line", found.line_pairs)):
        show_table(
            title, ("pair", "(P, A): wrong", "lines", "by line: wrong", "lines"), [_pair_cells(p) for p in pairs]
        )
    for twins in found.classes:
        say(f"one class, as mirror or turned twins: {', '.join(twins)}")
    for kind, count in (
        ("by (P, A)", sum(bool(entry.plane.confusable) for entry in found.entries)),
        ("line by line", sum(bool(entry.line.confusable) for entry in found.entries)),
    ):
        say(f"{count} of {len(found.entries)} entries are confusable after {found.n} lines {kind}")


def _prospect_cells(prospect: Prospect) -> tuple[str, str, str]:
    return f"{100 * prospect.right:.1f} %", lines_needed(prospect.lines), prospect.rival or "-"


def _pair_cells(pair: PairProspects) -> tuple[str, ...]:
    return (
        " / ".join(pair.names),
        _percent(pair.plane_error),
        lines_needed(pair.plane_lines),
        _percent(pair.line_error),
        lines_needed(pair.line_lines),
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share > 1e-4 else "< 0.01 %"  # the models say nothing of such tails
