"""The settings of a session, checked, with the defaults of the virtual bench.

Every field is documented, unknown keys are refused. What is written into the manifest is the whole
of it, so that a session says how it was made.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from lab.settings.physics import Section, VirtualSettings
from lab.settings.sections import (
    ArenaSettings,
    LedSettings,
    LinkSettings,
    MotionSettings,
    OpticsSettings,
    SensorSettings,
    StopSettings,
)
from robot.profile import RobotProfile, load_profile
from robot.turning import Policy, check_weighting
from tracking.calibration import Calibration, load_calibration

_VIRTUAL_ROBOTS = ("virtual", "onboard:virtual")
_REPLAY = "replay:"
_MOST_ROBOTS = 8


def _camera_optics() -> OpticsSettings:
    return OpticsSettings(tilt_deg=(1.0, -1.5), distortion=(-0.12, 0.03, 0.0, 0.0, 0.0))


def _projector_optics() -> OpticsSettings:
    return OpticsSettings(image_size=(1920, 1080), height_cm=250.0, field_width_cm=200.0)


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
