"""`chordlab recognize`: what stored sessions say: one a shape, or several the letters of a word."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.base.errors import RequestError
from lab.cli.completing import collections, sessions
from lab.cli.output import JsonFlag, QuietFlag, emit, say, show_table
from projector.catalogue import COLLECTIONS

if TYPE_CHECKING:
    from analysis.reading import Reading
    from lab.recognise.recognisers import Recognition


_MOST_WORDS = 5


def recognize(
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR...",
            help="A session folder; several: the letters of a word, in order.",
            autocompletion=sessions,
        ),
    ],
    dictionary: Annotated[
        str | None,
        typer.Option(help=f"Choose among another collection: {', '.join(COLLECTIONS)}.", autocompletion=collections),
    ] = None,
    word: Annotated[
        list[str] | None, typer.Option(metavar="WORD", help="A word that the letters may spell; none: the Charter's.")
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Rows to show, spread over the session.")] = 12,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """The posterior over the dictionary, as lines arrive. Of several sessions, the word that they spell.

    Example: chordlab recognize sessions/2026-11-23T1042_eiffel_ab12
    """
    from projector.collections import charter_words

    if dictionary is not None and dictionary not in COLLECTIONS:
        raise RequestError(f"{dictionary} is no collection of shapes; known are {', '.join(COLLECTIONS)}")
    if len(folders) > 1:
        read_letters(folders, word or charter_words(), dictionary or "letters", quiet=quiet, as_json=as_json)
    elif word:
        raise RequestError("--word is for several sessions, one for each letter; name them all")
    else:
        _show_shape(_recognised(folders[0], dictionary), steps, quiet=quiet, as_json=as_json)


def _recognised(folder: Path, dictionary: str | None) -> Recognition:
    from lab.review.review import recognition_of
    from lab.store.reader import SessionReader
    from lab.store.tables import tables_of

    session = SessionReader(folder)
    found = recognition_of(session, tables_of(session), dictionary)
    if found.posteriors.empty:
        raise RequestError(f"{folder}: no line crossed the shape, so there is nothing to recognise")
    return found


def _show_shape(found: Recognition, steps: int, *, quiet: bool, as_json: bool) -> None:
    import numpy as np

    posteriors, ranking = found.posteriors, found.ranking
    if as_json:
        columns: dict[str, Any] = {str(name): posteriors[name].to_numpy() for name in posteriors}
        emit(
            {
                "n": columns.pop("n"),
                "posterior": columns,
                "ranking": ranking,
                "unknown": found.unknown,
                "answer": found.answer,
                "classes": found.classes,
            }
        )
        return
    names = [name for name, _ in ranking[:6]]
    last = len(posteriors) - 1
    rows = [
        (
            str(int(posteriors["n"].iloc[row])),
            *(
                f"{sum(float(posteriors[own].iloc[row]) for own in (name, *found.twins_of(name))):.3f}"
                for name in names
            ),
            f"{found.unknown[row]:.3f}",
        )
        for row in np.unique([*range(0, last, max(1, last // steps)), last])
    ]
    if not quiet:
        show_table("posterior after n lines", ("n", *names, "none of these"), rows)
    leader, probability = ranking[0]
    if found.is_unknown:
        say(f"none of these: {found.unknown[-1]:.4f}; the nearest is {_named(found, leader)}")
    else:
        say(f"{_named(found, leader)}: {probability:.4f}")


def _named(found: Recognition, name: str) -> str:
    return " or ".join((name, *found.twins_of(name)))


def read_letters(
    folders: list[Path], words: list[str], dictionary: str = "letters", *, quiet: bool, as_json: bool
) -> None:
    """Read stored sessions, one for each letter, as a word of ``words``, and show it."""
    from analysis.reading import read_word

    found = [_recognised(folder, dictionary) for folder in folders]
    letters = [_letters(one) for one in found]
    for folder, known in zip(folders, letters, strict=True):
        if not known:
            raise RequestError(f"{folder}: that collection has no single letters; take --dictionary letters")
    reading = read_word(letters, words)
    lines = [int(one.posteriors["n"].iloc[-1]) for one in found]
    if as_json:
        emit(
            {
                "text": reading.text,
                "word": reading.word,
                "probability": reading.probability,
                "words": reading.words,
                "lines": lines,
                "folders": folders,
                "letters": [
                    {"posterior": known, "unknown": one.unknown[-1], "answer": one.answer}
                    for one, known in zip(found, letters, strict=True)
                ],
            }
        )
        return
    rows = [
        (str(place), _named(one, one.ranking[0][0]), f"{one.ranking[0][1]:.3f}", f"{one.unknown[-1]:.3f}", str(count))
        for place, (one, count) in enumerate(zip(found, lines, strict=True), start=1)
    ]
    if quiet:
        say(_conclusion(reading))
        return
    show_table("letters", ("", "letter", "posterior", "none of these", "lines"), rows)
    if reading.words:
        show_table("words", ("word", "probability"), [(w, f"{p:.4f}") for w, p in reading.words[:_MOST_WORDS]])
    say(_conclusion(reading))


def _conclusion(reading: Reading) -> str:
    if reading.word is None:
        return f"{reading.text}: none of the words"
    return f"{reading.word}: {reading.probability:.4f}"


def _letters(found: Recognition) -> dict[str, float]:
    """The last posterior of the entries that are single letters, by letter."""
    from projector.text import TEXT_PREFIX

    last = found.posteriors.iloc[-1]
    names = [name for name in map(str, last.index) if name.startswith(TEXT_PREFIX)]
    return {name.removeprefix(TEXT_PREFIX): float(last[name]) for name in names if len(name) == len(TEXT_PREFIX) + 1}
