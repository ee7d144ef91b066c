"""What a session knows so far: its estimates, its leading name, and whether that is enough."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

from analysis.recognition import Recogniser
from lab.session.tally import Estimates
from lab.settings.sections import StopSettings


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a session stands, after a run. NaN where nothing is known yet; ``unknown``: none of the dictionary's."""

    line: int
    n: int
    t_s: float
    area_cm2: float
    sigma_area_cm2: float
    perimeter_cm: float
    sigma_perimeter_cm: float
    leading: str
    posterior: float
    unknown: float
    battery_v: float


class Watcher(Protocol):
    """What follows a session while it runs."""

    def __call__(self, progress: Progress, /) -> None:
        """Take note of where the session stands; called on the loop, must return quickly."""
        ...


@dataclass(slots=True)
class Ledger:
    """The standing of a session.

    Attributes:
        stop: when to end.
        recogniser: fed with each whole line.
        n: counted lines that crossed the shape.
    """

    stop: StopSettings
    recogniser: Recogniser
    n: int = 0

    def enter(self, record: dict[str, Any], n: int, estimates: Estimates) -> None:
        """Take a run's record, whose run is in the sums already; of a crossing line, add the ``estimate`` after it.

        Args:
            record: as in the log; a line that is not whole would look like another shape's, and is not recognised by.
            n: counted lines that crossed the shape, this one among them.
            estimates: what the sums give.
        """
        if not (record["counts"] and record["k"]):
            return
        self.n = n
        if record["whole"]:
            self.recogniser.update(record["k"], record["l1_cm"], record["l3_cm3"], record["weight"])
        record["estimate"] = self.estimate(estimates)

    def estimate(self, estimates: Estimates) -> dict[str, Any]:
        """The log's record of the estimates after ``n`` lines; None for what is not known."""
        leading, posterior = self.recogniser.ranked()[0]
        figures = {name: value if math.isfinite(value) else None for name, value in _figures(estimates).items()}
        return {"n": self.n, **figures, "leading": leading, "posterior": posterior}

    def reason_to_stop(self) -> str | None:
        """How the session ends now, or None to go on."""
        stop = self.stop
        sure = stop.until is not None and self.n >= stop.at_least and self.recogniser.ranked()[0][1] >= stop.until
        # a shape that fits no entry has a favourite too
        if sure and self.recogniser.unknown() <= 0.5:
            return "recognised"
        return "complete" if self.n >= stop.lines else None

    def progress(self, estimates: Estimates, line: int, t_s: float, battery_v: float) -> Progress:
        """Where the session stands, for who watches."""
        leading, posterior = self.recogniser.ranked()[0] if self.n else ("", math.nan)
        figures = _figures(estimates)
        return Progress(
            line,
            self.n,
            t_s,
            figures["area_cm2"],
            figures["sigma_area_cm2"],
            figures["perimeter_cm"],
            figures["sigma_perimeter_cm"],
            leading,
            posterior,
            self.recogniser.unknown() if self.n else math.nan,
            battery_v,
        )


def _figures(estimates: Estimates) -> dict[str, float]:
    return {
        "area_cm2": estimates.area(),
        "perimeter_cm": estimates.perimeter(),
        "sigma_area_cm2": estimates.sigma_area(),
        "sigma_perimeter_cm": estimates.sigma_perimeter(),
        "correlation": estimates.correlation(),
    }
