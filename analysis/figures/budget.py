"""The error budget as a waterfall: from the truth, cause by cause, to what the robot found."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.path import Path as MplPath

from analysis.budget import CAUSES, Budget, Side
from analysis.figures import pen
from analysis.figures.style import colour_of

_HALF = 0.32  # of a row
_NAMES = {"counting": "counting statistics", "rest": "unexplained", "speed": "speed scale"}


def name_of(term: str) -> str:
    """How a term is written for people."""
    return _NAMES.get(term, term)


def budget_figure(budget: Budget, *, name: str) -> Figure:
    """Draw the budgets of A and P side by side, a row for each term, in the order of the budget.

    A block begins where the one above it ended; the whisker on its end is the term's own standard error (of
    counting the size that chance makes expected). The last row is what the robot found.
    """
    rows = [term.term for term in budget.area.terms]
    figure = pen.new_figure(7.2, 0.9 + 0.33 * (len(rows) + 1))
    left = figure.add_subplot(1, 2, 1)
    right = figure.add_subplot(1, 2, 2)
    for axes, side, quantity in ((left, budget.area, "area A"), (right, budget.perimeter, "perimeter P")):
        pen.dress(axes, x=f"error of the {quantity} (%)")
        _waterfall(axes, side, colour_of(name))
    pen.name_rows(left, right, [*map(name_of, rows), "seen"])
    return figure


def _waterfall(axes: Axes, side: Side, colour: str) -> None:
    reached = 0.0
    edges = [0.0, side.seen_percent]
    for row, term in enumerate(side.terms):
        begin, reached = reached, reached + term.percent
        edges += [reached - term.sigma_percent, reached + term.sigma_percent]
        systematic = term.term in CAUSES
        _block(axes, row, begin, reached, colour if systematic else pen.MUTED, 0.75 if systematic else 0.4)
        ends = [reached - term.sigma_percent, reached + term.sigma_percent]
        pen.line(axes, ends, [row, row], pen.INK, width=1.1, above=3.0, gid=f"sigma {term.term}")
        pen.line(axes, [reached, reached], [row + _HALF, row + 1 - _HALF], pen.MUTED, width=0.7, above=1.5)
    _block(axes, len(side.terms), 0.0, side.seen_percent, pen.INK, 0.8)
    pen.upright(axes, 0.0, pen.MUTED, width=0.8, gid="truth")
    low, high = min(edges), max(edges)
    room = 0.06 * max(high - low, 0.1)
    axes.set_xlim(low - room, high + 5 * room)  # the figures stand to the right
    for row, percent in enumerate([*(term.percent for term in side.terms), side.seen_percent]):
        words = f"{percent:+.1f}".replace("-", "−").replace("+0.0", "0.0").replace("−0.0", "0.0")
        pen.text(axes, (1.0, row), words, side="right", frame="x axes, y data", halo=True)


def _block(axes: Axes, row: int, begin: float, end: float, colour: str, fill: float) -> None:
    low, high = sorted((begin, end))
    corners = [(low, row - _HALF), (high, row - _HALF), (high, row + _HALF), (low, row + _HALF), (low, row - _HALF)]
    pen.outline(axes, MplPath(corners, closed=True), colour, fill=fill, width=0.9, above=2.0)
