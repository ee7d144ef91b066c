"""Follow one LED through the frames of a static camera: predict, look there, and search the picture when lost.

Two planes tell of the LED, luma and the colour along its hue: both are fitted where they tell (``tracking.lightfit``),
and joined by their variances. What is learnt of the shell on the way serves the edges passed before, too: ``finish``
fits them again.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tracking.background import Background
from tracking.hueplane import SpotRadius
from tracking.led import find_peaks
from tracking.lightfit import FollowSettings, LightFitter, Picture
from tracking.motion import PixelMotion
from tracking.shell import ShellField
from tracking.sighting import Sighting
from tracking.spotkernels import WINDOW
from tracking.trail import Trail, choose, pieces

Plane = NDArray[np.uint8]
Chroma = Callable[[], "tuple[Plane, Plane] | None"]

_STRIDE = 4
# The matched response to a spot is some 0.4 of its height.
_NEW_SHARE = 0.15
# At most so many lights are followed at once.
_MOST_TRAILS = 5
# Nearer to a light that is followed, a bright spot may be the edge of its ball.
_APART_RADII = 8.0


class LedFollower:
    """Follows one LED: give it the frames in order, then ask ``finish`` for what was seen.

    One follower a robot; followers share nothing but the background. Where somebody else knows about where each
    robot's LED is (``identity`` of several robots), hand that place to ``step`` as ``at``: then nothing is predicted
    nor searched for, and the LED is looked for within a few pixels of it.

    Without colour, whatever shines may be the LED: all lights are followed side by side (``tracking.trail``), each by
    itself, and only ``finish`` says which of them it was.

    Args:
        background: the empty floor.
        settings: how to look.
        hue_rad: the direction atan2(V, U) of this LED's colour, by default the one that the background's samples
            showed; NaN: colour does not tell (a white LED, a grey camera).
    """

    def __init__(
        self, background: Background, settings: FollowSettings | None = None, *, hue_rad: float | None = None
    ) -> None:
        self.background = background
        self.settings = settings or FollowSettings()
        self._fitter = LightFitter(background, self.settings, background.hue_rad if hue_rad is None else hue_rad)
        self._small_luma = np.ascontiguousarray(background.luma[::_STRIDE, ::_STRIDE])
        small_light = background.light[::_STRIDE, ::_STRIDE]
        self._half_lit = 0.5 * float(sum(np.percentile(small_light, (0.5, 99.5))))
        self._live: list[Trail] = []
        self._done: list[Trail] = []
        self._told: Trail | None = None
        self._best: tuple[float, Trail] | None = None
        self._times_s: list[float] = []
        self._searched_s = -math.inf

    def step(
        self, t_s: float, luma: Plane, chroma: Chroma | None = None, *, at: tuple[float, float] | None = None
    ) -> None:
        """Look at the next frame.

        Args:
            t_s: its time.
            luma: (h, w) its luma.
            chroma: gives its planes (U, V) when called, as ``VideoFrame.chroma`` does; None in a grey video.
            at: (x, y) in px, about where the LED is, if that is known from elsewhere.
        """
        dt_s = max(0.0, t_s - self._times_s[-1]) if self._times_s else 0.0
        self._times_s.append(t_s)
        planes = chroma() if self._fitter.hue is not None and chroma is not None else None
        picture = Picture(len(self._times_s) - 1, luma, planes)
        if at is not None:
            self._told = self._told or self._begin(*at)
            found = self._fitter.fit(self._told, picture, *at) or self._look(self._told, picture, *at, 8.0)
            if found is not None:
                self._add(self._told, found)
            return
        for trail in self._live:
            trail.motion.predict(dt_s, self.settings.q_px2_s3)
        looked = [(trail, self._find(trail, picture)) for trail in self._live]
        for trail, found in self._one_each(looked):
            trail.move(found)
            self._add(trail, found)
        self._retire(t_s)
        # A coloured LED in sight has no rivals.
        if not self._live or (self._fitter.hue is None and t_s - self._searched_s >= self.settings.survey_s):
            self._searched_s = t_s
            self._search(picture)

    def finish(self) -> list[Sighting | None]:
        """Choose the LED among the lights that were followed; give its sightings, one a frame, None where not seen.

        Frames near edges are fitted again with all that was learnt of the shell by then.
        """
        sightings: list[Sighting | None] = [None] * len(self._times_s)
        if self._told is not None:
            chain = list(pieces([self._told]))
        else:
            lasting = [trail for trail in self._done + self._live if len(trail.seen) >= self.settings.confirm]
            chain = choose(lasting, self._times_s, self.background.luma.shape[1])
        trails: list[Trail] = []
        for piece in chain:
            trail = piece.trail
            trails += [] if trail in trails else [trail]
            for number, sighting in zip(
                trail.numbers[piece.first : piece.last], trail.seen[piece.first : piece.last], strict=True
            ):
                sightings[number] = sighting
        if trails:
            shell = max((trail.shell for trail in trails), key=lambda shell: shell.lessons)
            for trail in trails:
                self._fitter.refit(trail, shell, sightings)
        return sightings

    def _begin(self, x: float, y: float) -> Trail:
        """A new trail, which knows of the shell what the best one so far does."""
        best = self._best
        for trail in self._live:
            if trail.seen and (best is None or trail.worth() > best[0]):
                best = trail.worth(), trail
        height, width = self.background.luma.shape
        return Trail(
            motion=PixelMotion(x, y),
            radius=SpotRadius(self.settings.sigma_px),
            colour_radius=SpotRadius(self.settings.sigma_px / 2.0),
            shell=best[1].shell.copy() if best else ShellField((width, height)),
            last_s=self._times_s[-1],
        )

    def _add(self, trail: Trail, found: Sighting) -> None:
        light = self.background.light
        x, y = found.position
        lit = light[min(max(round(y), 0), len(light) - 1), min(max(round(x), 0), light.shape[1] - 1)]
        trail.add(len(self._times_s) - 1, self._times_s[-1], found, bool(lit > self._half_lit))

    def _retire(self, t_s: float) -> None:
        """Give up lights that were out of sight for too long, and spots that did not last."""
        live: list[Trail] = []
        for trail in self._live:
            pending = len(trail.seen) < self.settings.confirm
            if t_s - trail.last_s <= (0.0 if pending else self.settings.coast_s):
                live.append(trail)
            elif not pending:
                self._done.append(trail)
                worth = trail.worth()
                if self._best is None or worth > self._best[0]:
                    self._best = worth, trail
        self._live = live

    def _find(self, trail: Trail, picture: Picture) -> Sighting | None:
        """Look for a light where it should be by now."""
        motion = trail.motion
        reach = 2.0 * WINDOW * trail.radius.sigma_px
        apart = [
            (math.hypot(other.motion.x - motion.x, other.motion.y - motion.y), other)
            for other in self._live
            if other is not trail
        ]
        rivals = [other for apart_px, other in apart if apart_px < reach]
        trail.meet(min((apart_px for apart_px, _ in apart if apart_px < reach), default=math.inf))
        found = self._fitter.fit(trail, picture, motion.x, motion.y, rivals)
        if found is None:
            found = self._look(trail, picture, motion.x, motion.y, max(12.0, 3.0 * math.sqrt(motion.xx)))
        return found

    def _one_each(self, looked: list[tuple[Trail, Sighting | None]]) -> list[tuple[Trail, Sighting]]:
        """One light a sighting: of two trails that end in the same spot, the one that was expected there has it."""
        found = [(trail, sighting) for trail, sighting in looked if sighting is not None]
        found.sort(
            key=lambda one: math.hypot(one[1].position[0] - one[0].motion.x, one[1].position[1] - one[0].motion.y)
        )
        taken: list[tuple[Trail, Sighting]] = []
        for trail, sighting in found:
            x, y = sighting.position
            apart = (math.hypot(x - s.position[0], y - s.position[1]) for _, s in taken)
            if all(one > 0.5 * trail.radius.sigma_px for one in apart):
                taken.append((trail, sighting))
        return taken

    def _look(self, trail: Trail, picture: Picture, x: float, y: float, prior_px: float) -> Sighting | None:
        """Look for a light about a place where no fit succeeded at once."""
        luma, planes, hue = picture.luma, picture.planes, self._fitter.hue
        rows, columns = luma.shape
        half = int(min(20.0 + 1.3 * prior_px, 80.0))
        left, top = max(0, int(x) - half), max(0, int(y) - half)
        right, bottom = min(columns, int(x) + half + 1), min(rows, int(y) + half + 1)
        if right - left < 8 or bottom - top < 8:
            return None
        if planes is not None and hue is not None:
            box = np.s_[top // 2 : bottom // 2, left // 2 : right // 2]
            peaks = find_peaks(
                hue.plane(planes, box),
                hue.floor[box],
                trail.colour_radius.sigma_px,
                near=((x - left) / 2.0, (y - top) / 2.0),
                prior_sigma_px=prior_px / 2.0,
            )
            places = [(2.0 * (px + left // 2) + 0.5, 2.0 * (py + top // 2) + 0.5) for px, py, _ in peaks]
        else:
            box = np.s_[top:bottom, left:right]
            peaks = find_peaks(
                luma[box],
                self.background.luma[box],
                trail.radius.sigma_px,
                count=2,
                near=(x - left, y - top),
                prior_sigma_px=prior_px,
            )
            places = [(px + left, py + top) for px, py, _ in peaks]
            places = [place for place in places if not self._is_others(trail, *place)]
        for place in places:
            found = self._fitter.fit(trail, picture, *place)
            if found and trail.like_it(found) and (planes is not None or self._is_new(luma, found)):
                return found
        return None

    def _is_others(self, trail: Trail, x: float, y: float) -> bool:
        near = 1.5 * trail.radius.sigma_px
        return any(
            other is not trail and math.hypot(other.motion.x - x, other.motion.y - y) < near for other in self._live
        )

    def _search(self, picture: Picture) -> None:
        """Look for lights in the whole picture that are not followed yet, and begin to follow them."""
        luma, planes, hue = picture.luma, picture.planes, self._fitter.hue
        places: list[tuple[float, float]] = []
        if planes is not None and hue is not None:
            sigma_px = self.settings.sigma_px / 2.0
            peaks = find_peaks(hue.plane(planes, np.s_[:, :]), hue.floor, sigma_px, count=3, least=4.0 * hue.noise)
            places = [(2.0 * x + 0.5, 2.0 * y + 0.5) for x, y, _ in peaks]
        else:
            small = np.ascontiguousarray(luma[::_STRIDE, ::_STRIDE])
            sigma_px, least = max(1.0, self.settings.sigma_px / _STRIDE), 2.0 * self.background.noise
            peaks = find_peaks(small, self._small_luma, sigma_px, count=_MOST_TRAILS, least=least)
            places = [(x * _STRIDE, y * _STRIDE) for x, y, _ in peaks]
            places = [self._climb(luma, *place) for place in places if not self._is_followed(*place)]
        for x, y in places:
            if len(self._live) >= _MOST_TRAILS or self._is_followed(x, y):
                continue
            trail = self._begin(x, y)
            found = self._fitter.fit(trail, picture, x, y)
            if found is not None and (planes is not None or self._is_new(luma, found)):
                trail.motion = PixelMotion(*found.position)
                trail.move(found)
                self._add(trail, found)
                self._live.append(trail)

    def _is_followed(self, x: float, y: float) -> bool:
        near = _APART_RADII * self.settings.sigma_px
        return any(math.hypot(x - other.motion.x, y - other.motion.y) < near for other in self._live)

    def _is_new(self, luma: Plane, sighting: Sighting) -> bool:
        """Whether the floor lacks a spot that was found: a reflection that was always there is none."""
        x, y = (round(value) for value in sighting.position)
        sigma_px = self.settings.sigma_px
        reach = math.ceil(4.0 * sigma_px)
        box = np.s_[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1]
        peaks = find_peaks(luma[box], self.background.luma[box], sigma_px)
        return bool(peaks) and peaks[0][2] > _NEW_SHARE * sighting.amplitude

    def _climb(self, luma: Plane, x: float, y: float) -> tuple[float, float]:
        """Find the peak at full resolution near a strided one."""
        half = 6 * _STRIDE
        left, top = max(0, int(x) - half), max(0, int(y) - half)
        box = np.s_[top : int(y) + half + 1, left : int(x) + half + 1]
        peaks = find_peaks(
            luma[box],
            self.background.luma[box],
            self.settings.sigma_px,
            near=(x - left, y - top),
            prior_sigma_px=2.0 * _STRIDE,
        )
        return (peaks[0][0] + left, peaks[0][1] + top) if peaks else (x, y)
