"""`chordlab shapes reading`: a word as one shape or letter by letter: what is measured, and which takes fewer lines."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from lab.base.errors import RequestError
from lab.cli.choosing import ConfidenceOption, FontOption
from lab.cli.output import JsonFlag, QuietFlag, emit, lines_needed, progress_bar, say, show_table

if TYPE_CHECKING:
    from analysis.quadrature import Moments
    from analysis.reading import Measured


def show_reading(
    word: Annotated[str, typer.Argument(metavar="WORD", help="A word of capitals and digits.")],
    lines: Annotated[
        int, typer.Option("--lines", min=1, max=10**8, help="Crossing lines, all letters together.")
    ] = 300,
    confidence: ConfidenceOption = 0.95,
    sensor: Annotated[bool, typer.Option("--sensor", help="Through the default robot's sensor, not ideally.")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random lines.")] = 1,
    font: FontOption = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Read a word as one shape or letter by letter: compare.

    P and A with their errors, both ways; and from how many words on the letters take fewer lines.

    Example: chordlab shapes reading FREEDOM
    """
    import numpy as np

    from analysis.quadrature import exact_moments
    from analysis.reading import measured_both_ways
    from lab.recognise.reading import reading_strategies
    from lab.recognise.recognisers import sensor_model
    from lab.settings.settings import Settings
    from projector.dictionary import load_dictionary, shape_from
    from projector.text import TEXT_PREFIX

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
    rng = np.random.default_rng(seed)
    with progress_bar("shapes", quiet=quiet) as update:
        strategies = reading_strategies(word, rng, confidence=confidence, model=model, font=font, progress=update)
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
            (str(size), lines_needed(as_word), lines_needed(strategies.by_letters))
            for size, as_word in zip(strategies.sizes, strategies.as_word, strict=True)
        ],
    )
    if strategies.crossover is None:
        say("as one shape takes fewer lines in all of these dictionaries")
    else:
        say(f"letter by letter takes fewer lines from {strategies.crossover} words on")


def _row(measured: Measured) -> tuple[str, str, str, str]:
    return (
        measured.name,
        str(measured.lines),
        f"{measured.area_cm2:.1f} ± {measured.sigma_area_cm2:.1f}",
        f"{measured.perimeter_cm:.1f} ± {measured.sigma_perimeter_cm:.1f}",
    )
