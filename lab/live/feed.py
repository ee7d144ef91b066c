"""What the page is told that is newer than the log: light samples, the LED, the camera's picture, the battery.

Nothing here waits, and nothing is kept: what the page does not take is lost. Told a few times a second, by the
machine's clock, however fast the session's own goes.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

from lab.live.channel import Ends, send_news
from robot.device import Sample
from tracking.cameras import Frame

_NEWS_EVERY_S = 0.2
_PICTURE_EVERY_S = 0.2
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
        self._next_news_s = self._next_picture_s = -math.inf
        self._news: dict[str, Any] = {"kind": "news"}
        self._samples: deque[tuple[float, float]] = deque(maxlen=_KEPT_SAMPLES)
        self._robots: dict[str, tuple[bool, int | None, float]] = {}

    @property
    def watched(self) -> bool:
        """Whether somebody looks."""
        return self._ends is not None

    def tell(self, **news: Any) -> None:
        """Tell at once: ``folder``, ``said``, ``paused``, ``next_shape`` … JSON values, kept until told otherwise."""
        self._news |= {name: str(value) if isinstance(value, Path) else value for name, value in news.items()}
        self._send()

    def sample(self, robot: str, sample: Sample, *, lit: bool, line: int | None, battery_v: float) -> None:
        """Take a light sample of a robot, and what else is known of it at that moment."""
        if self._ends is None:
            return
        self._samples.append((sample.t_host_s, sample.light_lux))
        self._robots[robot] = (lit, line, battery_v)
        if self._now() >= self._next_news_s:
            self._news["t_s"] = sample.t_host_s
            self._send()

    def frame(self, frame: Frame) -> None:
        """Take a frame of the camera; a few of them are sent, small."""
        if self._ends is None or (now_s := self._now()) < self._next_picture_s:
            return
        self._next_picture_s = now_s + _PICTURE_EVERY_S
        width, height = frame.size
        small = (_PICTURE_WIDTH, max(1, round(height * _PICTURE_WIDTH / width)))
        # shrunk before it is turned into colours: a quarter of the work
        planes = [cv2.resize(plane, small, interpolation=cv2.INTER_AREA) for plane in (frame.luma, *frame.chroma)]
        luma, u, v = planes
        picture = cv2.cvtColor(cv2.merge((luma, v, u)), cv2.COLOR_YCrCb2BGR)
        done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        if done:
            lit = any(lit for lit, _, _ in self._robots.values())
            send_news(self._ends, {"kind": "picture", "t_s": frame.t_host_s, "lit": lit}, jpeg.tobytes())

    def _send(self) -> None:
        if self._ends is None:
            return
        self._next_news_s = self._now() + _NEWS_EVERY_S
        light = [[round(t_s, 3), round(lux, 2)] for t_s, lux in self._samples if math.isfinite(lux)]
        self._samples.clear()
        robots = {
            robot: {"lit": lit, "line": line, "battery_v": volts if math.isfinite(volts) else None}
            for robot, (lit, line, volts) in self._robots.items()
        }
        send_news(self._ends, {**self._news, "robots": robots, "light": light})
