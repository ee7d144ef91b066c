"""What the panels are drawn from, worked out once and only when a panel asks for it."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from analysis.compare import chord_divergence
from analysis.congruence import congruence_classes
from analysis.figures.paper.explored import Explored
from analysis.figures.paper.known import Known
from analysis.figures.paper.plane import GRID
from analysis.figures.paper.precision import Complexity
from analysis.figures.paper.word import Read
from analysis.montecarlo import Bands, Simulation, running_bands, simulate, simulate_chords
from analysis.quadrature import Moments, exact_moments
from analysis.reading import Strategies, compare_strategies, lines_in_a_dictionary_of
from analysis.scaling import PowerLaw, fit_scatter
from analysis.tablestore import Mapper
from lab.figures.robots import NO_SESSIONS, Stored, simulated_robot
from lab.recognise.separability import separability
from lab.settings.settings import Settings
from projector.collections import load_dictionary
from projector.shape import Font, Shape, Silhouette
from projector.text import TEXT_PREFIX, Typeface, find_font

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

WORD = "FREEDOM"
ELLIPSES_AT = 1000  # lines, Fig. 1G
DICTIONARY_SIZES = (10, 30, 130, 300, 1000, 3000, 10_000)
# Words set in type have thousands of vertices. Dropping those that matter less than 40 µm changes no scatter by more
# than 2 parts in 10⁴, and takes a sixth of the time; the sizes are those of the outlines as they are.
_FLAT_CM = 0.004
_TOLERANCE = 1e-3

# What each product costs, in tenths of a second of one core or so: for the progress bar alone.
COSTS = {
    "exact": 15,
    "robots": 30,
    "simulated": 60,
    "fits": 15,
    "shapes": 5,
    "complexity": 10,
    "letters": 60,
    "alphabet": 25,
    "words": 280,
    "read": 60,
    "strategies": 10,
}


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is simulated.

    Attributes:
        lines: crossing lines of a robot.
        runs: simulated runs over each shape.
        most_lines: of those runs, in Figs. 2D, E.
        chords_from: lines that the divergence's chords are taken from.
        table_lines: lines that each letter's table is learnt from.
        read_lines: lines over the word, in Figs. 3E–H; a seventh of them over each letter.
        read_runs: share of ``runs`` that is simulated of the word, whose lines are long.
        grid: points across and up of the maps of the plane.
        blinks: the N of Fig. 1B's maps.
    """

    lines: int = 1000
    runs: int = 1000
    most_lines: int = 10_000
    chords_from: int = 200_000
    table_lines: int = 50_000
    read_lines: int = 210_000
    read_runs: float = 0.1
    grid: tuple[int, int] = GRID
    blinks: tuple[int, ...] = (10, 40, 100, 200, 1000)


