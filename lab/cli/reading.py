"""`chordlab shapes reading`: a word as one shape or letter by letter: what is measured, and which takes fewer lines."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from analysis.confusion import measure_rates
from analysis.congruence import congruence_classes
from analysis.perline import learn_tables
from analysis.quadrature import Moments, exact_moments
from analysis.reading import Measured, Strategies, compare_strategies, lines_in_a_dictionary_of, measured_both_ways
from analysis.sensor import SensorModel
from lab.base.errors import RequestError
from lab.cli.choosing import FontOption
from lab.cli.output import JsonFlag, emit, progress_bar, say, show_table
from lab.recognisers import sensor_model
from lab.separability import separability
from lab.settings import Settings
from projector.dictionary import load_dictionary, shape_from
from projector.text import TEXT_PREFIX

_TABLE_LINES = 20_000
_SIZES = (2, 5, 10, 20, 50, 100, 200, 500, 1000, 10**4, 10**5, 10**6)


def show_reading(
    word: Annotated[str, typer.Argument(metavar="WORD", help="A word of capitals and digits.")],
    lines: Annotated[
        int, typer.Option("--lines", min=1, max=10**8, help="Crossing lines, all letters together.")
    ] = 300,
    confidence: Annotated[float, typer.Option("--confidence", help="Chance of being right that is asked for.")] = 0.95,
    sensor: Annotated[bool, typer.Option("--sensor", help="Through the default robot's sensor, not ideally.")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random lines.")] = 1,
    font: FontOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Compare two ways to read a word: as one shape, and letter by letter.

    P and A with their errors, both ways; and from how many words on the letters take fewer lines.

    Example: chordlab shapes reading FREEDOM
    """
    model = sensor_model(Settings()) if sensor else None
    known = load_dictionary("letters", font=font)
    unknown = sorted({letter for letter in word if TEXT_PREFIX + letter not in known})
    if unknown:
        raise RequestError(f"{word}: {', '.join(unknown)} is none of the letters; write capitals and digits")
    whole = exact_moments(shape_from(TEXT_PREFIX + word, font=font).geometry)
    own: dict[str, Moments] = {
        letter: exact_moments(known[TEXT_PREFIX + letter].geometry) for letter in dict.fromkeys(word)
    }
    measured = measured_both_ways(whole, [(letter, own[letter]) for letter in word], lines, name=word)
    strategies = _strategies(word, confidence, model, np.random.default_rng(seed), font, quiet=as_json)
    if as_json:
        emit(
            {
                "word": asdict(measured[0]),
                "letters": [asdict(letter) for letter in measured[1]],
                "strategies": asdict(strategies),
            }
        )
        return
    show_table(
        f"{word} after {lines} lines",
        ("shape", "lines", "A, cm²", "P, cm"),
        [_row(one) for one in (measured[0], *measured[1])],
    )
    show_table(
        f"Lines for {100 * confidence:g} % right",
        ("words to choose from", "as one shape", "letter by letter"),
        [
            (str(size), _count(as_word), _count(strategies.by_letters))
            for size, as_word in zip(strategies.sizes, strategies.as_word, strict=True)
        ],
    )
    if strategies.crossover is None:
        say("as one shape takes fewer lines in all of these dictionaries")
    else:
        say(f"letter by letter takes fewer lines from {strategies.crossover} words on")


def _strategies(
    word: str,
    confidence: float,
    model: SensorModel | None,
    rng: np.random.Generator,
    font: Path | None,
    *,
    quiet: bool,
) -> Strategies:
    """Lines for the word both ways: its letters among the letters, and itself among words like the Charter's."""
    letters, words = load_dictionary("letters", font=font), load_dictionary("words", font=font)
    words.setdefault(TEXT_PREFIX + word, shape_from(TEXT_PREFIX + word, font=font))
    outlines = {name: shape.geometry for name, shape in words.items()}
    twins = {name: members for members in congruence_classes(outlines) for name in members}
    rivals = np.array([[other not in twins[name] for other in outlines] for name in outlines])
    done = 0

    def step(_name: str = "") -> None:
        nonlocal done
        done += 1
        update(done, 1 + len(outlines))

    with progress_bar("shapes", quiet=quiet) as update:
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


def _row(measured: Measured) -> tuple[str, str, str, str]:
    return (
        measured.name,
        str(measured.lines),
        f"{measured.area_cm2:.1f} ± {measured.sigma_area_cm2:.1f}",
        f"{measured.perimeter_cm:.1f} ± {measured.sigma_perimeter_cm:.1f}",
    )


def _count(lines: int | None) -> str:
    return "never" if lines is None else str(lines)
