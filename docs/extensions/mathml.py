"""Formulas as MathML, which browsers draw by themselves: no script, no network, and screen readers read it."""

from __future__ import annotations

import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

_VARIANTS = re.compile(r'<mi mathvariant="(script|bold)">([A-Za-z])</mi>')
_FIRST = {"script": (0x1D4D0, 0x1D4EA), "bold": (0x1D400, 0x1D41A)}  # of the alphabets' capitals and small letters


def mathml(formula: str, display: str) -> str:
    """A formula in LaTeX as MathML; browsers know letters by their characters, not by a variant of plain ones."""
    return _VARIANTS.sub(_lettered, convert(formula, display=display))


def _lettered(variant: re.Match[str]) -> str:
    kind, letter = variant.groups()
    capitals, smalls = _FIRST[kind]
    character = chr(capitals + ord(letter) - ord("A") if letter.isupper() else smalls + ord(letter) - ord("a"))
    return f'<mi mathvariant="normal">{character}</mi>'


def in_line(translator: HTML5Translator, node: nodes.math) -> None:
    """A formula in running text."""
    translator.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def displayed(translator: HTML5Translator, node: nodes.math_block) -> None:
    """A formula on lines of its own."""
    translator.body.append(f'<div class="math">{mathml(node.astext(), "block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Tell Sphinx."""
    app.add_html_math_renderer("mathml", (in_line, None), (displayed, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
