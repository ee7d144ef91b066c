"""One light near a place, fitted in the two planes that tell of it.

Luma has the finer pixels, but the projected light shines there too: on the ball, which hides the floor, its edge runs
elsewhere than on the floor (``tracking.spot``). A coloured LED also steps out of the colour plane along its hue, which
white light does not touch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking.background import Background
from tracking.hueplane import HuePlane
from tracking.shell import ShellField
from tracking.sighting import Sighting
from tracking.spot import Evidence, Spot, fit_spot
from tracking.spotkernels import WINDOW
from tracking.trail import Kept, Trail

Plane = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
Place = tuple[float, float, float, float]

# So many patches teach the shell on flat floor; then only edges have something to add.
_LESSONS = 100


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


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A frame as the LED is looked for in it.

    Attributes:
        number: of the frame among those that were looked at.
        luma: (h, w).
        planes: (U, V), (h / 2, w / 2) each; None where colour does not tell.
    """

    number: int
    luma: Plane
    planes: tuple[Plane, Plane] | None


class LightFitter:
    """Fits lights before a floor.

    Args:
        background: the empty floor.
        settings: what a spot must be to count.
        hue_rad: the direction atan2(V, U) of the LED's colour; NaN: colour does not tell.

    Attributes:
        hue: the plane in which the LED's colour shows; None where it does not tell.
    """

    def __init__(self, background: Background, settings: FollowSettings, hue_rad: float) -> None:
        self._background = background
        self._settings = settings
        self.hue: HuePlane | None = None
        if background.chroma is not None and math.isfinite(hue_rad):
            self.hue = HuePlane(background.chroma, hue_rad, background.colour_noise)

    def fit(
        self,
        trail: Trail,
        picture: Picture,
        x: float,
        y: float,
        rivals: Sequence[Trail] = (),
    ) -> Sighting | None:
        """Fit a light near a place in both planes; a coloured LED must show in colour.

        ``rivals``: other lights near by, which are taken away first. ``trail`` learns its radius and shell.
        """
        tint = None
        if picture.planes is not None and self.hue is not None:
            tint = self._fit_colour(trail, picture.planes, x, y)
            if tint is None:
                return None
            x, y = 2.0 * tint.x_px + 0.5, 2.0 * tint.y_px + 0.5
        found = self._fit_luma(trail, picture, x, y, rivals)
        if tint is None:
            if found is None:
                return None
            spot, place, flat = found
            hidden = self._background.hidden_at(spot.x_px, spot.y_px, spot.beneath)
            return Sighting(place, None, spot.amplitude, spot.amplitude / spot.snr, spot.explained, flat, hidden)
        place, flat = (found[1], found[2]) if found is not None else (None, False)
        if place is not None and math.hypot(place[0] - x, place[1] - y) > 3.0:
            place, flat = None, False
        # A colour pixel j stands for the luma pixels 2 j and 2 j + 1; what the camera's siting adds is learnt later.
        colour = (x, y, 4.0 * tint.var_x_px2, 4.0 * tint.var_y_px2)
        return Sighting(place, colour, tint.amplitude, tint.amplitude / tint.snr, tint.explained, flat)

    def _fit_colour(self, trail: Trail, planes: tuple[Plane, Plane], x: float, y: float) -> Spot | None:
        hue, radius = self.hue, trail.colour_radius
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
        self, trail: Trail, picture: Picture, x: float, y: float, rivals: Sequence[Trail]
    ) -> tuple[Spot, Place, bool] | None:
        floor, luma, radius, field = self._background, picture.luma, trail.radius, trail.shell
        uneven = floor.uneven_at(x, y)
        flat = uneven < self._settings.flat_share
        learn = not flat or field.lessons < _LESSONS
        shell = (field.at if learn else field.mean_at)(x, y)
        half = math.ceil(WINDOW * radius.sigma_px) + 6
        fits: list[tuple[Plane | Floats32, int, int]] = [(luma, 0, 0)]
        if rivals:
            fits.append(self._without(rivals, luma, x, y, 2 * half))
        best: tuple[Spot, Evidence | None] | None = None
        for patch, left, top in fits:
            fitted = fit_spot(
                patch, x - left, y - top, radius.sigma_px, free_sigma=radius.is_free, floor=floor.light,
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
            again = luma[top : int(spot.y_px) + half + 1, left : int(spot.x_px) + half + 1].copy()
            trail.kept.append(Kept(picture.number, again, left, top, field.lessons))
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

    def refit(self, trail: Trail, shell: ShellField, sightings: list[Sighting | None]) -> None:
        """Fit what a trail kept once more, now that its shell is known; ``sightings`` take the better places."""
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
                floor=self._background.light,
                shell=shell.at(sighting.luma[0], sighting.luma[1]),
                noise=self._background.noise,
                origin=(kept.left, kept.top),
            )
            if again is not None and self._good(again[0], self._background.noise):
                spot = again[0]
                place = spot.x_px + kept.left, spot.y_px + kept.top, spot.var_x_px2, spot.var_y_px2
                sightings[kept.number] = replace(sighting, luma=place)

    def _good(self, spot: Spot, noise: float, share: float = 1.0) -> bool:
        settings = self._settings
        return (
            spot.snr >= settings.least_snr
            and spot.explained >= settings.least_explained
            and spot.amplitude >= max(share * settings.least_amplitude, 2.0 * noise)
        )
