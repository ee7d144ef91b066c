"""Follow one LED through the frames of a static camera: predict, look there, and search the picture when lost.

Two planes tell of the LED. Luma has the finer pixels, but the projected light shines there too: on the ball, which
hides the floor, its edge runs elsewhere than on the floor (``tracking.spot``). A coloured LED also steps out of the
colour plane along its hue, which white light does not touch. Both are fitted where they tell, and joined by their
variances. What is learnt of the shell on the way serves the edges passed before, too: ``finish`` fits them again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking.background import Background
from tracking.hueplane import HuePlane, SpotRadius
from tracking.led import find_peaks
from tracking.motion import PixelMotion
from tracking.shell import ShellField
from tracking.sighting import Sighting
from tracking.spot import WINDOW, Evidence, Spot, fit_spot
from tracking.trail import Kept, Trail, choose, pieces

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
Chroma = Callable[[], "tuple[Plane, Plane] | None"]
Place = tuple[float, float, float, float]

_STRIDE = 4
# So many patches teach the shell on flat floor; then only edges have something to add.
_LESSONS = 100
# The matched response to a spot is some 0.4 of its height.
_NEW_SHARE = 0.15
# At most so many lights are followed at once.
_MOST_TRAILS = 5
# Nearer to a light that is followed, a bright spot may be the edge of its ball.
_APART_RADII = 8.0


@dataclass(frozen=True, slots=True)
class FollowSettings:
    """How the LED is looked for.

    Attributes:
        sigma_px: first guess at the spot's radius in luma; the track's first frames correct it.
        least_snr: amplitude over its standard error below which a spot is noise.
        least_explained: share of the patch's variance that a spot must explain.
        least_amplitude: least height of a spot in luma, grey levels; in colour half of it will do.
        coast_s: how long a dark LED is awaited where it should be before the whole picture is searched.
        confirm: frames in a row that a spot found by searching must be seen in before it is a light.
        q_px2_s3: how freely the spot may change its pace, spectral density of its acceleration.
        survey_s: how often the picture is searched for other lights than those that are followed.
        flat_share: the floor counts as flat where it changes by less than this share of its whole range.
    """

    sigma_px: float = 3.0
    least_snr: float = 6.0
    least_explained: float = 0.2
    least_amplitude: float = 6.0
    coast_s: float = 0.4
    confirm: int = 3
    q_px2_s3: float = 1.2e5
    survey_s: float = 0.4
    flat_share: float = 0.12


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
        hue_rad = background.hue_rad if hue_rad is None else hue_rad
        self._hue = None
        if background.chroma is not None and math.isfinite(hue_rad):
            self._hue = HuePlane(background.chroma, hue_rad, background.colour_noise)
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
        planes = chroma() if self._hue is not None and chroma is not None else None
        if at is not None:
            self._told = self._told or self._begin(*at)
            found = self._fit(self._told, luma, planes, *at) or self._look(self._told, luma, planes, *at, 8.0)
            if found is not None:
                self._add(self._told, found)
            return
        for trail in self._live:
            trail.motion.predict(dt_s, self.settings.q_px2_s3)
        looked = [(trail, self._find(trail, luma, planes)) for trail in self._live]
        for trail, found in self._one_each(looked):
            trail.move(found)
            self._add(trail, found)
        self._retire(t_s)
        # A coloured LED in sight has no rivals.
        if not self._live or (self._hue is None and t_s - self._searched_s >= self.settings.survey_s):
            self._searched_s = t_s
            self._search(luma, planes)

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
                self._refit(trail, shell, sightings)
        return sightings

    def _refit(self, trail: Trail, shell: ShellField, sightings: list[Sighting | None]) -> None:
        known = dict(zip(trail.numbers, trail.seen, strict=True))
        for kept in trail.kept:
            sighting = sightings[kept.number]
            if sighting is None or sighting.luma is None or known.get(kept.number) is not sighting:
                continue
            if kept.lessons > 0.6 * shell.lessons:
                continue
            again = fit_spot(
                kept.patch,
                sighting.luma[0] - kept.left,
                sighting.luma[1] - kept.top,
                trail.radius.sigma_px,
                floor=self.background.light,
                shell=shell.at(sighting.luma[0], sighting.luma[1]),
                noise=self.background.noise,
                origin=(kept.left, kept.top),
            )
            if again is not None and self._good(again[0], self.background.noise):
                spot = again[0]
                place = spot.x_px + kept.left, spot.y_px + kept.top, spot.var_x_px2, spot.var_y_px2
                sightings[kept.number] = replace(sighting, luma=place)

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

    def _find(self, trail: Trail, luma: Plane, planes: tuple[Plane, Plane] | None) -> Sighting | None:
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
        found = self._fit(trail, luma, planes, motion.x, motion.y, rivals)
        if found is None:
            found = self._look(trail, luma, planes, motion.x, motion.y, max(12.0, 3.0 * math.sqrt(motion.xx)))
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

    def _look(
        self, trail: Trail, luma: Plane, planes: tuple[Plane, Plane] | None, x: float, y: float, prior_px: float
    ) -> Sighting | None:
        """Look for a light about a place where no fit succeeded at once."""
        rows, columns = luma.shape
        half = int(min(20.0 + 1.3 * prior_px, 80.0))
        left, top = max(0, int(x) - half), max(0, int(y) - half)
        right, bottom = min(columns, int(x) + half + 1), min(rows, int(y) + half + 1)
        if right - left < 8 or bottom - top < 8:
            return None
        if planes is not None and self._hue is not None:
            box = np.s_[top // 2 : bottom // 2, left // 2 : right // 2]
            peaks = find_peaks(
                self._hue.plane(planes, box),
                self._hue.floor[box],
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
            found = self._fit(trail, luma, planes, *place)
            if found and trail.like_it(found) and (planes is not None or self._is_new(luma, found)):
                return found
        return None

    def _is_others(self, trail: Trail, x: float, y: float) -> bool:
        near = 1.5 * trail.radius.sigma_px
        return any(
            other is not trail and math.hypot(other.motion.x - x, other.motion.y - y) < near for other in self._live
        )

    def _search(self, luma: Plane, planes: tuple[Plane, Plane] | None) -> None:
        """Look for lights in the whole picture that are not followed yet, and begin to follow them."""
        places: list[tuple[float, float]] = []
        if planes is not None and (hue := self._hue) is not None:
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
            found = self._fit(trail, luma, planes, x, y)
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

    def _good(self, spot: Spot, noise: float, share: float = 1.0) -> bool:
        settings = self.settings
        return (
            spot.snr >= settings.least_snr
            and spot.explained >= settings.least_explained
            and spot.amplitude >= max(share * settings.least_amplitude, 2.0 * noise)
        )

    def _fit(
        self,
        trail: Trail,
        luma: Plane,
        planes: tuple[Plane, Plane] | None,
        x: float,
        y: float,
        rivals: Sequence[Trail] = (),
    ) -> Sighting | None:
        """Fit a light near a place in both planes; a coloured LED must show in colour."""
        tint = None
        if planes is not None and self._hue is not None:
            tint = self._fit_colour(trail, planes, x, y)
            if tint is None:
                return None
            x, y = 2.0 * tint.x_px + 0.5, 2.0 * tint.y_px + 0.5
        found = self._fit_luma(trail, luma, x, y, rivals)
        if tint is None:
            if found is None:
                return None
            spot, place, flat = found
            hidden = self.background.hidden_at(spot.x_px, spot.y_px, spot.beneath)
            return Sighting(place, None, spot.amplitude, spot.amplitude / spot.snr, spot.explained, flat, hidden)
        place, flat = (found[1], found[2]) if found is not None else (None, False)
        if place is not None and math.hypot(place[0] - x, place[1] - y) > 3.0:
            place, flat = None, False
        # A colour pixel j stands for the luma pixels 2 j and 2 j + 1; what the camera's siting adds is learnt later.
        colour = (x, y, 4.0 * tint.var_x_px2, 4.0 * tint.var_y_px2)
        return Sighting(place, colour, tint.amplitude, tint.amplitude / tint.snr, tint.explained, flat)

    def _fit_colour(self, trail: Trail, planes: tuple[Plane, Plane], x: float, y: float) -> Spot | None:
        hue, radius = self._hue, trail.colour_radius
        if hue is None:
            return None
        rows, columns = hue.floor.shape
        x, y = (x - 0.5) / 2.0, (y - 0.5) / 2.0
        half = math.ceil(WINDOW * radius.sigma_px) + 2
        left, top = max(0, round(x) - half), max(0, round(y) - half)
        box = np.s_[top : min(rows, round(y) + half + 1), left : min(columns, round(x) + half + 1)]
        fitted = fit_spot(hue.plane(planes, box), x - left, y - top, radius.sigma_px, free_sigma=radius.is_free)
        if fitted is None or not self._good(fitted[0], hue.noise, 0.5):
            return None
        radius.learn(fitted[0])
        return replace(fitted[0], x_px=fitted[0].x_px + left, y_px=fitted[0].y_px + top)

    def _fit_luma(
        self, trail: Trail, luma: Plane, x: float, y: float, rivals: Sequence[Trail]
    ) -> tuple[Spot, Place, bool] | None:
        floor, radius, field = self.background, trail.radius, trail.shell
        uneven = floor.uneven_at(x, y)
        flat = uneven < self.settings.flat_share
        learn = not flat or field.lessons < _LESSONS
        shell = (field.at if learn else field.mean_at)(x, y)
        half = math.ceil(WINDOW * radius.sigma_px) + 6
        fits: list[tuple[Plane | Floats32, int, int]] = [(luma, 0, 0)]
        if rivals:
            fits.append(self._without(rivals, luma, x, y, 2 * half))
        best: tuple[Spot, Evidence | None] | None = None
        for picture, left, top in fits:
            fitted = fit_spot(
                picture, x - left, y - top, radius.sigma_px, free_sigma=radius.is_free, floor=floor.light,
                shell=shell, learn=learn, noise=floor.noise, origin=(left, top),
            )  # fmt: skip
            if fitted is not None and (best is None or fitted[0].explained > best[0].explained):
                best = replace(fitted[0], x_px=fitted[0].x_px + left, y_px=fitted[0].y_px + top), fitted[1]
        if best is None or not self._good(best[0], floor.noise):
            return None
        spot, evidence = best
        if rivals:
            mixed = trail.mixed_px2
            return spot, (spot.x_px, spot.y_px, spot.var_x_px2 + mixed, spot.var_y_px2 + mixed), flat
        if flat:
            radius.learn(spot)
        if evidence is not None and not radius.is_free:
            field.learn(spot.x_px, spot.y_px, evidence)
        if not flat:
            left, top = max(0, int(spot.x_px) - half), max(0, int(spot.y_px) - half)
            patch = luma[top : int(spot.y_px) + half + 1, left : int(spot.x_px) + half + 1].copy()
            trail.kept.append(Kept(len(self._times_s) - 1, patch, left, top, field.lessons))
        return spot, (spot.x_px, spot.y_px, spot.var_x_px2, spot.var_y_px2), flat

    def _without(
        self, rivals: Sequence[Trail], luma: Plane, x: float, y: float, half: int
    ) -> tuple[Floats32, int, int]:
        """A patch about a place without the other lights there, as far as they are known; its left and top."""
        left, top = max(0, int(x) - half), max(0, int(y) - half)
        patch = luma[top : int(y) + half + 1, left : int(x) + half + 1].astype(np.float32)
        columns, rows = (
            np.arange(n, dtype=np.float32) + o for n, o in zip(patch.shape[::-1], (left, top), strict=True)
        )
        for rival in rivals:
            height = float(np.median([seen.amplitude for seen in rival.seen[-9:]]))
            spread = 2.0 * rival.radius.sigma_px**2
            across = np.exp(-((columns - np.float32(rival.motion.x)) ** 2) / spread)
            patch -= height * np.exp(-((rows - np.float32(rival.motion.y)) ** 2) / spread)[:, None] * across
        return np.asarray(patch, dtype=np.float32), left, top
