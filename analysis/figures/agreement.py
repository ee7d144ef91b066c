"""The plot of Bland and Altman: difference against mean, with bias, limits of agreement and how well they are known."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from analysis.figures import pen
from lab.base.blandaltman import BlandAltman, bland_altman

Floats = NDArray[np.float64]

_TREND_LEVEL = 0.05


def draw_agreement(axes: Axes, robot_cm: Floats, camera_cm: Floats, colour: str, *, size: float) -> BlandAltman | None:
    """Draw robot minus camera against their mean, (n,) each, both known; the figures behind it, None below two pairs.

    Bands are 95 % intervals of bias and limits. A trend with length is drawn where it is significant.
    """
    mean, difference = (robot_cm + camera_cm) / 2.0, robot_cm - camera_cm
    longest = 1.04 * float(mean.max(initial=1.0))
    pen.dress(axes, x="mean of the two (cm)", y="robot − camera (cm)")
    pen.level(axes, 0.0, pen.MUTED, width=0.8, style="-")
    pen.dots(axes, mean, difference, colour, size=size, alpha=0.55, pixels=mean.size > 500, gid="differences")
    axes.set_xlim(0, longest)
    found = bland_altman(robot_cm, camera_cm)
    if found is None:
        return None
    low, high = found.limits
    for name, value, (begin, end), width, style in (
        ("bias", found.bias, found.bias_interval, 1.3, "-"),
        ("low limit", low, found.lower_limit_interval, 0.9, "--"),
        ("high limit", high, found.upper_limit_interval, 0.9, "--"),
    ):
        pen.band(axes, [0.0, longest], [begin, begin], [end, end], pen.MUTED, alpha=0.16)
        pen.level(axes, value, pen.INK, width=width, style=style, gid=name)
    if found.trend_p < _TREND_LEVEL:
        ends = np.array([float(mean.min()), float(mean.max())])
        pen.line(axes, ends, found.trend_at_zero + found.trend * ends, colour, width=1.6, style="-.", gid="trend")
    _make_room(axes, found, difference)
    for value, words, up in (
        (high, f"+1.96 sd: {high:+.2f}", 7),
        (found.bias, f"mean {found.bias:+.2f}", 7),
        (low, f"−1.96 sd: {low:+.2f}", -7),
    ):
        pen.text(
            axes,
            (1.0, value),
            words.replace("-", "−"),
            shift=(-2, up),
            side="right",
            frame="x axes, y data",
            halo=True,
        )
    return found


def _make_room(axes: Axes, found: BlandAltman, difference: Floats) -> None:
    """Leave the bands and the words by the limits inside the picture."""
    bottom = min(found.lower_limit_interval[0], float(difference.min()))
    top = max(found.upper_limit_interval[1], float(difference.max()))
    free = 0.1 * (top - bottom) + 1e-9
    axes.set_ylim(bottom - free, top + free)
