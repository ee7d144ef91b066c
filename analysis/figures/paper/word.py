# pyright: reportUnknownMemberType=false
"""Figs. 3E–H: one word read letter by letter and as one shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from analysis.figures import fields, pen
from analysis.figures.paper.known import Known
from analysis.figures.paper.panel import PaperPanel
from analysis.figures.paper.plane import GRID, Window, draw_domains, label_entries, window_of
from analysis.figures.style import colour_of
from analysis.montecarlo import Bands
from analysis.quadrature import Moments
from analysis.reading import Measured, Strategies, measured_both_ways

Floats = NDArray[np.float64]


_SHOWN_FROM = 100  # lines


@dataclass(frozen=True, slots=True, eq=False)
class Read:
    """A word, read both ways with the same number of lines in all.

    Attributes:
        word: "FREEDOM".
        whole: the word as one shape, cm.
        letters: its letters in order, each at the size that it has in the word.
        lines: in all; the letters share them evenly.
        whole_runs: simulated runs over the whole word, the last checkpoint being ``lines``.
        letter_runs: (letters, runs, 2) of (A cm², P cm) that simulated runs found of each letter with its share.
    """

    word: str
    whole: Moments
    letters: Sequence[Moments]
    lines: int
    whole_runs: Bands
    letter_runs: Floats

    def measured(self) -> tuple[Measured, list[Measured]]:
        """The word and its letters with their standard errors."""
        return measured_both_ways(
            self.whole, list(zip(self.word, self.letters, strict=True)), self.lines, name=self.word
        )


def letters_plane_panel(
    name: str, alphabet: Known, read: Read, spelt: Sequence[str], *, font: str, points: tuple[int, int] = GRID
) -> PaperPanel:
    """Draw the word's letters, as measured, among the alphabet (3E).

    ``alphabet`` is at the letters' own size, ``spelt`` its entry for each letter of the word.
    """
    share = read.lines // len(read.word)
    figure = pen.new_figure(7.2, 5.0)
    axes = figure.add_subplot(1, 1, 1)
    own = list(dict.fromkeys(spelt))
    window = window_of(alphabet, share, names=own, room=0.12, points=points)
    draw_domains(axes, alphabet, window, n=share, ellipses=own)
    rows: list[dict[str, object]] = []
    for place, (letter, entry) in enumerate(zip(read.word, spelt, strict=True)):
        area, perimeter = (float(value) for value in read.letter_runs[place, 0])
        pen.dots(axes, [perimeter], [area], colour_of(entry), edge=pen.INK, size=40, above=4, gid=f"measured {place}")
        posterior = alphabet.recogniser.posterior_at(area, perimeter, share)
        named = max(posterior, key=posterior.__getitem__)
        rows.append(
            {
                "place": place + 1,
                "letter": letter,
                "lines": share,
                "perimeter_cm": perimeter,
                "area_cm2": area,
                "named": alphabet.titles[named],
                "posterior": posterior[named],
            }
        )
    pen.dots(axes, [], [], pen.PAPER, edge=pen.INK, size=40, label=f"measured, {share} lines each")
    pen.line(axes, [], [], pen.INK, width=0.8, label="95 % of estimates")
    pen.legend_below(figure, axes, columns=2)
    label_entries(axes, alphabet, share, own)
    spelling = "".join(str(row["named"]) for row in rows)
    return PaperPanel(
        name,
        figure,
        f"{read.word} letter by letter ({font}, at the size that the letters have in the word): estimates of one "
        f"simulated "
        f"run of {share} lines a letter, among the domains of the 26 capitals. Read by the likeliest letter: "
        f"{spelling}.",
        {"": pd.DataFrame(rows)},
        {"read": spelling, "lines_per_letter": share},
    )


def whole_plane_panel(name: str, words: Known, read: Read, entry: str, *, points: tuple[int, int] = GRID) -> PaperPanel:
    """Draw the word, as measured, among the words (3F)."""
    figure = pen.new_figure(7.2, 5.0)
    axes = figure.add_subplot(1, 1, 1)
    bands, n = read.whole_runs, read.lines
    window = _around(words, entry, n, points)
    draw_domains(axes, words, window, n=n, ellipses=[entry])
    late = bands.n >= 0.01 * n
    perimeter, area = bands.perimeter_runs_cm[0], bands.area_runs_cm2[0]
    pen.line(axes, perimeter[late], area[late], pen.INK, width=1.0, above=3, gid="way")
    pen.dots(axes, perimeter[-1:], area[-1:], colour_of(entry), edge=pen.INK, size=46, above=4, gid="measured")
    pen.line(axes, [], [], pen.INK, width=1.0, label="one simulated run")
    pen.dots(axes, [], [], pen.PAPER, edge=pen.INK, size=40, label=f"after {n} lines")
    pen.legend_below(figure, axes, columns=2)
    shown = [
        key
        for key, m in words.moments.items()
        if window.perimeter_cm[0] < m.perimeter_cm < window.perimeter_cm[1]
        and window.area_cm2[0] < m.area_cm2 < window.area_cm2[1]
    ]
    label_entries(axes, words, n, [entry, *(key for key in shown if key != entry)])
    posterior = words.recogniser.posterior_at(float(area[-1]), float(perimeter[-1]), n)
    named = max(posterior, key=posterior.__getitem__)
    table = pd.DataFrame({"n": bands.n, "perimeter_cm": perimeter, "area_cm2": area})
    return PaperPanel(
        name,
        figure,
        f"{read.word} as one shape: the estimate of one simulated run among the words' domains after {n} lines. The "
        f"likeliest word at the end: {words.titles[named]} ({100 * posterior[named]:.1f} %).",
        {"": table},
        {"read": words.titles[named], "posterior": posterior[named]},
    )


def _around(words: Known, entry: str, n: int, points: tuple[int, int], sigmas: float = 9.0) -> Window:
    """The neighbourhood of an entry, in its own standard deviations."""
    m = words.moments[entry]
    area, perimeter = np.sqrt(np.diag(m.covariance_at(n)))
    return Window(
        (m.perimeter_cm - sigmas * perimeter, m.perimeter_cm + sigmas * perimeter),
        (m.area_cm2 - sigmas * area, m.area_cm2 + sigmas * area),
        points,
    )


def local_panel(name: str, read: Read) -> PaperPanel:
    """Draw A and P of the word as its letters add up, with their errors (3G)."""
    _, letters = read.measured()
    figure = pen.new_figure(7.2, 5.6)
    table = pd.DataFrame({"letter": list(read.word), "lines": [letter.lines for letter in letters]})
    colour, places = colour_of(read.word), np.arange(len(letters))
    for column, label, side in (("area", "A, added up (cm²)", 0), ("perimeter", "P, added up (cm)", 1)):
        unit = ("cm2", "cm")[side]
        truth = np.cumsum([_size(letter)[side] for letter in letters])
        sigma = np.sqrt(np.cumsum(np.square([_sigma(letter)[side] for letter in letters])))
        found = np.cumsum(read.letter_runs[:, 0, side])
        above, below = figure.add_subplot(2, 2, side + 1), figure.add_subplot(2, 2, side + 3)
        pen.dress(above, y=label)
        pen.line(above, places, truth, pen.INK, width=1.0, style="--", label="exact", gid="exact")
        pen.dots(above, places, found, colour, size=22, above=3, label="one simulated run", gid="run")
        above.set_ylim(0, 1.1 * float(max(truth.max(), found.max())))
        pen.dress(below, y=f"error of {'AP'[side]} (%)")
        pen.level(below, 0.0, pen.INK, width=1.0)
        fields.error_bars(below, places, 100 * (found / truth - 1), 100 * sigma / truth, colour, label="± σ, exact")
        for axes in (above, below):
            _name_letters(axes, read.word)
        table[f"{column}_sum_{unit}"] = found
        table[f"{column}_sum_exact_{unit}"] = truth
        table[f"sigma_{column}_sum_{unit}"] = sigma
    pen.legend_below(figure, figure.axes[0], columns=2)
    spread = _letters_spread(read)
    return PaperPanel(
        name,
        figure,
        f"Local strategy: area and perimeter of {read.word} as the letters are added up, {letters[0].lines} lines each "
        f"({read.lines} in all). The errors (bars, ± σ) add in squares: in the end {_percent(letters)} by the "
        "exact moments; over "
        f"{read.letter_runs.shape[1]} simulated runs {spread[0]:.2f} % of A and {spread[1]:.2f} % of P.",
        {"": table},
        {"sigma_percent_simulated": list(spread)},
    )


def global_panel(name: str, read: Read, strategies: Strategies | None) -> PaperPanel:
    """Draw A(N) and P(N) of the whole word with their errors, and the letters' end beside them (3H)."""
    whole, letters = read.measured()
    bands = read.whole_runs
    figure = pen.new_figure(7.2, 5.8)
    table = pd.DataFrame({"n": bands.n})
    colour, last_n = colour_of(read.word), read.lines
    for column, label, side in (("area_cm2", "A (cm²)", 0), ("perimeter_cm", "P (cm)", 1)):
        above, below = figure.add_subplot(2, 2, side + 1), figure.add_subplot(2, 2, side + 3)
        truth = _size(whole)[side]
        runs = bands.area_runs_cm2 if side == 0 else bands.perimeter_runs_cm
        sigma = np.sqrt(np.array([read.whole.covariance_at(int(n))[side, side] for n in bands.n]))
        error = float(np.sqrt(np.sum(np.square([_sigma(letter)[side] for letter in letters]))))
        pen.dress(above, y=label)
        pen.dress(below, x="lines N", y=f"σ of {'AP'[side]} (%)")
        for axes in (above, below):
            pen.count_axis(axes, 1.3 * last_n)
            axes.set_xlim(_SHOWN_FROM, 1.3 * last_n)
        pen.band(above, bands.n, truth - sigma, truth + sigma, colour, alpha=0.22, label="whole word, exact ± σ")
        pen.level(above, truth, pen.INK, width=1.0)
        pen.line(above, bands.n, runs[0], colour, width=1.8, above=3, label="whole word, one run", gid="run")
        late = bands.n >= _SHOWN_FROM
        reach = max(float(np.abs(runs[0] - truth)[late].max()), float(sigma[late].max()))
        above.set_ylim(max(0.0, truth - 1.1 * reach), truth + 1.1 * reach)
        below.set_yscale("log")
        fields.decades(below.yaxis)
        spread = runs.std(axis=0, ddof=1)
        of_letters = error * np.sqrt(last_n / bands.n)
        pen.line(below, bands.n, 100 * sigma / truth, colour, width=1.6, gid="whole")
        pen.dots(below, bands.n, 100 * spread / truth, colour, size=14, above=3, gid="whole, simulated")
        pen.line(below, bands.n, 100 * of_letters / truth, pen.INK, width=1.2, style="--", gid="letters")
        pen.dots(
            below,
            [last_n],
            [_letters_spread(read)[side]],
            pen.INK,
            marker="D",
            size=24,
            above=3,
            gid="letters, simulated",
        )
        table[column] = runs[0]
        table[f"sigma_{column}"] = sigma
        table[f"sigma_simulated_{column}"] = spread
        table[f"sigma_letter_by_letter_{column}"] = of_letters
    axes = figure.axes[0]
    pen.dots(axes, [], [], colour, size=14, label="whole word, simulated σ")
    pen.line(axes, [], [], pen.INK, width=1.2, style="--", label="letter by letter, exact σ")
    pen.dots(axes, [], [], pen.INK, marker="D", size=24, label="letter by letter, simulated σ")
    pen.legend_below(figure, axes, columns=3)
    last = bands.area_runs_cm2[:, -1], bands.perimeter_runs_cm[:, -1]
    spread = [100 * float(np.std(runs, ddof=1)) / size for runs, size in zip(last, _size(whole), strict=True)]
    return PaperPanel(
        name,
        figure,
        f"Global strategy: area and perimeter of {read.word} as one shape. After {read.lines} lines the errors are "
        f"{100 * whole.sigma_area_cm2 / whole.area_cm2:.2f} % of A and "
        f"{100 * whole.sigma_perimeter_cm / whole.perimeter_cm:.2f} % of P by the exact moments ({spread[0]:.2f} and "
        f"{spread[1]:.2f} % over {len(last[0])} simulated runs); letter by letter, with as many lines, "
        f"{_percent(letters)}.{_crossover(strategies)}",
        {"": table} | ({"strategies": _strategies_table(strategies)} if strategies else {}),
        {"sigma_percent_simulated": spread, "crossover_words": strategies.crossover if strategies else None},
    )


