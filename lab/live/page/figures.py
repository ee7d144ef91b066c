"""The page's figures of a moment, each with the sentence that stands for it. Drawn once for all pages alike."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lab.live import charts, words
from lab.live.folder import Sightings, StoryFolder
from lab.live.map import arena_svg
from lab.live.story import Moment

Options = dict[str, Any]
TITLES = {
    "plane": "Area against perimeter",
    "names": "Which shape is it?",
    "area": "Area A(N)",
    "perimeter": "Perimeter P(N)",
    "runs": "Blinks along the last runs",
    "light": "Light sensor now",
}
_NOTHING_YET = "No line has crossed the shape yet."


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A chart, as ECharts takes it, and what it says."""

    options: Options
    says: str


@dataclass(frozen=True, slots=True, eq=False)
class Drawings:
    """All charts of a moment, by their names in TITLES, and the arena from above."""

    figures: Mapping[str, Drawing]
    arena_svg: str


def draw(folder: StoryFolder, moment: Moment, seen: Sightings, ink: charts.Ink) -> Drawings:
    """Draw a moment of a session; ``seen``: where LEDs were seen by then."""
    truth, last, standings = folder.truth, moment.last, moment.standings
    lit = sum(len(run.lit_cm) for run in moment.runs)
    figures = {
        "plane": Drawing(charts.plane(standings, (truth.area_cm2, truth.perimeter_cm), ink), _plane_says(moment)),
        "names": Drawing(charts.names(last, ink), _names_say(moment)),
        "runs": Drawing(
            charts.runs(moment.runs, ink), f"{lit} blinks in {len(moment.runs)} runs; the newest at the bottom."
        ),
    }
    for name, which, true, unit in (
        ("area", "area_cm2", truth.area_cm2, "cm²"),
        ("perimeter", "perimeter_cm", truth.perimeter_cm, "cm"),
    ):
        says = _NOTHING_YET
        if last is not None:
            value = words.with_error(getattr(last, which), getattr(last, f"sigma_{which}"), unit)
            says = f"{value} after {last.n} lines; the projected shape has {true:.0f} {unit}."
        figures[name] = Drawing(charts.convergence(standings, which, true, unit, ink), says)
    drawing = arena_svg(
        folder.settings.arena.polygon,
        folder.outline_cm(),
        seen,
        label=html.escape(f"The arena with {folder.shape.title}; {int(seen.lit.sum())} lit sightings"),
    )
    return Drawings(figures, drawing)


def draw_light(light: Mapping[str, Sequence[tuple[float, float]]], lit: Mapping[str, bool], ink: charts.Ink) -> Drawing:
    """Each robot's newest light samples, (t_s, lux), and whether its LED is lit."""
    says = [
        f"{robot if len(light) > 1 else ''} {samples[-1][1]:.0f} lux, LED {'lit' if lit.get(robot) else 'dark'}".strip()
        for robot, samples in light.items()
        if samples
    ]
    return Drawing(charts.light_strip(light, ink), f"{'; '.join(says)}." if says else "")


def arena_says(folder: StoryFolder) -> str:
    """What stands under the arena."""
    places = "where the camera saw an LED: lit spots are large, dark ones small"
    return f"The shape; {places if folder.has_camera else 'without a camera nobody sees where the robot blinks'}."


def _plane_says(moment: Moment) -> str:
    last = moment.last
    if last is None:
        return _NOTHING_YET
    return (
        f"A {words.with_error(last.area_cm2, last.sigma_area_cm2, 'cm²')}, "
        f"P {words.with_error(last.perimeter_cm, last.sigma_perimeter_cm, 'cm')}. "
        "The 95 % ellipses shrink onto the true shape, the diamond."
    )


def _names_say(moment: Moment) -> str:
    if moment.last is None:
        return _NOTHING_YET
    named = ", ".join(f"{name} {words.percent(share)}" for name, share in moment.last.names[:3])
    return f"{named}, if it is in the dictionary."
