"""The robot's chords against the camera's, one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import pen
from analysis.figures.agreement import draw_agreement
from analysis.figures.style import colour_of
from lab.base.blandaltman import WITHIN_LIMITS

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Agreement:
    """Robot minus camera over matched chords: mean and sd in cm, and the limits of agreement (mean ± 1.96 sd).

    ``scale`` is Σ robot · camera / Σ camera², the slope through the origin, and ``scale_sigma`` its standard error.
    Source: Bland and Altman, Lancet 1986.
    """

    chords: int
    bias_cm: float
    sd_cm: float
    scale: float
    scale_sigma: float

    @property
    def limits_cm(self) -> tuple[float, float]:
        """Between these, 95 of 100 chords agree."""
        return self.bias_cm - WITHIN_LIMITS * self.sd_cm, self.bias_cm + WITHIN_LIMITS * self.sd_cm


def agreement(chord_pairs: pd.DataFrame) -> Agreement | None:
    """Compare ``robot_length_cm`` with ``true_length_cm``; None below two pairs."""
    robot, camera = _lengths(chord_pairs)
    if robot.size < 2:
        return None
    difference = robot - camera
    weight = float(camera @ camera)
    scale = float(robot @ camera) / weight
    rest = robot - scale * camera
    return Agreement(
        chords=robot.size,
        bias_cm=float(difference.mean()),
        sd_cm=float(difference.std(ddof=1)),
        scale=scale,
        scale_sigma=float(np.sqrt(rest @ rest / (robot.size - 1) / weight)),
    )


def chord_pairs_figure(chord_pairs: pd.DataFrame, *, name: str) -> Figure:
    """Draw robot against camera chord by chord, and their difference against their mean (Bland–Altman)."""
    colour = colour_of(name)
    robot, camera = _lengths(chord_pairs)
    figure = pen.new_figure(7.2, 3.5)
    against = figure.add_subplot(1, 2, 1)
    apart = figure.add_subplot(1, 2, 2)
    pen.dress(against, x="chord by the camera (cm)", y="chord by the robot (cm)")
    many = robot.size > 500
    size = float(np.clip(8000 / max(robot.size, 1), 2.0, 12.0))
    longest = 1.04 * float(max(robot.max(initial=1.0), camera.max(initial=1.0)))
    pen.line(against, [0, longest], [0, longest], pen.INK, width=1.0, style="--", label="equal", gid="equal")
    pen.dots(against, camera, robot, colour, size=size, alpha=0.55, pixels=many, gid="pairs")
    against.set_xlim(0, longest)
    against.set_ylim(0, longest)
    draw_agreement(apart, robot, camera, colour, size=size)
    return figure


def _lengths(chord_pairs: pd.DataFrame) -> tuple[Floats, Floats]:
    robot = np.asarray(chord_pairs["robot_length_cm"], dtype=float)
    camera = np.asarray(chord_pairs["true_length_cm"], dtype=float)
    both = np.isfinite(robot) & np.isfinite(camera)
    return robot[both], camera[both]
