"""What can be told apart, and in how many lines: a dictionary against itself, before anything is rolled.

Two recognisers are judged. ``plane`` is the paper's: the normal likelihood of (P, A). ``line`` is the session's:
the likelihood of each single line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from analysis.confusion import MOST_LINES, LineConfusion, PlaneConfusion, fewest_lines, measure_rates
from analysis.congruence import congruence_classes, rivals_of
from analysis.perline import learn_tables
from analysis.quadrature import Moments, exact_moments
from analysis.sensor import SensorModel
from lab.base.errors import RequestError
from projector.shape import Shape

Progress = Callable[[int, int], None]

TABLE_LINES = 100_000  # the rates are means over them
_TOLERANCE = 1e-3  # of the moments; the scatter is then good to a part in ten thousand, the sizes are exact


@dataclass(frozen=True, slots=True)
class Prospect:
    """What one recogniser can do for one entry.

    Attributes:
        right: chance that after the lines asked for the entry is the likeliest of all when it is the true one.
        lines: the fewest lines after which that chance has the confidence asked for; None where no number does.
        rival: the entry for which it is taken most often; None without rivals.
        error: the chance that this rival is likelier.
        confusable: every entry that is likelier with a chance above 1 − confidence.
    """

    right: float
    lines: int | None
    rival: str | None
    error: float
    confusable: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class EntryProspects:
    """One entry: its size, its twins and what each recogniser can do for it."""

    name: str
    title: str
    area_cm2: float
    perimeter_cm: float
    twins: tuple[str, ...]
    plane: Prospect
    line: Prospect


@dataclass(frozen=True, slots=True)
class PairProspects:
    """Two entries: the chance that one is taken for the other, the worse way round, and the lines not to be."""

    names: tuple[str, str]
    plane_error: float
    line_error: float
    plane_lines: int | None
    line_lines: int | None


@dataclass(frozen=True, slots=True)
class Separability:
    """What can be told apart in a dictionary.

    Attributes:
        n: crossing lines asked for.
        confidence: chance of being right asked for.
        classes: twins that no lines tell apart (moved, turned or mirrored copies), two or more names each.
        entries: in the dictionary's order.
        moments: of each entry, by name.
        plane_pairs: the pairs that are worst for the recogniser in the plane; the worst first.
        line_pairs: the same for the recogniser line by line.
    """

    n: int
    confidence: float
    classes: tuple[tuple[str, ...], ...]
    entries: tuple[EntryProspects, ...]
    moments: Mapping[str, Moments]
    plane_pairs: tuple[PairProspects, ...]
    line_pairs: tuple[PairProspects, ...]


def separability(
    dictionary: Mapping[str, Shape],
    rng: np.random.Generator,
    *,
    n: int = 100,
    confidence: float = 0.95,
    model: SensorModel | None = None,
    worst: int = 10,
    table_lines: int = TABLE_LINES,
    progress: Progress = lambda _done, _total: None,
) -> Separability:
    """Judge how well the entries of ``dictionary`` can be told apart.

    With a ``model`` both recognisers see the lines through that sensor, and figures beyond ``table_lines`` lines are
    not to be had; without, lines are ideal and the moments exact. ``worst`` pairs of each kind are reported.

    Raises:
        RequestError: fewer than two entries, no lines, or a confidence outside of 0.5 … 1.
    """
    if len(dictionary) < 2:
        raise RequestError("one shape alone cannot be confused; name at least two, or a collection")
    if n < 1:
        raise RequestError(f"the number of lines must be at least 1, got {n}")
    if not 0.5 < confidence < 1:
        raise RequestError(f"the confidence lies between 0.5 and 1, not {confidence:g}; 0.95 is usual")
    names = tuple(dictionary)
    geometries = {name: shape.geometry for name, shape in dictionary.items()}
    # measured in entries: the moments, the tables (all in one go), the fresh lines, the judgement
    done, total = 0, 4 * len(names)

    def step(entries: int = 1) -> None:
        nonlocal done
        done += entries
        progress(done, total)

    classes = congruence_classes(geometries)
    twins = {name: members for members in classes for name in members}
    rivals = rivals_of(classes, names)
    moments: dict[str, Moments] = {}
    for name, geometry in geometries.items():
        if model is None:
            moments[name] = exact_moments(geometry, tolerance=_TOLERANCE)
        else:
            moments[name] = model.sense(geometry, table_lines, rng).moments(geometry)
        step()
    tables = learn_tables(geometries, rng, lines=table_lines, model=model)
    step(len(names))
    by_line = measure_rates(
        geometries, tables, rivals, rng, lines=table_lines, model=model, progress=lambda _name: step()
    )
    in_plane = PlaneConfusion(list(moments.values()), rivals)
    most = MOST_LINES if model is None else table_lines
    entries: list[EntryProspects] = []
    plane_errors, line_errors = np.zeros((2, len(names), len(names)))
    for row, name in enumerate(names):
        plane_errors[row], line_errors[row] = in_plane.errors(row, n), by_line.errors(row, n)
        entries.append(
            EntryProspects(
                name=name,
                title=dictionary[name].title,
                area_cm2=dictionary[name].area_cm2,
                perimeter_cm=dictionary[name].perimeter_cm,
                twins=tuple(other for other in twins[name] if other != name),
                plane=_prospect(in_plane, row, names, plane_errors[row], n, confidence, most),
                line=_prospect(by_line, row, names, line_errors[row], n, confidence, most),
            )
        )
        step()
    # the first of each class stands for its twins
    heads = [names.index(members[0]) for members in classes]

    def judged(a: int, b: int) -> PairProspects:
        return PairProspects(
            names=(names[a], names[b]),
            plane_error=_either_way(plane_errors, a, b),
            line_error=_either_way(line_errors, a, b),
            plane_lines=_longer(in_plane.pair_lines(*way, confidence, most) for way in ((a, b), (b, a))),
            line_lines=_longer(by_line.pair_lines(*way, confidence, most) for way in ((a, b), (b, a))),
        )

    def worst_by(badness: NDArray[np.float64]) -> tuple[PairProspects, ...]:
        order = sorted(combinations(heads, 2), key=lambda pair: -_either_way(badness, *pair))
        return tuple(judged(a, b) for a, b in order[:worst])

    return Separability(
        n=n,
        confidence=confidence,
        classes=tuple(members for members in classes if len(members) > 1),
        entries=tuple(entries),
        moments=moments,
        plane_pairs=worst_by(plane_errors),
        line_pairs=worst_by(_pair_times(by_line)),
    )


def _prospect(
    confusion: PlaneConfusion | LineConfusion,
    row: int,
    names: tuple[str, ...],
    errors: NDArray[np.float64],
    n: int,
    confidence: float,
    most: int,
) -> Prospect:
    worst = int(np.argmax(errors))
    return Prospect(
        right=1 - confusion.error(row, n),
        lines=fewest_lines(lambda count: confusion.error(row, count), 1 - confidence, most),
        rival=names[worst] if confusion.rivals[row].any() else None,
        error=float(errors[worst]),
        confusable=tuple(names[other] for other in np.flatnonzero(errors > 1 - confidence)),
    )


def _pair_times(confusion: LineConfusion) -> NDArray[np.float64]:
    """How long each pair takes, up to a factor: variance/rate², infinite where nothing tells the two apart."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(confusion.is_resolved, confusion.variance / confusion.rate**2, np.inf)


def _longer(both: Iterable[int | None]) -> int | None:
    """The larger of some numbers of lines; None, never, is the largest."""
    longest = 0
    for lines in both:
        if lines is None:
            return None
        longest = max(longest, lines)
    return longest


def _either_way(errors: NDArray[np.float64], a: int, b: int) -> float:
    return float(max(errors[a, b], errors[b, a]))
