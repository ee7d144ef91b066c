"""How many lines a word takes, read as one shape or letter by letter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from analysis.confusion import measure_rates
from analysis.congruence import congruence_classes, rivals_of
from analysis.perline import learn_tables
from analysis.reading import Strategies, compare_strategies, lines_in_a_dictionary_of
from analysis.sensor import SensorModel
from lab.recognise.separability import separability
from projector.dictionary import load_dictionary, shape_from
from projector.text import TEXT_PREFIX

_TABLE_LINES = 20_000
_SIZES = (2, 5, 10, 20, 50, 100, 200, 500, 1000, 10**4, 10**5, 10**6)


def reading_strategies(
    word: str,
    rng: np.random.Generator,
    *,
    confidence: float,
    model: SensorModel | None,
    font: Path | None,
    progress: Callable[[int, int], None],
) -> Strategies:
    """Lines for the word both ways: its letters among the letters, and itself among words like the Charter's.

    Args:
        word: of capitals and digits.
        rng: source of the random lines.
        confidence: chance of being right that is asked for.
        model: the light sensor; None for ideal lines.
        font: of the letters; None for the system's.
        progress: told how many of the shapes are done.
    """
    letters, words = load_dictionary("letters", font=font), load_dictionary("words", font=font)
    words.setdefault(TEXT_PREFIX + word, shape_from(TEXT_PREFIX + word, font=font))
    outlines = {name: shape.geometry for name, shape in words.items()}
    rivals = rivals_of(congruence_classes(outlines), list(outlines))
    done = 0

    def step(_name: str = "") -> None:
        nonlocal done
        done += 1
        progress(done, 1 + len(outlines))

    # the word is only right if all its letters are
    each = confidence ** (1 / len(word))
    found = separability(letters, rng, confidence=each, model=model, table_lines=_TABLE_LINES)
    of_letter = {entry.name.removeprefix(TEXT_PREFIX): entry.line.lines for entry in found.entries}
    step()
    tables = learn_tables(outlines, rng, lines=_TABLE_LINES, model=model)
    confusion = measure_rates(outlines, tables, rivals, rng, lines=_TABLE_LINES, model=model, progress=step)
    row = list(outlines).index(TEXT_PREFIX + word)
    return compare_strategies(
        [of_letter[letter] for letter in word],
        lambda size: lines_in_a_dictionary_of(confusion, row, size, confidence),
        _SIZES,
    )
