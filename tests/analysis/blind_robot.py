"""A robot that rolls blindly over a shape, made of numpy, shapely and the real detector alone: truth for the sensor."""

from dataclasses import dataclass

import numpy as np
import shapely

from robot.crossings import Levels, crossings_of


@dataclass(frozen=True)
class BlindRobot:
    """Light from 0 to 1; ``points`` of a sunflower stand for the footprint's disc."""

    step_cm: float
    footprint_cm: float
    margin: float = 0.06
    noise: float = 0.01
    speed_sigma: float = 0.02
    points: int = 60

    def roll(self, geometry, lines, rng):
        """(lines, 3) of (k, 𝓛_1, 𝓛_3): isotropic uniform lines on which something was seen."""
        shapely.prepare(geometry)
        centre = shapely.minimum_bounding_circle(geometry).centroid
        radius = shapely.minimum_bounding_radius(geometry) + self.footprint_cm
        levels = Levels(0.0, 1.0, 0.5 - self.margin, 0.5, 0.5 + self.margin)
        seen = []
        while len(seen) < lines:
            angle, p = rng.uniform(0, 2 * np.pi), rng.uniform(-radius, radius)
            along = np.array([np.cos(angle), np.sin(angle)])
            speed = 1 + self.speed_sigma * rng.standard_normal()
            step = self.step_cm * speed
            s = step * (np.arange(int(2 * radius / step) + 5) - 2 + rng.random()) - radius
            x, y = centre.x - along[1] * p + along[0] * s, centre.y + along[0] * p + along[1] * s
            light = self.light(geometry, x, y) + self.noise * rng.standard_normal(s.size)
            places = [crossing.s_cm for crossing in crossings_of(s, s / speed, light, levels)]
            if places:
                seen.append(invariants(np.array(places)))
        return np.array(seen)

    def light(self, geometry, x, y):
        i = np.arange(self.points) + 0.5
        r, turn = self.footprint_cm * np.sqrt(i / self.points), np.pi * (1 + np.sqrt(5)) * i
        return shapely.contains_xy(geometry, x[:, None] + r * np.cos(turn), y[:, None] + r * np.sin(turn)).mean(axis=1)


def invariants(places):
    """(k, 𝓛_1, 𝓛_3) by their definition over pairs of crossings."""
    sign = np.where(np.arange(len(places)) % 2 == 0, 1, -1)
    distance = np.abs(places[:, None] - places)
    pairs = -np.outer(sign, sign) * np.triu(np.ones_like(distance), 1)
    return len(places) / 2, (pairs * distance).sum(), (pairs * distance**3).sum()