def _crossover(strategies: Strategies | None) -> str:
    if strategies is None:
        return ""
    sizes = "; ".join(
        f"{size} words: {'never' if lines is None else lines}"
        for size, lines in zip(strategies.sizes, strategies.as_word, strict=True)
    )
    ends = (
        "no number of words that was tried makes the letters cheaper"
        if strategies.crossover is None
        else f"from {strategies.crossover} words on the letters are cheaper"
    )
    return (
        f" To name it by (P, A) with 95 %, its letters take {strategies.by_letters} lines in all; the whole word "
        f"takes, in a "
        f"dictionary of {sizes} lines; {ends}."
    )


def _strategies_table(strategies: Strategies) -> pd.DataFrame:
    return pd.DataFrame(
        {"words": strategies.sizes, "lines_as_word": strategies.as_word, "lines_by_letters": strategies.by_letters}
    ).astype("Int64")


def _name_letters(axes: Axes, word: str) -> None:
    axes.set_xticks(range(len(word)), [word[0], *(f"+{letter}" for letter in word[1:])])
    axes.set_xlim(-0.5, len(word) - 0.5)


def _percent(letters: Sequence[Measured]) -> str:
    area, perimeter = (
        100 * float(np.sqrt(sum(_sigma(m)[side] ** 2 for m in letters)) / sum(_size(m)[side] for m in letters))
        for side in (0, 1)
    )
    return f"{area:.2f} % of A and {perimeter:.2f} % of P"


def _letters_spread(read: Read) -> tuple[float, float]:
    totals = read.letter_runs.sum(axis=0)
    area, perimeter = (100 * float(totals[:, side].std(ddof=1) / totals[:, side].mean()) for side in (0, 1))
    return area, perimeter


def _size(found: Measured) -> tuple[float, float]:
    return found.area_cm2, found.perimeter_cm


def _sigma(found: Measured) -> tuple[float, float]:
    return found.sigma_area_cm2, found.sigma_perimeter_cm
