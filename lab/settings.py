"""The settings of a session: a TOML file, checked here, with the defaults of the virtual bench.

Every field is documented, unknown keys are refused. What is written into the manifest is the whole
of it, so that a session says how it was made.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from pydantic import Field, PrivateAttr, ValidationError, field_validator, model_validator
from shapely import Point, Polygon, box

from lab.base.colours import LED_COLOURS
from lab.base.errors import RequestError
from lab.base.given import one_line, read_given, toml_of
from lab.base.pinhole import Pinhole
from lab.physics import Fraction, Positive, Section, VirtualSettings
from robot.profile import RobotProfile, load_profile
from robot.turning import Policy, Weighting, check_weighting
from tracking.calibration import Calibration, load_calibration

BALL_RADIUS_CM = 3.65  # a Sphero BOLT is 73 mm across
_VIRTUAL_ROBOTS = ("virtual", "onboard:virtual")
_REPLAY = "replay:"
_MOST_ROBOTS = 8
Extent = Annotated[float, Field(gt=0, le=10_000)]  # of a floor: a hundred metres


class ArenaSettings(Section):
    """The walled floor that the robot rolls on, centred at the origin."""

    kind: Literal["rectangle", "disc"] = "rectangle"
    """`rectangle` (width_cm by height_cm) or `disc` (radius_cm)."""
    width_cm: Extent = 120.0
    """Inner width between the walls, of a rectangle."""
    height_cm: Extent = 90.0
    """Inner height between the walls, of a rectangle."""
    radius_cm: Extent = 60.0
    """Inner radius of the wall, of a disc."""
    edge: Literal["bump", "dark_ring", "bright_ring"] = "bump"
    """What ends a run: a `bump` into the wall, or a ring of light along it: a `dark_ring` (around a dim floor) or a
    `bright_ring`."""
    ring_cm: Annotated[float, Field(ge=3, le=50)] = 10.0
    """Width of the ring along the wall, of an edge by light; wide enough to brake in."""

    @property
    def polygon(self) -> Polygon:
        """The floor between the walls, cm."""
        if self.kind == "disc":
            return Point(0, 0).buffer(self.radius_cm, quad_segs=90)
        return box(-self.width_cm / 2, -self.height_cm / 2, self.width_cm / 2, self.height_cm / 2)

    @property
    def reachable(self) -> Polygon:
        """Where the ball's centre can be: a ball's radius inside the walls, cm."""
        inner = self.polygon.buffer(-BALL_RADIUS_CM, join_style="mitre")
        if inner.is_empty:
            raise RequestError(f"the arena is too small for a ball of {2 * BALL_RADIUS_CM:g} cm; widen [arena]")
        return inner

    @property
    def lines_within(self) -> Polygon:
        """Where the runs lie: ``reachable``, or what the ring leaves of the floor, cm."""
        if self.edge == "bump":
            return self.reachable
        inner = self.polygon.buffer(-self.ring_cm, join_style="mitre")
        if inner.is_empty:
            raise RequestError(
                f"the arena is too small for a ring of {self.ring_cm:g} cm; widen [arena] or lower ring_cm"
            )
        return inner

    @property
    def longest_line_cm(self) -> float:
        """Length of the longest line from edge to edge: the diagonal, or the diameter."""
        left, bottom, right, top = self.lines_within.bounds
        return right - left if self.kind == "disc" else math.hypot(right - left, top - bottom)

    @property
    def ring(self) -> Polygon | None:
        """The lit or dark band along the wall, cm; None where runs end at the wall itself."""
        if self.edge == "bump":
            return None
        return Polygon(self.polygon.exterior, [self.lines_within.exterior])


class MotionSettings(Section):
    """How the robot rolls and turns."""

    speed_cm_s: Annotated[float, Field(gt=0, le=150)] = 15.0
    """Cruising speed. The paper rolls at 1 cm/s; at most 150 cm/s."""
    turning: Policy = Policy.LAMBERT
    """How it turns: `lambert` (cosine law at the edge: isotropic uniform lines), `uniform` (biased, to show it), or
    `interior` (random interior stops: needs no wall direction, takes twice the way)."""
    weighting: Weighting = Weighting.NONE
    """`run_length` undoes what `uniform` does wrong, in a disc arena; refused elsewhere, where it would not."""
    cm_s_per_unit: Annotated[float, Field(gt=0, le=10)] | None = None
    """Speed of one unit of the drive command's speed byte on this floor; none: the robot profile's."""
    run_timeout_s: Positive = 60.0
    """A run without a bump for this long is given up: the robot is stuck or lifted."""
    length_from: Literal["time", "odometry"] = "time"
    """What chord lengths come from: elapsed time × speed, as in the paper, or the wheels. Both are recorded."""


class SensorSettings(Section):
    """The light sensor and its stream."""

    interval_s: Annotated[float, Field(ge=0.025, le=1)] = 0.05
    """Time between two light samples. Below 25 ms the radio link breaks."""
    height_cm: Positive = 6.0
    """Height of the light sensor above the floor: the plane for which shapes are projected."""


class LinkSettings(Section):
    """What a session does when the radio link or the battery gives out."""

    reconnect_s: Annotated[float, Field(ge=0, le=3600)] = 60.0
    """How long a robot whose link broke is called back before the session ends; 0: not at all."""
    battery_low_v: Annotated[float, Field(ge=3, le=4.2)] = 3.5
    """Below this voltage the session pauses, or a tired robot would roll crooked lines."""
    charge_wait_s: Annotated[float, Field(ge=0, le=86_400)] = 7200.0
    """How long a pause waits for a charged battery before the session ends."""


class LedSettings(Section):
    """The light on the robot that the camera follows."""

    dark_level: Fraction = 0.25
    """Brightness outside the shape. 0 blinks fully dark, as in the paper."""
    lit_level: Fraction = 1.0
    """Brightness inside the shape."""
    height_cm: Positive = 7.3
    """Height of the LED above the floor."""
    colours: tuple[str, ...] = tuple(LED_COLOURS)
    """Colours of the robots' LEDs, in their order: `red`, `green`, `blue`, `yellow`, `magenta`, `cyan`, `orange`,
    `violet`. By them the camera tells robots apart; the first ones lie farthest apart."""

    @field_validator("colours")
    @classmethod
    def _colours_are_known(cls, colours: tuple[str, ...]) -> tuple[str, ...]:
        for colour in colours:
            if colour not in LED_COLOURS:
                raise ValueError(f"{colour!r} is no LED colour; choose of {', '.join(LED_COLOURS)}")
        if not colours or len(set(colours)) < len(colours):
            raise ValueError("name each robot's LED colour once, in the order of the robots")
        return colours


class OpticsSettings(Section):
    """Where a camera or projector hangs: a calibration file, or a pose measured by hand."""

    calibration: Path | None = None
    """A calibration.json; the other fields are then not used."""
    image_size: tuple[Annotated[int, Field(ge=16, le=16384)], Annotated[int, Field(ge=16, le=16384)]] = (1280, 720)
    """Width and height of the picture in pixels."""
    height_cm: Positive = 205.0
    """Height of the optical centre above the floor."""
    field_width_cm: Positive = 175.0
    """Width of the floor that the picture covers."""
    centre_cm: tuple[float, float] = (0.0, 0.0)
    """The floor point under the optical centre."""
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    """Tilt away from the plumb line about the arena's x and y axes."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Lens distortion k1, k2, p1, p2, k3 (OpenCV's order)."""
    _held: Pinhole | None = PrivateAttr(default=None)

    def holding(self, optics: Pinhole) -> OpticsSettings:
        """The same by these optics, in the place of a file that is not to be read again."""
        held = self.model_copy(update={"calibration": None})
        held._held = optics
        return held

    def pinhole(self) -> Pinhole:
        """The optics. Raises RequestError for a calibration file that cannot be read."""
        if self._held is not None:
            return self._held
        if self.calibration is not None:
            return load_calibration(self.calibration).optics
        tilt_x, tilt_y = self.tilt_deg
        return Pinhole.looking_down(
            self.image_size,
            height_cm=self.height_cm,
            field_width_cm=self.field_width_cm,
            centre_cm=self.centre_cm,
            tilt_rad=(math.radians(tilt_x), math.radians(tilt_y)),
            distortion=self.distortion,
        )


def _camera_optics() -> OpticsSettings:
    return OpticsSettings(tilt_deg=(1.0, -1.5), distortion=(-0.12, 0.03, 0.0, 0.0, 0.0))


def _projector_optics() -> OpticsSettings:
    return OpticsSettings(image_size=(1920, 1080), height_cm=250.0, field_width_cm=200.0)


class StopSettings(Section):
    """When a session ends."""

    lines: Annotated[int, Field(ge=1, le=10_000_000)] = 150
    """Number N of lines that cross the shape, at most."""
    until: Annotated[float, Field(gt=0.5, lt=1)] | None = None
    """Stop early once the leading name's posterior reaches this; none: go on to `lines`."""
    at_least: Annotated[int, Field(ge=1)] = 50
    """Never stop on the posterior before this many crossing lines."""


