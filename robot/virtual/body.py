"""The body of the virtual robot: a ball that rolls in an arena, runs into its walls and sees the light below it.

It moves only when it is asked how far it has come (``advance``), in closed form between the instants at
which something changes, so where it is does not depend on how often it is asked. Where several share an
arena, a ``Crowd`` moves them on together.

Angles: ``facing_rad`` is counter-clockwise from the arena's x axis; headings are clockwise in the robot's
own frame. With the frame's forward axis at the arena angle F, heading h is the arena angle F - h.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto

from numpy.random import Generator
from shapely.geometry import Polygon

from lab.base.errors import RequestError
from robot.virtual.lightsensor import LightAt, LightSensor
from robot.virtual.physics import BodySettings, Impact, Together
from robot.virtual.walls import Hit, Walls

TURN = 2.0 * math.pi
# A drift bends the path; it is followed in chords of at most this time, and of this sagitta near a wall.
_MAX_STEP_S = 0.1
_SAGITTA_CM = 1e-6


class _Next(Enum):
    """What a ball does next."""

    REST = auto()
    TURN = auto()
    ROLL = auto()


class Body:
    """A rolling ball.

    Args:
        reachable: Convex polygon that the ball's centre moves in, arena cm.
        light_at: Light in lux, at the sensor's height, for arrays x and y of arena cm, shape (n,) each.
        rng: Source of every draw.
        settings: The physics.
        position_cm: Where it starts; drawn evenly over ``reachable`` when not given.
        facing_rad: The arena angle that it faces; drawn when not given. Its frame starts along it.

    Attributes:
        x_cm, y_cm: The ball's centre in the arena.
        speed_cm_s: Speed now.
        distance_cm: Path rolled since the start.
        led_level: Brightness of its LED, 0 to 1.
        led_rgb: The same for its red, green and blue light.
        on_bump: Called from within ``advance`` for each ``Impact``.
        stuck_lux: What the light sensor reads whatever it sees; None while it works.
        battery_charge: 0 (empty) to 1, falling with time.
        crowd: The crowd that it is a member of, which then moves it; set by the crowd.
        beside: Unit vectors, arena frame, from each ball that it touches to it; set by the crowd.

    Raises:
        RequestError: ``reachable`` is empty or not convex, or ``position_cm`` is outside it.
    """

    def __init__(
        self,
        reachable: Polygon,
        light_at: LightAt,
        rng: Generator,
        settings: BodySettings | None = None,
        *,
        position_cm: tuple[float, float] | None = None,
        facing_rad: float | None = None,
    ) -> None:
        self.settings = settings if settings is not None else BodySettings()
        self._rng = rng
        self._walls = Walls(reachable)
        self.x_cm, self.y_cm = self._walls.draw(rng) if position_cm is None else position_cm
        if not self._walls.contains(self.x_cm, self.y_cm):
            raise RequestError(f"virtual robot: its start ({self.x_cm:g}, {self.y_cm:g}) cm is outside the arena")
        self.speed_cm_s = 0.0
        self.distance_cm = 0.0
        self.led_level = 0.0
        self.led_rgb = (0.0, 0.0, 0.0)
        self.on_bump: Callable[[Impact], None] | None = None
        self.stuck_lux: float | None = None
        self.battery_charge = 1.0
        self.crowd: Together | None = None
        self.beside: tuple[tuple[float, float], ...] = ()
        self._held = False
        self._t_s: float | None = None
        # Frame: arena angle of heading 0 as it truly is; the gyro's drift turns it without the robot knowing.
        self._frame_rad: float = float(rng.uniform(0.0, TURN)) if facing_rad is None else facing_rad
        self._heading_rad = 0.0
        self._wanted_heading_rad = 0.0
        self._wanted_speed_cm_s = 0.0
        self._spin_rad_s = 0.0
        self._deadline_s = math.inf
        self._gain = 1.0
        self._drift_rad_per_cm = 0.0
        self._pressed = False
        self._locator_scale = (
            1.0 + self.settings.locator_bias + self.settings.locator_error * float(rng.standard_normal())
        )
        self._locator_x_cm = 0.0
        self._locator_y_cm = 0.0
        self._light_sensor = LightSensor(light_at, rng, self.settings)

    @property
    def t_s(self) -> float:
        """The instant it has been advanced to; 0 before the first ``advance``."""
        return 0.0 if self._t_s is None else self._t_s

    @property
    def started(self) -> bool:
        """Whether its clock has been set."""
        return self._t_s is not None

    @property
    def facing_rad(self) -> float:
        """Arena angle that it faces, counter-clockwise from x, in [0, 2π)."""
        return (self._frame_rad - self._heading_rad) % TURN

    @property
    def heading_rad(self) -> float:
        """Heading that it believes to face, clockwise in its own frame."""
        return self._heading_rad

    @property
    def locator_cm(self) -> tuple[float, float]:
        """Odometer: x (right) and y (forward) in the robot's frame."""
        return self._locator_x_cm, self._locator_y_cm

    @property
    def locator_speed_cm_s(self) -> float:
        """Speed as the odometer measures it."""
        return self.speed_cm_s * self._locator_scale

    @property
    def battery_v(self) -> float:
        """Battery voltage, V, falling evenly with its charge."""
        settings = self.settings
        return settings.battery_empty_v + (settings.battery_full_v - settings.battery_empty_v) * self.battery_charge

    @property
    def moving(self) -> bool:
        """Whether it rolls, or is told to."""
        return self.speed_cm_s > 0 or self._wanted_speed_cm_s > 0

    @property
    def held(self) -> bool:
        """Whether its wheels are held: told to roll or turn it does not, and neither rolls nor bumps.

        Setting it stops the ball on the spot, so ``advance`` to the present first.
        """
        return self._held

    @held.setter
    def held(self, held: bool) -> None:
        self._held = held
        if held:
            self.speed_cm_s = 0.0

    @property
    def pressed(self) -> bool:
        """Whether it stands against a wall, or a ball, that its heading points into."""
        return self._pressed or self._faces_ball()

    def drive(self, heading_rad: float, speed_cm_s: float) -> None:
        """Roll along ``heading_rad`` at ``speed_cm_s`` from the present instant; speed 0 brakes.

        The same heading again only moves the time-out on. Another one makes it brake, turn on the spot
        and roll off: a new run, with its own errors.
        """
        rng, settings = self._rng, self.settings
        turned = abs(math.remainder(heading_rad - self._wanted_heading_rad, TURN)) > 1e-6
        if speed_cm_s > 0 and (turned or self._wanted_speed_cm_s == 0):
            self._gain = max(0.0, 1.0 + settings.speed_error * float(rng.standard_normal()))
            drift = settings.drift_rad_per_cm * float(rng.standard_normal())
            self._drift_rad_per_cm = drift - settings.drift_bias_rad_per_cm
        self._wanted_heading_rad = heading_rad % TURN
        self._wanted_speed_cm_s = max(0.0, speed_cm_s)
        self._spin_rad_s = 0.0
        self._deadline_s = self.t_s + settings.drive_timeout_s if speed_cm_s > 0 else math.inf

    def stop(self) -> None:
        """Brake, heading as before."""
        self.drive(self._wanted_heading_rad, 0.0)

    def spin(self, rate_rad_s: float) -> None:
        """Brake, then turn on the spot, clockwise positive, until driven, stopped or timed out."""
        self.stop()
        self._spin_rad_s = rate_rad_s
        self._deadline_s = self.t_s + self.settings.drive_timeout_s

    def reset_yaw(self) -> None:
        """Make the way it faces now heading 0."""
        self._frame_rad = self.facing_rad
        self._heading_rad = 0.0
        self._wanted_heading_rad = 0.0

    def reset_locator(self) -> None:
        """Make the present position the odometer's origin."""
        self._locator_x_cm = 0.0
        self._locator_y_cm = 0.0

    def light_lux(self) -> float:
        """One reading of the light sensor where it stands: footprint mean, own LED and noise, lux (>= 0)."""
        if self.stuck_lux is not None:
            return self.stuck_lux
        return self._light_sensor.read_lux(self.x_cm, self.y_cm, self.led_level)

    def advance(self, t_s: float) -> None:
        """Move on to the instant ``t_s``, with its crowd if it has one; an instant already passed changes nothing.

        The first call sets the clock.
        """
        if self.crowd is not None:
            self.crowd.advance(t_s)
        else:
            self.advance_alone(t_s)

    def advance_alone(self, t_s: float) -> None:
        """``advance`` with no eye for other balls: what a crowd moves its members by."""
        if self._t_s is None:
            self._t_s = t_s
            return
        while self._t_s < t_s:
            if self._t_s >= self._deadline_s:
                self._wanted_speed_cm_s = 0.0
                self._spin_rad_s = 0.0
                self._deadline_s = math.inf
            self._step(self._t_s, min(t_s, self._deadline_s) - self._t_s)

    def touch(self, normal_rad: float, closing_cm_s: float | None = None) -> None:
        """Run into something here that is no wall: feel an impact, and stop unless it moves away from it.

        Args:
            normal_rad: Arena angle from the thing to the ball.
            closing_cm_s: Speed at which they met; its own across the normal when not given.
        """
        facing_rad = self.facing_rad
        into_cm_s = -self.speed_cm_s * math.cos(normal_rad - facing_rad)
        if into_cm_s > 0:
            self.speed_cm_s = 0.0
        self._bump(normal_rad, max(0.0, into_cm_s) if closing_cm_s is None else closing_cm_s)

    def outlook(self, dt_s: float) -> tuple[float, float, float]:
        """How it moves next, for whoever must not miss its meeting with something that moves too.

        Args:
            dt_s: Longest time of interest.

        Returns:
            The time, at most ``dt_s``, for which its speed is sure to change evenly; the rate at which it
            then does, cm/s²; and the most that its path may bend away meanwhile, cm/s².
        """
        if self.t_s >= self._deadline_s:
            return 0.0, 0.0, 0.0
        next_up, step_s, acceleration, end_cm_s = self._plan(min(dt_s, self._deadline_s - self.t_s))
        if next_up is not _Next.ROLL:
            return step_s, 0.0, 0.0
        while True:
            way_cm, _, hit = self._path(step_s, end_cm_s)
            if hit is None or not self._bends(way_cm):
                break
            step_s /= 2.0
            end_cm_s = self.speed_cm_s + acceleration * step_s
        if hit is not None:
            step_s = min(step_s, self._time_to(hit.distance_cm, acceleration)[0])
        bend = abs(self._drift_rad_per_cm) * max(self.speed_cm_s, end_cm_s) ** 2
        return step_s, acceleration, bend

    def _step(self, t_s: float, dt_s: float) -> None:
        """Live through at most ``dt_s`` in which the acceleration does not change."""
        next_up, step_s, acceleration, end_cm_s = self._plan(dt_s)
        if next_up is _Next.ROLL:
            self._roll(t_s, step_s, acceleration, end_cm_s)
        elif next_up is _Next.TURN:
            self._turn(t_s, dt_s)
        else:
            if self._spin_rad_s and not self._held:
                self._heading_rad = (self._heading_rad + self._spin_rad_s * dt_s) % TURN
                self._wanted_heading_rad = self._heading_rad
                self._pressed = False
            self.battery_charge = max(0.0, self.battery_charge - dt_s / self.settings.battery_rest_s)
            self._t_s = t_s + dt_s

    def _plan(self, dt_s: float) -> tuple[_Next, float, float, float]:
        """What comes next, for at most ``dt_s``: what it does, for how long, acceleration and end speed."""
        if self._held:
            return _Next.REST, dt_s, 0.0, 0.0
        settings = self.settings
        speed = self.speed_cm_s
        aim_cm_s = self._wanted_speed_cm_s * self._gain
        astray = abs(math.remainder(self._wanted_heading_rad - self._heading_rad, TURN))
        # Told to roll or not, it faces the heading that it was given last; a spin gives it none.
        if astray > 1e-9 and not self._spin_rad_s:
            if speed <= 0:
                return _Next.TURN, min(dt_s, astray / settings.turn_rate_rad_s), 0.0, 0.0
            aim_cm_s = 0.0
        if speed <= 0 and (aim_cm_s == 0 or self._faces_wall() or self._faces_ball()):
            return _Next.REST, dt_s, 0.0, 0.0
        acceleration = 0.0
        until_s = math.inf
        if speed != aim_cm_s:
            acceleration = math.copysign(settings.acceleration_cm_s2, aim_cm_s - speed)
            until_s = (aim_cm_s - speed) / acceleration
        step_s = min(dt_s, _MAX_STEP_S, until_s)
        return _Next.ROLL, step_s, acceleration, aim_cm_s if step_s == until_s else speed + acceleration * step_s

    def _turn(self, t_s: float, dt_s: float) -> None:
        """Turn on the spot towards the wanted heading, the short way."""
        left = math.remainder(self._wanted_heading_rad - self._heading_rad, TURN)
        turned_s = min(dt_s, abs(left) / self.settings.turn_rate_rad_s)
        if turned_s < dt_s:
            self._heading_rad = self._wanted_heading_rad
        else:
            self._heading_rad = (
                self._heading_rad + math.copysign(self.settings.turn_rate_rad_s * turned_s, left)
            ) % TURN
        self._pressed = False
        self.battery_charge = max(0.0, self.battery_charge - turned_s / self.settings.battery_rest_s)
        # A turn that ends within one rounding of t_s must still end.
        self._t_s = max(t_s + turned_s, math.nextafter(t_s, math.inf))

    def _faces_wall(self) -> bool:
        """Whether it stands against a wall that it faces: it pushes, but does not move."""
        if not self._pressed:
            facing = self.facing_rad
            self._pressed = self._walls.blocks(self.x_cm, self.y_cm, math.cos(facing), math.sin(facing))
        return self._pressed

    def _faces_ball(self) -> bool:
        """Whether it touches a ball that it faces."""
        if not self.beside:
            return False
        facing_rad = self.facing_rad
        along_x, along_y = math.cos(facing_rad), math.sin(facing_rad)
        return any(x * along_x + y * along_y < 0 for x, y in self.beside)

    def _path(self, step_s: float, end_speed_cm_s: float) -> tuple[float, float, Hit | None]:
        """The chord that it rolls in ``step_s``: length, arena angle, and the wall on it."""
        way_cm = max(0.0, (self.speed_cm_s + end_speed_cm_s) / 2.0 * step_s)
        angle = self._frame_rad - self._heading_rad + self._drift_rad_per_cm * way_cm / 2.0
        return way_cm, angle, self._walls.hit(self.x_cm, self.y_cm, math.cos(angle), math.sin(angle), way_cm)

    def _bends(self, way_cm: float) -> bool:
        """Whether the chord leaves the arc by too much to meet a wall on."""
        return abs(self._drift_rad_per_cm) * way_cm * way_cm > 8.0 * _SAGITTA_CM

    def _time_to(self, way_cm: float, acceleration: float) -> tuple[float, float]:
        """Time to roll ``way_cm`` and the speed then: root of v t + a t²/2 = d, in the form that does not cancel."""
        end_cm_s = math.sqrt(max(0.0, self.speed_cm_s * self.speed_cm_s + 2.0 * acceleration * way_cm))
        both = self.speed_cm_s + end_cm_s
        return (2.0 * way_cm / both if both > 0 else math.inf), end_cm_s

    def _roll(self, t_s: float, step_s: float, acceleration: float, end_speed_cm_s: float) -> None:
        """Roll for ``step_s``, or until the wall."""
        way_cm, angle, hit = self._path(step_s, end_speed_cm_s)
        impact_cm_s = 0.0
        if hit is not None and self._bends(way_cm):
            # Near a wall the chord must not leave the arc: come closer first.
            self._roll(t_s, step_s / 2.0, acceleration, self.speed_cm_s + acceleration * step_s / 2.0)
            return
        if hit is not None:
            way_cm = hit.distance_cm
            until_s, impact_cm_s = self._time_to(way_cm, acceleration)
            step_s = min(step_s, until_s)
            end_speed_cm_s = 0.0
        along_x, along_y = math.cos(angle), math.sin(angle)
        self.x_cm += way_cm * along_x
        self.y_cm += way_cm * along_y
        self.distance_cm += way_cm
        self.speed_cm_s = end_speed_cm_s
        self._frame_rad += self._drift_rad_per_cm * way_cm
        felt_cm = way_cm * self._locator_scale
        self._locator_x_cm += felt_cm * math.sin(self._heading_rad)
        self._locator_y_cm += felt_cm * math.cos(self._heading_rad)
        self.battery_charge = max(0.0, self.battery_charge - step_s / self.settings.battery_roll_s)
        self._t_s = max(t_s + step_s, math.nextafter(t_s, math.inf))
        if hit is not None:
            self._pressed = True
            self._bump(hit.normal_rad, max(0.0, -math.cos(hit.normal_rad - angle)) * impact_cm_s)

    def _bump(self, normal_rad: float, speed_cm_s: float) -> None:
        if self.on_bump is None:
            return
        error_rad = self.settings.bump_angle_rad * float(self._rng.standard_normal())
        normal_heading_rad = (self._frame_rad - normal_rad + error_rad) % TURN
        self.on_bump(Impact(self.t_s, normal_heading_rad, self._heading_rad, speed_cm_s))
