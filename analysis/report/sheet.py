"""The report of many sessions as a single HTML file that needs nothing else, in the manner of a session's own."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pandas as pd

from analysis.report.sheetpanels import sheet_panels
from analysis.report.sheetrows import Rows
from analysis.report.sheettables import broken_table, provenance_table, sessions_table, shapes_table
from analysis.report.sheetverdict import sheet_verdict
from analysis.report.write import keep_page, page_of, shown


def write_sheet(sessions: pd.DataFrame, shapes: pd.DataFrame, path: Path) -> Path:
    """Write the report of a batch to ``path`` (.html) and return it; a reader never sees half a file.

    Args:
        sessions: One row a session, as docs/batch.md lists the columns; ``session`` and ``error`` must be there, and
            what else is missing or empty leaves its part of the report out, with the reason.
        shapes: One row a shape, likewise; only what simulation adds is read from it. May be empty.
        path: Where the file goes.

    Raises:
        SheetError: The table is none of a batch's.
        ReportFileError: The file cannot be written.
    """
    return keep_page(render_sheet(sessions, shapes), path)


def render_sheet(sessions: pd.DataFrame, shapes: pd.DataFrame) -> str:
    """Give the report of a batch as HTML text; the same tables give the same text. Raises SheetError."""
    rows = Rows.of(sessions, shapes)
    panels, left_out = sheet_panels(rows) if len(rows.whole) else ([], [])
    return page_of("sheet.html.j2").render(
        verdict=sheet_verdict(rows),
        panels=[shown(panel) for panel in panels],
        left_out=left_out,
        broken=broken_table(rows),
        shapes=shapes_table(rows),
        sessions=sessions_table(rows) if len(rows.every) else None,
        provenance=provenance_table(rows, _version()),
        exact=rows.exact,
    )


def _version() -> str:
    try:
        return version("chordlab")
    except PackageNotFoundError:
        return "unknown"