class Settings(Section):
    """One session: what is projected, who rolls and watches, and when it ends."""

    shape: str = "eiffel"
    """A dictionary name, `text:WORD`, or a .geojson, .svg or .png file."""
    dictionary: Literal["paper", "monuments", "letters", "words", "all"] = "paper"
    """The collection that the robot chooses a name from; see `chordlab shapes list`."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Everything random follows from it."""
    robot: str | tuple[str, ...] = "virtual"
    """`ble:SB-1234`, `virtual`, or a list of them; `onboard:CL-1234` listens to a robot that estimates by itself
    (`onboard:virtual` on the virtual bench); `replay:DIR` plays a stored session back, once for each of its robots."""
    robot_profile: Path | None = None
    """A robot-profile.toml, as `chordlab robot characterise` writes it; none: the facts known of every BOLT."""
    camera: str = "virtual"
    """`usb:0`, `file:video.mkv`, `virtual`, `replay:DIR`, or `none`."""
    projector: str = "virtual"
    """`display:1`, `image:DIR`, `virtual`, or `replay:DIR`."""
    out: Path = Path("sessions")
    """Where session folders go."""
    font: Path | None = None
    """Font file for text shapes; none: the first of the system's Helvetica-like fonts."""
    stop: StopSettings = StopSettings()
    arena: ArenaSettings = ArenaSettings()
    motion: MotionSettings = MotionSettings()
    sensor: SensorSettings = SensorSettings()
    link: LinkSettings = LinkSettings()
    led: LedSettings = LedSettings()
    camera_optics: OpticsSettings = Field(default_factory=_camera_optics)
    """Where the camera hangs."""
    projector_optics: OpticsSettings = Field(default_factory=_projector_optics)
    """Where the projector hangs."""
    rig_limit_mm: Annotated[float, Field(ge=0, le=100)] = 5.0
    """A filmed session begins with markers on the floor; camera or projector off by more than this is refused. 0: no
    such check."""
    virtual: VirtualSettings = VirtualSettings()
    _held_profile: RobotProfile | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _devices_are_known(self) -> Self:
        if not 1 <= len(self.robots) <= _MOST_ROBOTS:
            raise ValueError(f"robot: list 1 to {_MOST_ROBOTS} robots, not {len(self.robots)}")
        for robot in self.robots:
            _device("robot", robot, {"virtual": False, "ble": True, "onboard": True, "replay": True})
        _device("camera", self.camera, {"virtual": False, "none": False, "usb": True, "file": True, "replay": True})
        _device("projector", self.projector, {"virtual": False, "display": True, "image": True, "replay": True})
        stored = {device for device in (*self.robots, self.projector, self.camera) if device.startswith(_REPLAY)}
        if stored and (len(stored) > 1 or {*self.robots, self.projector, self.camera} - {"none"} != stored):
            raise ValueError(
                "a stored session is replayed as a whole: set robot, projector and camera (or none) to one replay:DIR"
            )
        worlds = {robot in _VIRTUAL_ROBOTS for robot in self.robots}
        if worlds != {self.projector == "virtual"}:
            raise ValueError("a virtual robot sees only the virtual projector: make all virtual, or none")
        if self.camera == "virtual" and self.robots[0] not in _VIRTUAL_ROBOTS:
            raise ValueError("a virtual camera sees only the virtual robot: set camera to usb:N, file:PATH or none")
        return self

    @model_validator(mode="after")
    def _robots_get_along(self) -> Self:
        real = [robot for robot in self.robots if robot not in _VIRTUAL_ROBOTS and not robot.startswith(_REPLAY)]
        if len(set(real)) < len(real):
            raise ValueError("robot: one robot is listed twice; name each once")
        if self.robots[0].startswith("onboard:") and (
            self.arena.edge != "bump" or self.motion.turning is not Policy.LAMBERT
        ):
            raise ValueError(
                "robot: one that estimates by itself knows bumps and lambert only; set edge and turning so"
            )
        if len(self.robots) > 1:
            if any(robot.startswith("onboard:") for robot in self.robots):
                raise ValueError("robot: a robot that estimates by itself rolls alone; list only one")
            if self.camera != "none" and len(self.led.colours) < len(self.robots):
                raise ValueError(
                    f"led.colours: {len(self.robots)} filmed robots need as many colours, or the camera cannot tell "
                    "them apart"
                )
            if self.motion.turning is not Policy.LAMBERT:
                raise ValueError("motion.turning: robots that meet need lambert, whose lines a contact only shortens")
        return self

    @model_validator(mode="after")
    def _policy_is_sound(self) -> Self:
        try:
            check_weighting(self.motion.turning, self.motion.weighting, disc=self.arena.kind == "disc")
        except RequestError as error:
            raise ValueError(f"motion.weighting: {error}") from error
        return self

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots as a list, one or several."""
        return (self.robot,) if isinstance(self.robot, str) else self.robot

    @property
    def is_virtual(self) -> bool:
        """Whether the session runs on the virtual bench, or is a replay: at virtual time."""
        return self.robots[0] in _VIRTUAL_ROBOTS or self.replayed is not None

    @property
    def replayed(self) -> Path | None:
        """The stored session that is played back, if one is."""
        return Path(self.robots[0].removeprefix(_REPLAY)) if self.robots[0].startswith(_REPLAY) else None

    def led_colour(self, number: int) -> str:
        """The name of the LED colour of the ``number``-th robot, from 0; where nobody films them they may repeat."""
        return self.led.colours[number % len(self.led.colours)]

    def holding(self, profile: RobotProfile) -> Settings:
        """The same by this profile, in the place of a file that is not to be read again."""
        held = self.model_copy(update={"robot_profile": None})
        held._held_profile = profile
        return held

    def profile(self) -> RobotProfile:
        """What the driver takes the robot for. Raises RequestError for a profile that cannot be read."""
        if self._held_profile is not None:
            return self._held_profile
        profile = load_profile(self.robot_profile) if self.robot_profile is not None else RobotProfile()
        if self.motion.cm_s_per_unit is not None:
            profile = replace(profile, cm_s_per_unit=self.motion.cm_s_per_unit)
        return profile

    def seeds(self, part: int = 0) -> tuple[np.random.SeedSequence, np.random.SeedSequence]:
        """Independent seeds of the virtual world and of the robot's turns; others in each resumed ``part``."""
        # The first part's have the keys (0,) and (1,), which their own children begin with.
        whole = np.random.SeedSequence(self.seed, spawn_key=(1 + part,) if part else ())
        world, turns = whole.spawn(2)
        return world, turns

    def true_optics(self) -> tuple[Pinhole, Pinhole]:
        """How the virtual bench's camera and projector really hang, which no calibration is told."""
        physics = self.virtual
        return (
            load_calibration(physics.camera_optics).optics if physics.camera_optics else self.camera_optics.pinhole(),
            load_calibration(physics.projector_optics).optics
            if physics.projector_optics
            else self.projector_optics.pinhole(),
        )

    def camera_calibration(self) -> Calibration:
        """The camera's optics with the height of the LED that it follows."""
        return Calibration(optics=self.camera_optics.pinhole(), led_height_cm=self.led.height_cm)