class Workbench:
    """Lazily made products for the panels; each has a random stream of its own, so that none depends on another.

    Args:
        settings: of the arena and the robot.
        seed: of all random streams.
        scale: how much to simulate.
        font: for letters and words, as for `projector.text.find_font`.
        stored: sessions that replace simulated robots.
        spent: called with the cost of each product as it is made.
        mapper: spreads what is worked out for each shape over processes or a cluster; default: one after the other,
            with threads. It does not change what is found.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        seed: int,
        scale: Scale,
        font: Font | None = None,
        stored: Stored = NO_SESSIONS,
        spent: Callable[[float], None] = lambda _cost: None,
        mapper: Mapper | None = None,
    ) -> None:
        self.settings, self.scale, self.stored = settings, scale, stored
        self._seed, self._font, self._spent, self._mapper = seed, font, spent, mapper or one_by_one

    def _rng(self, purpose: str) -> np.random.Generator:
        return stream_of(self._seed, purpose)

    def _each(
        self, product: str, task: Callable[[tuple[str, _Item]], _Result], items: Mapping[str, _Item]
    ) -> dict[str, _Result]:
        """What a task finds for each item, (name, item), of a product."""
        found: dict[str, _Result] = {}
        for (name, _), result in self._mapper(task, list(items.items())):
            found[name] = result
            self._step(product, len(items))
        return {name: found[name] for name in items}

    def _step(self, product: str, parts: int = 1) -> None:
        self._spent(COSTS[product] / parts)

    @cached_property
    def shapes(self) -> dict[str, Shape]:
        """The paper's six, in its order."""
        return load_dictionary()

    @cached_property
    def font(self) -> Font:
        """That the letters are set in."""
        return self._font or find_font()

    @cached_property
    def titles(self) -> dict[str, str]:
        """Short titles of the six."""
        return {name: shape.title.partition(" (")[0] for name, shape in self.shapes.items()}

    @cached_property
    def exact(self) -> dict[str, Moments]:
        """Exact moments of the six."""
        return self._each("exact", exact_of, self._geometries)

    @cached_property
    def _geometries(self) -> dict[str, Silhouette]:
        return {name: shape.geometry for name, shape in self.shapes.items()}

    @cached_property
    def robots(self) -> dict[str, Explored]:
        """Who explored each shape: the longest session, or a simulated robot."""
        return {name: self.stored.by_shape.get(name) or robot for name, robot in self._simulated_robots.items()}

    @cached_property
    def seen(self) -> dict[str, Explored]:
        """Who was seen exploring each shape: the longest filmed session, or a simulated robot."""
        return {name: self.stored.filmed.get(name) or robot for name, robot in self._simulated_robots.items()}

    @cached_property
    def _simulated_robots(self) -> dict[str, Explored]:
        explore = partial(robot_of, settings=self.settings, lines=self.scale.lines, seed=self._seed)
        found = self._each("robots", explore, self.shapes)
        return {name: replace(robot, title=self.titles[name]) for name, robot in found.items()}

    @cached_property
    def simulated(self) -> dict[str, Bands]:
        """Simulated runs over the six."""
        n = np.geomspace(2, self.scale.most_lines, 38).round().astype(np.int64)
        checkpoints = np.unique(np.append(n, ELLIPSES_AT))
        follow = partial(bands_of, checkpoints=checkpoints, runs=self.scale.runs, seed=self._seed)
        return self._each("simulated", follow, self._geometries)

    @cached_property
    def fits(self) -> dict[str, dict[str, PowerLaw]]:
        """Power laws through the scatter: of "area_cm2" and "perimeter_cm", for each shape."""
        found = self._each("fits", partial(laws_of, seed=self._seed), self.simulated)
        return {column: {name: laws[column] for name, laws in found.items()} for column in ("area_cm2", "perimeter_cm")}

    @cached_property
    def complexity(self) -> dict[str, Complexity]:
        """Divergence of the chord lengths from the circle's, and the prefactors."""
        chords = {
            name: simulate_chords(shape.geometry, self.scale.chords_from, self._rng(f"chords {name}"))
            for name, shape in self.shapes.items()
        }
        # the circle against fresh chords of its own: what is left is the estimator's noise
        circle = simulate_chords(
            self.shapes["circle"].geometry, self.scale.chords_from, self._rng("chords of the reference")
        )
        self._step("complexity")
        return {
            name: Complexity(
                self.titles[name],
                chord_divergence(lengths, circle, normalise=True),
                self.fits["area_cm2"][name],
                self.fits["perimeter_cm"][name],
                self.exact[name],
            )
            for name, lengths in chords.items()
        }

    @cached_property
    def six(self) -> Known:
        """The six as a dictionary."""
        classes = congruence_classes({name: shape.geometry for name, shape in self.shapes.items()})
        self._step("shapes")
        return Known.of(self.titles, self.exact, classes)

    @cached_property
    def letters(self) -> Known:
        """The capitals, 40 cm high, as a dictionary; by (P, A) and line by line."""
        shapes = {
            name: shape
            for name, shape in load_dictionary("letters", font=self.font).items()
            if name.removeprefix(TEXT_PREFIX).isalpha()
        }
        made = 0.0

        def progress(done: int, total: int) -> None:
            nonlocal made
            share = done / total
            self._spent(COSTS["letters"] * (share - made))
            made = share

        found = separability(shapes, self._rng("letters"), n=100, table_lines=self.scale.table_lines, progress=progress)
        by_line = {entry.name: entry.line.lines for entry in found.entries}
        return Known.of(_bare(shapes), found.moments, found.classes, by_line)

    @cached_property
    def words(self) -> Known:
        """The words of the preamble as a dictionary, by (P, A)."""
        shapes = load_dictionary("words", font=self.font)
        geometries = {name: shape.geometry for name, shape in shapes.items()}
        moments = self._each("words", coarse_of, geometries)
        return Known.of(_bare(shapes), moments, congruence_classes(geometries))

    @cached_property
    def _word(self) -> tuple[Silhouette, float]:
        """The word as one shape, and the height of its capitals."""
        typeface = Typeface(self.font)
        whole = typeface.shape(WORD).geometry
        # at any one height the letters cover what the word does
        height_cm = 40.0
        covered = sum(typeface.set(letter, cap_height_cm=height_cm).area for letter in WORD)
        return whole, height_cm * float(np.sqrt(whole.area / covered))

    @cached_property
    def alphabet(self) -> Known:
        """The capitals at the size that letters have in the word."""
        typeface, height_cm = Typeface(self.font), self._word[1]
        letters = {f"{TEXT_PREFIX}{letter}": typeface.set(letter, cap_height_cm=height_cm) for letter in _CAPITALS}
        moments = self._each("alphabet", partial(exact_of, tolerance=_TOLERANCE), letters)
        titles = {name: name.removeprefix(TEXT_PREFIX) for name in letters}
        return Known.of(titles, moments, congruence_classes(letters))

    @cached_property
    def read(self) -> Read:
        """The word, read both ways."""
        whole, height_cm = self._word
        typeface, lines = Typeface(self.font), self.scale.read_lines
        n = np.unique(np.geomspace(min(100, lines / 10), lines, 40).round().astype(np.int64))
        share, runs = lines // len(WORD), max(3, round(self.scale.read_runs * self.scale.runs))
        letters = {
            f"letter {place} of the word": typeface.set(letter, cap_height_cm=height_cm)
            for place, letter in enumerate(WORD)
        }
        found = self._each("read", partial(runs_of, lines=share, runs=runs, seed=self._seed), letters)
        bands = running_bands(_coarse(whole), n, runs, self._rng("the word"))
        return Read(
            WORD,
            _moments_of(whole),
            [self.alphabet.moments[f"{TEXT_PREFIX}{letter}"] for letter in WORD],
            lines,
            bands,
            np.array([np.column_stack([run.area_cm2, run.perimeter_cm]) for run in found.values()]),
        )

    @cached_property
    def strategies(self) -> Strategies:
        """Lines to name the word by (P, A), both ways, against the size of the dictionary."""
        needed = self.alphabet.lines_needed()
        entry = self.words.names.index(f"{TEXT_PREFIX}{WORD}")
        found = compare_strategies(
            [needed[f"{TEXT_PREFIX}{letter}"] for letter in WORD],
            lambda size: lines_in_a_dictionary_of(self.words.confusion, entry, size),
            DICTIONARY_SIZES,
        )
        self._step("strategies")
        return found


