"""Reading a word: letter by letter, or as one shape; and which of the two takes fewer lines.

Letter by letter (the local way) a robot stays on one letter until it is sure, and a list of words makes good what it
misread. The whole word (the global way) is one shape among as many as there are words. The first costs the same however
many words there are; the second grows with them: where they meet is the crossover.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.confusion import MOST_LINES, LineConfusion, PlaneConfusion, fewest_lines
from analysis.quadrature import Moments
from lab.base.errors import RequestError

Floats = NDArray[np.float64]

SLIP = 1e-3  # chance that a letter's record is spoilt and says nothing of the letter
STRANGE_WORD = 0.01  # prior probability that the word is in no list


@dataclass(frozen=True, slots=True)
class Reading:
    """What some letters spell.

    Attributes:
        text: the likeliest letter at each place, whatever the words.
        word: the likeliest word; None where "no word of the list" is likelier.
        probability: of ``word``, or of there being none.
        words: (word, probability) of the words of that length, the most probable first.
    """

    text: str
    word: str | None
    probability: float
    words: tuple[tuple[str, float], ...]


def read_word(
    letters: Sequence[Mapping[str, float]], words: Iterable[str], prior: Mapping[str, float] | None = None
) -> Reading:
    """Read a word from the posteriors of its letters.

    A word's likelihood is the product over its letters of posterior/prior, the prior having been even over the
    letters; with chance `SLIP` a letter's record says nothing. A word of no list, with `STRANGE_WORD` before any
    letter was seen, is any sequence of letters.

    Args:
        letters: for each place the probability of each letter.
        words: what may be written; those of another length do not count.
        prior: relative weight of each word, > 0; equal without it.

    Raises:
        RequestError: no letters, a place without any, or a word's weight that is not above 0.
    """
    if not letters or not all(letters):
        raise RequestError("every letter of the word needs a posterior; give one session for each letter")
    weights = {word: 1.0 if prior is None else prior.get(word, 0.0) for word in words}
    if not all(weight > 0 and math.isfinite(weight) for weight in weights.values()):
        raise RequestError("every word needs a prior weight above 0")
    text = "".join(max(place, key=lambda letter: place[letter]) for place in letters)
    fitting = {word: weight for word, weight in weights.items() if len(word) == len(letters)}
    if not fitting:
        return Reading(text, None, 1.0, ())
    total = sum(fitting.values())
    logs = np.array(
        [
            math.log((1 - STRANGE_WORD) * weight / total)
            + sum(
                math.log((1 - SLIP) * len(place) * place.get(letter, 0.0) + SLIP)
                for place, letter in zip(letters, word, strict=True)
            )
            for word, weight in fitting.items()
        ]
    )
    # A strange word: letters drawn evenly, so that each place's likelihood ratio averages to 1.
    high = max(float(logs.max()), math.log(STRANGE_WORD))
    shares = np.exp(logs - high)
    strange = math.exp(math.log(STRANGE_WORD) - high)
    shares, strange = shares / (shares.sum() + strange), strange / (shares.sum() + strange)
    ranked = sorted(zip(fitting, shares.tolist(), strict=True), key=lambda item: -item[1])
    word, probability = ranked[0]
    if strange > probability:
        return Reading(text, None, float(strange), tuple(ranked))
    return Reading(text, word, probability, tuple(ranked))


@dataclass(frozen=True, slots=True)
class Measured:
    """Area and perimeter as they would be measured: ``lines``, cm² and cm, standard errors."""

    name: str
    lines: int
    area_cm2: float
    sigma_area_cm2: float
    perimeter_cm: float
    sigma_perimeter_cm: float


def measured_both_ways(
    word: Moments, letters: Sequence[tuple[str, Moments]], lines: int, *, name: str
) -> tuple[Measured, list[Measured]]:
    """P and A of a word as one shape after ``lines`` lines, and of its letters, which share as many lines evenly.

    The standard errors are those of the exact moments, σ/√N.
    """
    if lines < len(letters):
        raise RequestError(f"{lines} lines are too few for {len(letters)} letters; give at least one for each")
    return _measured(name, word, lines), [_measured(letter, m, lines // len(letters)) for letter, m in letters]


def _measured(name: str, moments: Moments, lines: int) -> Measured:
    sigma = np.sqrt(np.diag(moments.covariance_at(lines)))
    return Measured(name, lines, moments.area_cm2, float(sigma[0]), moments.perimeter_cm, float(sigma[1]))


def lines_in_a_dictionary_of(
    confusion: PlaneConfusion | LineConfusion, entry: int, size: int, confidence: float = 0.95
) -> int | None:
    """Lines to recognise an entry among ``size`` entries of the kind of those at hand.

    The rivals at hand are a sample of those that a dictionary of another size would have: each of its size − 1 rivals
    errs as often as they do on average. None where no number of lines does.
    """
    rivals = int(np.count_nonzero(confusion.rivals[entry]))
    if size < 1 or not rivals:
        raise RequestError("a crossover needs a dictionary of at least two words")

    def error(n: float) -> float:
        return min(1.0, float(confusion.errors(entry, n).sum()) * (size - 1) / rivals)

    return fewest_lines(error, 1 - confidence, MOST_LINES)


@dataclass(frozen=True, slots=True)
class Strategies:
    """Lines for one word, both ways.

    Attributes:
        by_letters: lines, all letters together; None where a letter cannot be recognised.
        sizes: dictionary sizes in words.
        as_word: lines for the whole word in a dictionary of each size; None where no number does.
        crossover: the smallest of ``sizes`` from which on the letters take fewer lines; None where none.
    """

    by_letters: int | None
    sizes: tuple[int, ...]
    as_word: tuple[int | None, ...]
    crossover: int | None


def compare_strategies(
    letters: Sequence[int | None], whole: Callable[[int], int | None], sizes: Sequence[int]
) -> Strategies:
    """Compare the sum of the ``letters``' lines with ``whole(size)``, the word's in a dictionary of that size."""
    known = [lines for lines in letters if lines is not None]
    by_letters = sum(known) if len(known) == len(letters) else None
    as_word = tuple(whole(size) for size in sizes)
    crossover = None
    if by_letters is not None:
        slower = [size for size, lines in zip(sizes, as_word, strict=True) if lines is None or lines > by_letters]
        crossover = min(slower, default=None)
    return Strategies(by_letters, tuple(sizes), as_word, crossover)
