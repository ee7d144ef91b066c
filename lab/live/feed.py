"""What the page is told that is newer than the log: light samples, the LED, the camera's picture, the battery.

Nothing here waits, and nothing is kept: what the page does not take is lost. Told a few times a second, by the
machine's clock, however fast the session's own goes, and only while somebody looks.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.live.channel import Ends, send_news
from robot.device import Sample
from tracking.cameras import Frame

Picture = NDArray[np.uint8]

_NEWS_EVERY_S = 0.2
_PICTURE_EVERY_S = 0.2
LOOK_LASTS_S = 3.0
"""How long pages that looked are taken to look still, by the machine's clock."""
_PICTURE_WIDTH = 480
_JPEG_QUALITY = 60
_KEPT_SAMPLES = 80


class Feed:
    """One session's news, or that of several sessions one after the other.

    Args:
        ends: the session's ends of the channel; None: nobody looks, and nothing is done.
        now: the machine's clock, s.
    """

    def __init__(self, ends: Ends | None = None, *, now: Callable[[], float] = time.monotonic) -> None:
        self._ends = ends
        self._now = now
        self._next_news_s = self._next_picture_s = self._looked_until_s = -math.inf
        self._news: dict[str, Any] = {"kind": "news"}
        self._samples: dict[str, deque[tuple[float, float]]] = {}
        self._robots: dict[str, tuple[bool, int | None, float]] = {}

    @property
    def watched(self) -> bool:
        """Whether somebody looks."""
        return self._ends is not None

    def tell(self, **news: Any) -> None:
        """Tell at once: ``folder``, ``said``, ``paused``, ``next_shape`` … JSON values, kept until told otherwise."""
        self._news |= {name: str(value) if isinstance(value, Path) else value for name, value in news.items()}
        self._send()

    def look(self) -> None:
        """Somebody looks: samples and pictures are sent for a while."""
        self._looked_until_s = self._now() + LOOK_LASTS_S

    def sample(self, robot: str, sample: Sample, *, lit: bool, line: int | None, battery_v: float) -> None:
        """Take a light sample of a robot, and what else is known of it at that moment."""
        if (now_s := self._now()) > self._looked_until_s:
            return
        samples = self._samples.get(robot)
        if samples is None:
            samples = self._samples[robot] = deque(maxlen=_KEPT_SAMPLES)
        samples.append((sample.t_host_s, sample.light_lux))
        self._robots[robot] = (lit, line, battery_v)
        if now_s >= self._next_news_s:
            self._news["t_s"] = sample.t_host_s
            self._send()

    def frame(self, frame: Frame) -> None:
        """Take a frame of the camera; a few of them are sent, small."""
        if self._ends is None or not self._next_picture_s <= (now_s := self._now()) <= self._looked_until_s:
            return
        self._next_picture_s = now_s + _PICTURE_EVERY_S
        width, height = frame.size
        small = (_PICTURE_WIDTH, max(1, round(height * _PICTURE_WIDTH / width)))
        picture = shrunk(frame.luma, frame.chroma, small)
        done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        if done:
            lit = any(lit for lit, _, _ in self._robots.values())
            send_news(self._ends, {"kind": "picture", "t_s": frame.t_host_s, "lit": lit}, jpeg.tobytes())

    def _send(self) -> None:
        if self._ends is None:
            return
        self._next_news_s = self._now() + _NEWS_EVERY_S
        light = {
            robot: [[round(t_s, 3), round(lux, 2)] for t_s, lux in samples if math.isfinite(lux)]
            for robot, samples in self._samples.items()
        }
        self._samples.clear()
        robots = {
            robot: {"lit": lit, "line": line, "battery_v": volts if math.isfinite(volts) else None}
            for robot, (lit, line, volts) in self._robots.items()
        }
        send_news(self._ends, {**self._news, "robots": robots, "light": light})


def shrunk(luma: Picture, chroma: Sequence[Picture], size: tuple[int, int]) -> Picture:
    """A frame's planes as a small BGR picture, (w, h) px.

    Shrunk before it is turned into colours, and by interpolation, not by means over areas: a tenth of the work, and an
    LED is wider than the pixels passed over.
    """
    small, u, v = (cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR) for plane in (luma, *chroma))
    return np.asarray(cv2.cvtColor(cv2.merge((small, v, u)), cv2.COLOR_YCrCb2BGR), dtype=np.uint8)
