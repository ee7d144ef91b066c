"""From positions in pixels to the track's table: LED state, arena's cm, and the Kalman smoothed path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from tracking.calibration import Calibration
from tracking.kalman import smooth_track
from tracking.ledstate import LedStates, led_states
from tracking.passes import RawTrack
from tracking.stamps import frozen

PIXEL_COLUMNS = ("frame", "t_s", "x_px", "y_px", "led_on", "led_confidence", "quality")
CM_COLUMNS = (
    "x_cm", "y_cm", "x_smooth_cm", "y_smooth_cm", "vx_cm_s", "vy_cm_s", "sigma_x_cm", "sigma_y_cm",
    "nis", "innovation_x", "innovation_y",
)  # fmt: skip
# Lens and calibration move a spot by about so much for good, which no smoothing takes away.
_SYSTEMATIC_VAR_PX2 = 0.07**2


def systematic_cm(calibration: Calibration) -> float:
    """How far every position of a run may be off for good, cm at the picture's middle: no smoothing takes it away."""
    width, height = calibration.optics.image_size
    middle = calibration.cm_per_px([[width / 2.0, height / 2.0]])[0]
    return float(np.sqrt(_SYSTEMATIC_VAR_PX2 * abs(np.linalg.det(middle))))


def led_columns(raws: Sequence[RawTrack]) -> list[LedStates]:
    """The LED's state in tracks whose levels are the same."""
    if any(raw.amplitude_sigma is None for raw in raws):
        # A matrix found by its colour is lit.
        return [LedStates(None, raw.quality > 0, np.full(len(raw.t_s), np.nan)) for raw in raws]
    sigmas = [raw.amplitude_sigma for raw in raws if raw.amplitude_sigma is not None]
    places = np.concatenate([raw.place for raw in raws])
    together = led_states(
        np.concatenate([raw.amplitude for raw in raws]), np.concatenate(sigmas), places[:, 0], places[:, 1]
    )
    ends = np.cumsum([len(raw.t_s) for raw in raws])[:-1]
    parts = zip(np.split(together.on, ends), np.split(together.confidence, ends), strict=True)
    return [LedStates(together.levels, on, confidence) for on, confidence in parts]


def track_table(raw: RawTrack, calibration: Calibration | None, states: LedStates | None = None) -> pd.DataFrame:
    """The columns of one robot's track; the LED's state is left open where that of other tracks must tell."""
    table = pd.DataFrame(
        {
            "frame": np.arange(len(raw.t_s), dtype=np.int64),
            "t_s": raw.t_s,
            "x_px": raw.place[:, 0],
            "y_px": raw.place[:, 1],
            "led_on": np.zeros(len(raw.t_s), dtype=bool) if states is None else states.on,
            "led_confidence": np.full(len(raw.t_s), np.nan) if states is None else states.confidence,
            "quality": raw.quality,
        }
    )
    if raw.identity is not None:
        table["identity"] = raw.identity
    if calibration is None:
        return table
    pixels = raw.place[:, :2]
    arena = calibration.to_arena(pixels)
    slopes = calibration.cm_per_px(pixels)
    variance_cm2 = (slopes**2 @ raw.place[:, 2:, None])[:, :, 0]
    # One figure for the whole track: the scale hardly changes over the arena.
    scales = np.sum(slopes**2, axis=2)[np.isfinite(pixels[:, 0])]
    systematic_cm2 = _SYSTEMATIC_VAR_PX2 * float(np.median(scales)) if len(scales) else 0.0
    # A frame without a later stamp than the one before (a stuck clock) has its row, but tells the filter nothing.
    latest = np.maximum.accumulate(raw.t_s)
    rises = np.diff(latest, prepend=-np.inf) > 0
    measured = arena[rises]
    # Nor does a frame that shows the picture before it again: the robot has gone on since.
    measured[frozen(raw.t_s[rises], *pixels[rises].T)] = np.nan
    smooth = smooth_track(raw.t_s[rises], *measured.T, *variance_cm2[rises].T)
    of_row = np.cumsum(rises) - 1
    columns = (
        *arena.T,
        *(
            values[of_row]
            for values in (
                smooth.x_cm, smooth.y_cm, smooth.vx_cm_s, smooth.vy_cm_s,
                np.sqrt(smooth.sigma_x_cm**2 + systematic_cm2), np.sqrt(smooth.sigma_y_cm**2 + systematic_cm2),
            )
        ),
        *(
            np.where(rises, values[of_row], np.nan)
            for values in (smooth.nis, smooth.innovation_x, smooth.innovation_y)
        ),
    )  # fmt: skip
    for name, values in zip(CM_COLUMNS, columns, strict=True):
        table[name] = values
    return table


def interleave(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Several robots' tables as one, by frame and robot; ``robot`` comes after ``frame``."""
    both = pd.concat(tables).sort_values(["frame", "robot"], kind="stable", ignore_index=True)
    both.insert(1, "robot", both.pop("robot"))
    return both


def empty_table(robots: int, calibration: Calibration | None) -> pd.DataFrame:
    """The table of no segments."""
    columns = ["line", *PIXEL_COLUMNS, *(CM_COLUMNS if calibration is not None else ())]
    if robots > 1:
        columns.insert(2, "robot")
        columns.insert(columns.index("quality") + 1, "identity")
    return pd.DataFrame(columns=columns)