def _device(role: str, spec: str, kinds: dict[str, bool]) -> None:
    """Check that a device string is one of ``kinds`` (kind → whether it takes an address)."""
    kind, colon, address = spec.partition(":")
    takes_address = kinds.get(kind)
    if takes_address is None or takes_address != bool(colon and address):
        forms = ", ".join(f"{name}:…" if takes else name for name, takes in kinds.items())
        raise ValueError(f"{role} = {spec!r} is no device; use one of {forms}")


def load_settings(
    path: Path | None,
    overrides: dict[str, Any] | None = None,
    *,
    simulate: bool = False,
    base: dict[str, Any] | None = None,
) -> Settings:
    """Read a session's TOML (none: the defaults) and lay ``overrides`` (dotted keys) over it.

    ``simulate`` puts a virtual device in the place of each real one. ``base``: what stands for the TOML without one.

    Raises:
        RequestError: the file cannot be read or a key is unknown or out of range; the line names it.
    """
    data: dict[str, Any] = copy.deepcopy(base or {})
    if path is not None:
        try:
            data = toml_of(read_given(path))
        except ValueError as error:
            raise RequestError(one_line(f"{path} is not TOML: {error}")) from error
    for dotted, value in (overrides or {}).items():
        section = data
        *parents, key = dotted.split(".")
        for parent in parents:
            inner: Any = section.setdefault(parent, {})
            if not isinstance(inner, dict):  # no table: refused below
                break
            section = cast("dict[str, Any]", inner)
        else:
            section[key] = value
    if simulate:
        asked: Any = data.get("robot", "virtual")
        robots = cast("list[Any]", asked) if isinstance(asked, list) else [asked]
        data |= {"robot": [_simulated(robot) for robot in robots], "projector": "virtual"}
        if data.get("camera") != "none":
            data["camera"] = "virtual"
    return parse_settings(data, origin=str(path) if path else "settings")


def _simulated(robot: object) -> str:
    """The virtual robot that stands for a real one."""
    return "onboard:virtual" if str(robot).startswith("onboard:") else "virtual"


def parse_settings(data: dict[str, Any], *, origin: str) -> Settings:
    """Check settings that came as plain data. Raises RequestError with one line for the first fault."""
    try:
        return Settings.model_validate(data)
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(str(part) for part in fault["loc"])
        reason = fault["msg"].removeprefix("Value error, ")
        if fault["type"] == "extra_forbidden":
            reason = "is not a setting; see docs for the list, or take it out"
        message = f"{origin}: {where} {reason}"
        raise RequestError(one_line(message)) from error  # a key may hold line breaks
