"""A session's folder, followed while it grows or read when it is whole."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from analysis.quadrature import Moments, exact_moments
from analysis.recognition import Recogniser
from lab.base.errors import RequestError
from lab.live.story import Rolled, Story
from lab.recognise.recognisers import recogniser_for
from lab.reopen.stored import stored_settings, stored_shape
from lab.session.experiment import dictionary_with
from lab.settings.settings import Settings
from lab.store.layout import LIGHT, REPORT, SessionFolderError
from lab.store.reader import SessionReader
from projector.shape import Shape

Floats = NDArray[np.float64]
_TRACK = ("t_s", "x_cm", "y_cm", "led_on")


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Where the camera saw LEDs: (n,) times, s, places, cm, and whether they were lit; in the order of time."""

    t_s: Floats
    x_cm: Floats
    y_cm: Floats
    lit: NDArray[np.bool_]

    @staticmethod
    def of(places: Iterable[tuple[float, float, float, bool]]) -> Sightings:
        """From (t_s, x_cm, y_cm, lit), in any order."""
        t_s, x_cm, y_cm, lit = np.array(sorted(places), dtype=float).reshape(-1, 4).T
        return Sightings(t_s, x_cm, y_cm, lit > 0)

    def and_then(self, places: Iterable[tuple[float, float, float, bool]]) -> Sightings:
        """Those, and later ones."""
        more = Sightings.of(places)
        return Sightings(*(np.concatenate([getattr(one, name) for one in (self, more)]) for name in self.__slots__))

    def until(self, t_s: float) -> Sightings:
        """Those up to a time."""
        end = int(np.searchsorted(self.t_s, t_s, side="right"))
        return Sightings(self.t_s[:end], self.x_cm[:end], self.y_cm[:end], self.lit[:end])


NOTHING_SEEN = Sightings.of(())


class StoryFolder:
    """What a session's folder says, read again as it grows.

    Attributes:
        session: the folder.
        settings: what it was run with.
        shape: what is projected.
        story: the log so far.

    Raises:
        RequestError: it is no session, or its manifest is not whole.
    """

    def __init__(self, folder: Path) -> None:
        self.session = SessionReader(folder)
        self.settings: Settings = stored_settings(self.session)
        self.shape: Shape = stored_shape(self.session)
        self.truth: Moments = exact_moments(self.shape.geometry)
        self.story = Story(self._lines())
        self.story.begin(self._batteries())
        self._read_bytes = 0
        self._recogniser: Recogniser | None = None
        self._samples: dict[int, int] = {}

    @property
    def has_camera(self) -> bool:
        """Whether it is filmed."""
        devices: dict[str, Any] = self.session.manifest.get("devices") or {}
        return devices.get("camera") is not None

    def read(self) -> bool:
        """Take what the log has gained, which alone is read. Whether it has gained anything.

        Raises:
            SessionFolderError: the log was changed, or is not whole.
        """
        gained = False
        try:
            for event, read_bytes in self.session.events_from(self._read_bytes, self.story.events + 1):
                self._read_bytes = read_bytes
                self.story.take([event])
                gained = True
        except (KeyError, TypeError, ValueError) as error:
            raise SessionFolderError(self.session.folder, f"an event of the log is not whole ({error!r})") from error
        if gained and self._recogniser is not None:
            self.story.name_with(self._recogniser)
        return gained

    def learn_names(self) -> bool:
        """Learn the dictionary, so that all entries' probabilities are shown; takes a while where it is not stored.

        Whether it could: a dictionary that is no longer what it was is left aside, and the log's leading name stays.
        """
        try:
            known = dictionary_with(self.shape, self.settings)
            stored: Mapping[str, str] = self.session.manifest.get("dictionary") or {}
            if stored != {name: entry.digest for name, entry in known.items()}:
                return False
            recogniser = recogniser_for(known, self.settings, called=self.shape.name)
        except RequestError:
            return False
        self.story.name_with(recogniser)
        self._recogniser = recogniser
        return True

    def link_quality(self, runs: Sequence[Rolled], last: int = 3) -> float:
        """The share of the light samples that came, of those due in the last runs; NaN before the first.

        Of the run's own stored samples: a run's folder is whole before its event is in the log.
        """
        due = came = 0.0
        for run in runs[-last:]:
            if run.line not in self._samples:
                with contextlib.suppress(OSError, ValueError, SessionFolderError):
                    light = pd.read_parquet(self.session.line_path(run.line, LIGHT), columns=["t_host_s"])
                    self._samples[run.line] = len(light)
            samples = self._samples.get(run.line, 0)
            if samples:
                came += samples
                due += (run.t_end_s - run.t_start_s) / self.settings.sensor.interval_s
        return min(1.0, came / due) if due else math.nan

    def sightings(self) -> Sightings:
        """Where the camera saw the LEDs, from the stored track; none where the video was not looked at yet."""
        try:
            track = pd.read_parquet(self.session.path("track.parquet"), columns=list(_TRACK))
            t_s, x_cm, y_cm, lit = np.asarray(track.sort_values("t_s"), dtype=float).T
            seen = np.isfinite(x_cm) & np.isfinite(y_cm)
            return Sightings(t_s[seen], x_cm[seen], y_cm[seen], lit[seen] > 0)
        except (OSError, ValueError, TypeError, KeyError, SessionFolderError):
            return NOTHING_SEEN

    @property
    def report(self) -> Path | None:
        """The session's report, once it is written."""
        path = self.session.folder / REPORT
        return path if path.is_file() else None

    def outline_cm(self) -> list[Floats]:
        """The shape's rings, (n, 2) each, cm."""
        geometry: Any = self.shape.geometry
        parts: Sequence[Polygon] = list(geometry.geoms) if isinstance(geometry, MultiPolygon) else [geometry]
        return [np.asarray(ring.coords)[:, :2] for part in parts for ring in (part.exterior, *part.interiors)]

    def _lines(self) -> int:
        """How many lines are wanted, by whoever asked last."""
        asked = [part["lines"] for part in self.session.manifest.get("parts", []) if part.get("lines")]
        return int(asked[-1] if asked else self.settings.stop.lines)

    def _batteries(self) -> dict[str, float]:
        devices: dict[str, Any] = self.session.manifest.get("devices") or {}
        robots: list[dict[str, Any]] = devices.get("robots") or []
        return {str(robot["name"]): float(robot["battery_v"]) for robot in robots if robot.get("battery_v") is not None}
