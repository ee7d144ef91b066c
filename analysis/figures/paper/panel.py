"""What a panel is, which there are, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from analysis.figures.style import save_figure
from lab.base.errors import RequestError

PANELS = {
    "1B": "Blinks over the Eiffel Tower as lines accumulate",
    "1C": "Blinks over the triangle",
    "1D": "Blinks over the Chichén Itzá pyramid",
    "1E": "Blinks over the Statue of Liberty",
    "1F": "Chord lengths of the Eiffel Tower",
    "1G": "The way to each shape in the plane of perimeter and area",
    "2A": "Chord lengths of the other shapes",
    "2B": "Area as lines accumulate",
    "2C": "Perimeter as lines accumulate",
    "2D": "Scatter of the area",
    "2E": "Scatter of the perimeter",
    "2F": "Scatter of one line against the shape's divergence from the circle",
    "2G": "Domains of 95 % likelihood after few lines",
    "2H": "Lines to 95 % across the plane",
    "2I": "Domains of 95 % likelihood after many lines",
    "2J": "Lines to 95 % where entries crowd, and for each entry",
    "3A": "The capitals in the plane",
    "3B": "Lines to 95 % for each letter",
    "3C": "The words of the Charter's preamble in the plane",
    "3D": "Lines to 95 % for each word, per letter",
    "3E": "FREEDOM letter by letter, in the plane",
    "3F": "FREEDOM as one shape, in the plane",
    "3G": "Area and perimeter of FREEDOM, letter by letter",
    "3H": "Area and perimeter of FREEDOM, as one shape",
}


@dataclass(frozen=True, slots=True, eq=False)
class PaperPanel:
    """One panel.

    Attributes:
        name: as in the paper, "1G".
        figure: the drawing.
        caption: what is shown, what to look for, and the figures found.
        tables: the data behind it, by what follows the panel's name in the file's; "" for the main table.
        found: the figures of the caption, by name.
    """

    name: str
    figure: Figure
    caption: str
    tables: Mapping[str, pd.DataFrame]
    found: Mapping[str, object]

    @property
    def title(self) -> str:
        """What it is about."""
        return PANELS[self.name]


def chosen_panels(only: str | None) -> list[str]:
    """The panels that ``only`` names, in the paper's order: "1G,2D", or "2" for all of Fig. 2; all without it.

    Raises RequestError, which lists the panels, for a name that is none.
    """
    if only is None:
        return list(PANELS)
    asked = [word.strip().upper().removeprefix("FIG").strip(" .") for word in only.split(",") if word.strip()]
    chosen: set[str] = set()
    for word in asked:
        meant = {name for name in PANELS if word in (name, name[0])}
        if not meant:
            raise RequestError(f"{word} is no panel of the paper; known are {', '.join(PANELS)}, or 1, 2, 3")
        chosen |= meant
    if not chosen:
        raise RequestError(f"name a panel after --only; known are {', '.join(PANELS)}, or 1, 2, 3")
    return [name for name in PANELS if name in chosen]


def write_panel(panel: PaperPanel, folder: Path) -> list[Path]:
    """Write PANEL.svg, PANEL.png and PANEL.csv (PANEL-entries.csv, …) into ``folder``. Raises OSError."""
    written = [save_figure(panel.figure, folder / f"{panel.name}.{kind}") for kind in ("svg", "png")]
    for part, table in panel.tables.items():
        path = folder / f"{panel.name}{'-' if part else ''}{part}.csv"
        table.to_csv(path, index=False, float_format="%.8g", lineterminator="\n", encoding="utf-8")
        written.append(path)
    return written
