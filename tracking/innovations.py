"""Whether the filter that smoothed a track tells the truth about its own error.

The innovations of a true model, over the standard deviations that it states, are white and of variance 1, and their
squares summed over both axes (NIS) follow chi-squared with two degrees of freedom (Bar-Shalom, Li & Kirubarajan 2001,
ch. 5.4). Three things can be wrong and are tested apart: the mean NIS (variances too small or too large), the
correlation of successive innovations (a motion model too stiff or too loose), the share of large NIS (heavy tails:
outliers that the variances do not know of).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tracking.clusters import Mean, clustered_mean
from tracking.runs import column
from tracking.uniformity import holm

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_LEVEL = 0.05  # of the three tests together, after Holm
# A long film shows departures that nobody need mind: beyond these they matter.
_MATTERS_RATIO, _MATTERS_LAG1, _MATTERS_TAILS = 1.25, 0.15, 3.0
_TAIL_SHARE = 0.02
_TAIL_OVER_MEDIAN = float(np.log(_TAIL_SHARE) / np.log(0.5))
_FEWEST_FRAMES, _FEWEST_RUNS, _BLOCK_FRAMES = 100, 20, 25
_TURN_S, _TURN_SHARE = 0.25, 0.3  # a change of velocity by this share of the cruising speed within so long is a turn


@dataclass(frozen=True, slots=True)
class FilterHealth:
    """What the innovations of a track say of its filter, on straight stretches.

    Attributes:
        frames: innovations behind the figures.
        mean_nis: their mean normalised square; 2 for a true model.
        mean_nis_interval: its 95 % interval; frames of a run (or of 25 frames, where there are few runs) may depend on
            each other.
        mean_nis_turns: the mean around bounces, starts and stops, where constant velocity is no model.
        lag1: correlation of successive innovations of an axis, 0 for a true model; positive where the filter is too
            stiff or the errors go together, negative where it is too loose.
        lag1_sigma: its standard error.
        tail_share: share of squares beyond what 2 % of a true model's would exceed, given their median.
        stretch: factor on the stated variances of the innovations that makes their median right.
        p_value: the smallest of the three tests', corrected after Holm.
        honest: no departure is both significant and large enough to matter.
        verdict: one plain line.
    """

    frames: int
    mean_nis: float
    mean_nis_interval: tuple[float, float]
    mean_nis_turns: float
    lag1: float
    lag1_sigma: float
    tail_share: float
    stretch: float
    p_value: float
    honest: bool
    verdict: str

    def to_dict(self) -> dict[str, Any]:
        """The JSON form; NaN becomes None."""
        values: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__}
        values["mean_nis_interval"] = [_known(end) for end in self.mean_nis_interval]
        return {name: _known(value) if isinstance(value, float) else value for name, value in values.items()}


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def filter_health(track: pd.DataFrame) -> FilterHealth:
    """Test the innovations of a track.

    Args:
        track: as from `tracking.track`, columns ``t_s vx_cm_s vy_cm_s nis innovation_x innovation_y``, in order of time
            within each ``line`` and ``robot`` where it has these columns.

    Raises:
        TrackError: a column is missing.

    The three tests together call a true model a liar in at most 5 % of tracks.
    """
    nis = column(track, "nis")
    run = _runs(track)
    steady = _steady(track, run)
    used = steady & np.isfinite(nis)
    turns = np.isfinite(nis) & ~steady
    mean_turns = float(nis[turns].mean()) if turns.any() else np.nan
    frames = int(used.sum())
    if frames < _FEWEST_FRAMES:
        nothing = f"too few measurements on straight stretches to test the filter ({frames}, {_FEWEST_FRAMES} needed)"
        return FilterHealth(
            frames, *(np.nan, (np.nan, np.nan), mean_turns, np.nan, np.nan, np.nan, np.nan, 1.0, True, nothing)
        )
    cluster = _clusters(run, used)
    size = clustered_mean(nis[used], cluster[used])
    lag1 = _lag1(track, run, used, cluster)
    median = float(np.median(nis[used]))
    beyond = nis[used] > _TAIL_OVER_MEDIAN * median
    # The threshold moves with the median that it is taken from; under exponential tails by so much.
    drag = _TAIL_OVER_MEDIAN * _TAIL_SHARE / 0.5 * (0.5 - (nis[used] <= median))
    tails = clustered_mean(beyond - drag, cluster[used])
    p_values = holm([size.p_value(2.0), lag1.p_value(0.0), tails.p_value(_TAIL_SHARE)])
    ratio = size.value / 2.0
    matters = (
        not 1.0 / _MATTERS_RATIO < ratio < _MATTERS_RATIO,
        abs(lag1.value) > _MATTERS_LAG1,
        tails.value > _MATTERS_TAILS * _TAIL_SHARE,
    )
    wrong = [large and p < _LEVEL for large, p in zip(matters, p_values, strict=True)]
    return FilterHealth(
        frames=frames,
        mean_nis=size.value,
        mean_nis_interval=size.interval(),
        mean_nis_turns=mean_turns,
        lag1=lag1.value,
        lag1_sigma=lag1.sigma,
        tail_share=float(beyond.mean()),
        stretch=median / (2.0 * float(np.log(2.0))),
        p_value=min(p_values),
        honest=not any(wrong),
        verdict=_verdict(size, lag1, float(beyond.mean()), wrong),
    )


def _verdict(size: Mean, lag1: Mean, tail_share: float, wrong: list[bool]) -> str:
    if not any(wrong):
        return f"the filter's errors are as it states them (mean NIS {size.value:.2f}, 2 expected)"
    said: list[str] = []
    if wrong[0]:
        way = "smaller" if size.value > 2.0 else "larger"
        off = max(size.value / 2.0, 2.0 / size.value)
        said.append(
            f"stated variances are {off:.2g} times {way} than the errors (mean NIS {size.value:.2f}, 2 expected)"
        )
    if wrong[1]:
        way = "too stiff" if lag1.value > 0.0 else "too loose"
        said.append(f"the motion model is {way} (successive innovations correlate by {lag1.value:+.2f})")
    if wrong[2]:
        said.append(f"the errors have heavy tails ({tail_share:.1%} where {_TAIL_SHARE:.0%} are expected)")
    return "the filter misstates its error: " + "; ".join(said)


def _runs(track: pd.DataFrame) -> NDArray[np.int64]:
    """A number for each stretch of the track that was filtered as one, (n,)."""
    keys = [name for name in ("line", "robot") if name in track.columns]
    if not keys:
        return np.zeros(len(track), dtype=np.int64)
    return np.asarray(track.groupby(keys, sort=False).ngroup(), dtype=np.int64)


def _steady(track: pd.DataFrame, run: NDArray[np.int64]) -> Flags:
    """Whether the robot rolls on as before at each frame, by the smoothed velocity a moment earlier and later."""
    t_s = column(track, "t_s")
    velocity = np.column_stack([column(track, "vx_cm_s"), column(track, "vy_cm_s")])
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    steady = np.zeros(len(track), dtype=bool)
    for number in np.unique(run):
        rows = np.flatnonzero((run == number) & np.isfinite(speed))
        if len(rows) < 3:
            continue
        when = t_s[rows]
        before = np.clip(np.searchsorted(when, when - _TURN_S), 0, len(rows) - 1)
        after = np.clip(np.searchsorted(when, when + _TURN_S), 0, len(rows) - 1)
        change = np.hypot(*(velocity[rows][after] - velocity[rows][before]).T)
        cruising = float(np.quantile(speed[rows], 0.75))
        # The first moments stand under the prior of the start, not under the model.
        steady[rows] = (change < _TURN_SHARE * cruising) & (when - when[0] > _TURN_S)
    return steady


def _clusters(run: NDArray[np.int64], used: Flags) -> NDArray[np.int64]:
    """Groups of frames that may depend on each other: runs, or blocks of frames where there are few runs."""
    if len(np.unique(run[used])) >= _FEWEST_RUNS:
        return run
    blocks = np.zeros(len(run), dtype=np.int64)
    for number in np.unique(run):
        rows = np.flatnonzero(run == number)
        blocks[rows] = blocks.max() + 1 + np.arange(len(rows)) // _BLOCK_FRAMES
    return blocks


def _lag1(track: pd.DataFrame, run: NDArray[np.int64], used: Flags, cluster: NDArray[np.int64]) -> Mean:
    """Correlation of the innovations of successive measurements, both axes together."""
    innovation = np.column_stack([column(track, "innovation_x"), column(track, "innovation_y")])
    # Outliers, which the filter does not take, would swamp the sum.
    innovation = np.clip(innovation, -4.0, 4.0)
    order = np.lexsort((column(track, "t_s"), run))
    order = order[used[order]]
    first, second = order[:-1], order[1:]
    same = run[first] == run[second]
    first, second = first[same], second[same]
    variance = float(np.mean(innovation[used] ** 2))
    return clustered_mean((innovation[first] * innovation[second]).mean(axis=1) / variance, cluster[first])
