"""A stored session, reviewed: its video tracked, its estimates held against ground truth, its report written."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from analysis.montecarlo import available_cores
from analysis.quadrature import exact_moments
from analysis.report.write import write_report
from lab.base.errors import RequestError
from lab.recognise.recognisers import Recognition, recognise_lines, recogniser_for
from lab.reopen.stored import stored_settings, stored_shape
from lab.review.budget import session_budget
from lab.review.filmed import Progress, review_film
from lab.review.findings import summarise, to_result
from lab.review.reviewed import Reviewed
from lab.review.runcheck import check_runs
from lab.review.simulated import check_against_simulation
from lab.session.experiment import dictionary_with
from lab.session.tally import stored_estimate
from lab.settings.settings import Settings
from lab.store.layout import REPORT
from lab.store.lock import writing
from lab.store.reader import SessionReader
from lab.store.tables import Tables, finalize, tables_of, write_table
from projector.collections import load_dictionary
from projector.shape import Shape

# A dictionary's moments are the same for all sessions of a batch.
_moments = lru_cache(maxsize=512)(exact_moments)


def examine(folder: Path, *, workers: int | None = None, progress: Progress | None = None) -> Reviewed:
    """Read a session, track its video where there is one, and compare robot, camera and truth.

    Nothing is written in the folder; `keep` does that. ``workers`` processes track the video; by default one for two
    cores, since decoding takes two by itself.
    """
    session = SessionReader(folder)
    settings, shape = stored_settings(session), stored_shape(session)
    rng = np.random.default_rng(settings.seed)
    tables = tables_of(session)
    dictionary = dictionary_with(shape, settings)
    recognition = _recognised(dictionary, settings, tables, shape.name)
    found = Reviewed(
        session=session,
        settings=settings,
        shape=shape,
        tables=tables,
        moments={name: _moments(entry.geometry) for name, entry in dictionary.items()},
        titles={name: entry.title for name, entry in dictionary.items()},
        recognition=recognition,
        robot=stored_estimate(tables.lines, tables.crossings),
        filmed=review_film(
            session, settings, shape.geometry, tables, rng, workers or max(1, available_cores() // 2), progress
        ),
        runs=check_runs(tables.lines, shape.geometry, settings, rng),
    )
    return replace(
        found,
        budget=session_budget(found, rng),
        montecarlo=check_against_simulation(tables, shape.geometry, settings, rng.spawn(1)[0]),
    )


def keep(found: Reviewed, out: Path | None = None) -> None:
    """Write the tables and the track of an examined session into its folder, or into ``out``.

    Raises RequestError: ``out`` cannot be written.
    """
    if out is not None:
        _keep_apart(found, out)
        return
    folder = found.session.folder
    with writing(folder):
        finalize(folder)
        if found.filmed is not None:
            write_table(folder, "track", found.filmed.track)


def _keep_apart(found: Reviewed, out: Path) -> None:
    tables = {name: getattr(found.tables, name) for name in Tables.__slots__}
    if found.filmed is not None:
        tables["track"] = found.filmed.track
    with _writable(out):
        for name, table in tables.items():
            write_table(out, name, table)


@contextmanager
def _writable(out: Path) -> Generator[None]:
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise RequestError(f"{out}: cannot be written ({error.strerror or error}); choose another --out") from error


def recognition_of(session: SessionReader, tables: Tables, collection: str | None = None) -> Recognition:
    """What a stored session's lines say; with a ``collection``, of that one's entries alone."""
    settings, shape = stored_settings(session), stored_shape(session)
    known = load_dictionary(collection, font=settings.font) if collection else dictionary_with(shape, settings)
    return _recognised(known, settings, tables, shape.name)


def _recognised(dictionary: dict[str, Shape], settings: Settings, tables: Tables, called: str) -> Recognition:
    return recognise_lines(recogniser_for(dictionary, settings, called=called), tables.crossed)


def review(
    folder: Path,
    *,
    report: bool,
    out: Path | None = None,
    host: Mapping[str, Any] | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Examine a session, keep its tables, write its report when asked, and give its figures (``report``: its path).

    With ``out`` all that is written goes there and the session is left as it is; it may be read-only.

    Raises RequestError: ``out`` cannot be written.
    """
    with writing(folder) if out is None else nullcontext():
        if out is not None:
            with _writable(out):  # told now and not after the film was tracked
                pass
        found = examine(folder, workers=workers, progress=progress)
        keep(found, out)
        result = to_result(found, host)
        written = write_report(result, (out or folder) / REPORT) if report else None
        return {**summarise(found, result), "report": written}