_CAPITALS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def one_by_one(task: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
    """Work on items in this process, in their order."""
    for item in items:
        yield item, task(item)


def stream_of(seed: int, purpose: str) -> np.random.Generator:
    """The random stream of one purpose."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


# What is worked out for each shape by itself, by whoever does it: (name, geometry) in, the product out.


def exact_of(named: tuple[str, Silhouette], *, tolerance: float | None = None) -> Moments:
    """Exact moments of one shape."""
    return exact_moments(named[1]) if tolerance is None else exact_moments(named[1], tolerance=tolerance)


def coarse_of(named: tuple[str, Silhouette]) -> Moments:
    """Exact moments of one outline of very many vertices."""
    return _moments_of(named[1])


def robot_of(named: tuple[str, Shape], *, settings: Settings, lines: int, seed: int) -> Explored:
    """A simulated robot's exploration of one shape."""
    return simulated_robot(named[1], settings, lines=lines, rng=stream_of(seed, f"robot {named[0]}"))


def bands_of(named: tuple[str, Silhouette], *, checkpoints: NDArray[np.int64], runs: int, seed: int) -> Bands:
    """Simulated runs over one shape."""
    return running_bands(named[1], checkpoints, runs, stream_of(seed, f"runs {named[0]}"))


def runs_of(named: tuple[str, Silhouette], *, lines: int, runs: int, seed: int) -> Simulation:
    """Simulated runs over one letter, their ends alone."""
    return simulate(named[1], lines=lines, runs=runs, rng=stream_of(seed, named[0]))


def laws_of(named: tuple[str, Bands], *, seed: int) -> dict[str, PowerLaw]:
    """Power laws through the scatter of one shape's area and perimeter."""
    name, bands = named
    columns = {"area_cm2": bands.area_runs_cm2, "perimeter_cm": bands.perimeter_runs_cm}
    return {
        column: fit_scatter(bands.n, runs, stream_of(seed, f"fit {column} {name}")) for column, runs in columns.items()
    }


def _bare(shapes: Mapping[str, Shape]) -> dict[str, str]:
    return {name: name.removeprefix(TEXT_PREFIX) for name in shapes}


def _moments_of(geometry: Silhouette) -> Moments:
    """Moments of an outline of very many vertices: its own sizes, the scatter of a slightly coarser one."""
    moments = exact_moments(_coarse(geometry), tolerance=_TOLERANCE)
    return replace(moments, area_cm2=geometry.area, perimeter_cm=geometry.length)


def _coarse(geometry: Silhouette) -> Silhouette:
    flat = geometry.simplify(_FLAT_CM)
    return flat if isinstance(flat, Polygon | MultiPolygon) and flat.is_valid else geometry
