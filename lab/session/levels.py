"""The light levels of a session, and what each robot read under plain light to learn them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robot.crossings import Levels, learn_levels
from robot.edge import EdgeLevels, learn_edge_levels


@dataclass(frozen=True, slots=True)
class SessionLevels:
    """The light levels of a session: of the shape, and of the ring where light marks the edge."""

    shape: Levels
    edge: EdgeLevels | None = None


@dataclass(frozen=True, slots=True)
class PlainLight:
    """What one robot read under plain fields of light, in lux: what its levels were learnt from."""

    floor: Sequence[float]
    lit: Sequence[float]
    ring: Sequence[float] | None

    def levels(self) -> SessionLevels:
        """The light levels. Raises LevelsError when they do not separate."""
        edge = None if self.ring is None else learn_edge_levels(self.floor, self.lit, self.ring)
        return SessionLevels(learn_levels(self.floor, self.lit), edge)
