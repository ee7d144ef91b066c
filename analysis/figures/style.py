# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# (matplotlib's stubs leave the **kwargs of savefig and the fonts' paths untyped)
"""The paper's colour code, and how a figure leaves the house.

Figures are made without pyplot and without touching matplotlib's global settings, so that a server, a batch worker
and a notebook may draw at the same time.
"""

from __future__ import annotations

import io
import re
import zlib
from functools import cache
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

# The paper's code (Fig. 2): pink circle, green pyramid, brown triangle, blue Statue of Liberty, orange tower. The
# shades keep a contrast of 3:1 on white and on the dark page, and differ in lightness for colour-blind readers.
_PAPER = (
    (("circle", "disc", "disk"), "#d0609c"),
    (("pyramid", "chichen"), "#009e73"),
    (("triangle",), "#a0622d"),
    (("liberty", "statue"), "#0b7bc1"),
    (("eiffel", "tower"), "#d97a00"),
    (("square",), "#808080"),
)
_OTHERS = ("#7a68c8", "#3a8f9c", "#b8604a", "#7d8a2e", "#a05fb0", "#4f7fb5", "#8a7350", "#c05a78")

AREA, PERIMETER = "#0b7bc1", "#d97a00"  # Okabe and Ito's pair: told apart by all eyes
MANY_DOTS = 400  # more are drawn as pixels


def colour_of(name: str) -> str:
    """Give an entry's colour "#rrggbb": the paper's for its shapes, else one that depends on the name alone."""
    lower = name.lower()
    for words, colour in _PAPER:
        if any(word in lower for word in words):
            return colour
    return _OTHERS[zlib.crc32(lower.encode()) % len(_OTHERS)]


def svg_text(figure: Figure, *, dpi: int = 150) -> str:
    """Render to an <svg> element that can stand inside an HTML page: no prolog, metadata, namespaces or URLs.

    Letters are paths, so that they look alike where no font is installed. ``dpi`` is for the artists that are drawn
    as pixels because there are too many of them.
    """
    target = io.StringIO()
    figure.savefig(target, format="svg", dpi=dpi, metadata={"Date": None, "Creator": None})
    text = target.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text).replace("xlink:href", "href")
    return _short(text).strip()


def _short(text: str) -> str:
    """Drop the comments and the digits that nobody can see: a figure is some 500 points wide."""
    text = re.sub(r"<!--.*?-->\n?", "", text, flags=re.DOTALL)
    attribute, digits = re.compile(r' (?:d|points|x|y)="[^"]*"'), re.compile(r"(-?\d+\.\d{2})\d+")
    return attribute.sub(lambda match: digits.sub(r"\1", match.group()), text)


def png_bytes(figure: Figure, *, dpi: int = 160) -> bytes:
    """Render to PNG on white."""
    target = io.BytesIO()
    figure.savefig(target, format="png", dpi=dpi, facecolor="white")
    return target.getvalue()


def save_figure(figure: Figure, path: Path, *, dpi: int = 200) -> Path:
    """Write a figure to ``path`` in the format of its suffix (.png, .svg, .pdf), on white."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi, facecolor="white")
    return path


def fitting(name: str, most: int) -> str:
    """A name that fits, without what the font lacks or matplotlib would take for mathematics."""
    known = _letters()
    name = "".join(letter if ord(letter) in known else "\ufffd" for letter in name)
    return (name if len(name) <= most else f"{name[: most - 1]}…").replace("$", r"\$")


@cache
def _letters() -> frozenset[int]:
    return frozenset(get_font(findfont(FontProperties())).get_charmap())
