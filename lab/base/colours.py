"""The colours that a robot's LED is told, and what a camera makes of them in Y, U and V.

A camera's filters overlap: a red LED is a little green and blue to it. Each LED's light is mixed as such a sensor
mixes it, and turned into luma and colour by BT.601. The palette is spread over the angles of the (U, V) plane, so
that a camera tells its entries apart whatever their brightness; the first entries lie farthest apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from lab.base.errors import RequestError

Rgb = tuple[float, float, float]

# What the camera's red, green and blue pixels each take of an LED's red, green and blue light.
_RESPONSE = ((1.0, 0.2, 0.1), (0.25, 1.0, 0.25), (0.2, 0.25, 1.0))

LED_COLOURS: Mapping[str, Rgb] = MappingProxyType(
    {
        "red": (1.0, 0.0, 0.0),
        "green": (0.0, 1.0, 0.0),
        "blue": (0.0, 0.0, 1.0),
        "yellow": (0.6, 0.6, 0.0),
        "magenta": (0.8, 0.0, 0.8),
        "cyan": (0.0, 0.7, 0.7),
        "orange": (0.8, 0.4, 0.0),
        "violet": (0.45, 0.0, 0.9),
    }
)
"""LED drive levels (red, green, blue), 0 to 1, at full brightness; mixtures are dimmed to about one luma."""


def led_rgb(name: str) -> Rgb:
    """The drive levels of a colour of the palette. Raises RequestError for a name that it lacks."""
    try:
        return LED_COLOURS[name]
    except KeyError:
        raise RequestError(f"LED colour {name!r} is not known; choose of {', '.join(LED_COLOURS)}") from None


def led_yuv(rgb: Rgb) -> tuple[float, float, float]:
    """What a camera sees of an LED driven so: luma, in units of the full red LED's, and the steps of U and V with it.

    >>> [round(part, 2) for part in led_yuv((1.0, 0.0, 0.0))]
    [1.0, -0.32, 0.81]
    """
    y, u, v = _yuv(rgb)
    unit = _yuv(LED_COLOURS["red"])[0]
    return y / unit, u / unit, v / unit


def led_hue(name: str) -> float:
    """The angle of a colour of the palette in the (U, V) plane, rad in (-pi, pi]."""
    _, u, v = _yuv(led_rgb(name))
    return math.atan2(v, u)


def _yuv(rgb: Rgb) -> tuple[float, float, float]:
    red, green, blue = (sum(share * light for share, light in zip(row, rgb, strict=True)) for row in _RESPONSE)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    return luma, 0.564 * (blue - luma), 0.713 * (red - luma)
