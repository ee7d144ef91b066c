"""What the page says of a moment, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping

from lab.live.story import Moment, Standing

_STATES = {
    "preparing": "Getting ready",
    "rolling": "Rolling",
    "paused": "Paused",
    "complete": "Complete: all lines are rolled",
    "recognised": "Complete: recognised",
    "stopped": "Stopped",
    "interrupted": "Interrupted",
    "failed": "Failed",
    "replayed": "Complete: the replay has come to its end",
    "cut": "Cut off",
}
_SURENESS = ((0.99, "Surely"), (0.95, "Almost surely"), (0.8, "Probably"), (0.5, "Perhaps"))


def state_words(state: str) -> str:
    """How a session stands."""
    return _STATES.get(state, state)


def headline(last: Standing | None) -> str:
    """The answer so far. Coarse on purpose: it changes seldom, since it is read aloud when it does."""
    if last is None:
        return "No line has crossed the shape yet"
    if last.unknown > 0.5:
        return "None of the dictionary's shapes fits"
    sure = next((word for least, word in _SURENESS if last.posterior >= least), "")
    return f"{sure}: {last.leading}" if sure else "Not sure yet"


def with_error(value: float, sigma: float, unit: str) -> str:
    """A figure and its standard error; a dash where it is not known."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f} ± {sigma:.0f} {unit}" if math.isfinite(sigma) else f"{value:.0f} {unit}"


def percent(share: float) -> str:
    """A share in percent."""
    return f"{100 * share:.0f} %"


def duration(seconds: float) -> str:
    """A time span as people say it; a dash where it is not known."""
    if not math.isfinite(seconds):
        return "–"
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def facts(
    moment: Moment, lines: int, link: float, battery_v: Mapping[str, float], speed: float | None = None
) -> dict[str, str]:
    """The small figures of a moment, each under its name.

    Args:
        moment: what is known.
        lines: how many are wanted.
        link: share of the light samples that came.
        battery_v: of each robot, newest.
        speed: how many times real time a virtual bench goes, where time left on the wall's clock is another.
    """
    last = moment.last
    n = last.n if last is not None else 0
    left = "–" if moment.state not in ("rolling", "paused") else duration(moment.left_s)
    if speed and left != "–":
        left = f"{left} (here {duration(moment.left_s / speed)})"
    volts = "\n".join(
        f"{value:.2f} V" if len(battery_v) == 1 else f"{robot} {value:.2f} V" for robot, value in battery_v.items()
    )
    return {
        "Lines": f"{n} of {lines}",
        "Area": "–" if last is None else with_error(last.area_cm2, last.sigma_area_cm2, "cm²"),
        "Perimeter": "–" if last is None else with_error(last.perimeter_cm, last.sigma_perimeter_cm, "cm"),
        "Time": duration(moment.rolling_s),
        "Time left": left,
        "Battery": volts or "–",
        "Link": f"{percent(link)} of samples" if math.isfinite(link) else "–",
    }
