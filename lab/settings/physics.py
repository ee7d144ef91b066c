"""The physics of the virtual bench, as settings: what its devices do not know."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Lux = Annotated[float, Field(ge=0, le=1e6)]  # ten times sunlight
_LEAST_SPAN_LUX = 1e-3


class Section(BaseModel):
    """A table of the settings' file: unknown keys and infinite numbers are refused, nothing changes once it is read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class FaultSettings(Section):
    """One mishap of the virtual bench."""

    kind: Literal["loss", "disconnect", "vanish", "stuck_sensor", "stall", "low_battery"]
    """`loss` of notifications, `disconnect`, `vanish` (silence without a disconnect), `stuck_sensor`, `stall`
    (wheels held), `low_battery`."""
    at_s: Annotated[float, Field(ge=0)]
    """When, counted from the robot's switching on."""
    for_s: Positive = 5.0
    """For how long."""
    share: Fraction = 0.5
    """Share of the notifications that a `loss` swallows."""
    robot: Annotated[int, Field(ge=0)] = 0
    """Which robot, by its place in the list."""


class VirtualSettings(Section):
    """The physical world of the virtual bench: what the devices do not know."""

    camera_optics: Path | None = None
    """A calibration.json of how the camera really hangs, without the session's knowing; none: as it believes."""
    projector_optics: Path | None = None
    """The same for the projector."""
    robot_profile: Path | None = None
    """A robot-profile.toml that the virtual robot obeys without the driver's knowing; none: the driver's own."""
    speed_error_sigma: Fraction = 0.02
    """Relative error of each run's speed, one standard deviation."""
    heading_drift_rad_per_cm: Annotated[float, Field(ge=0, le=0.1)] = 0.0002
    """Curvature of a run, one standard deviation."""
    footprint_cm: Annotated[float, Field(ge=0, le=5)] = 0.3
    """Radius of the floor patch that the light sensor averages over."""
    light_noise_lux: Lux = 1.0
    """Noise of one light sample, one standard deviation."""
    ambient_lux: Lux = 15.0
    """Room light."""
    black_lux: Lux = 5.0
    """What the projector throws where its picture is black."""
    white_lux: Lux = 105.0
    """What the projector throws where its picture is white; more than where it is black."""
    blur_px: Annotated[float, Field(ge=0, le=50)] = 1.0
    """Defocus of the projector, one standard deviation in its own pixels."""
    camera_noise: Annotated[float, Field(ge=0, le=50)] = 2.0
    """Noise of the camera in grey levels, one standard deviation."""
    camera_rate_hz: Annotated[float, Field(ge=1, le=240)] = 30.0
    """Frames a second."""
    camera_drop_probability: Fraction = 0.002
    """Chance that a frame is lost."""
    link_latency_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Delay of every packet of the virtual radio."""
    link_jitter_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Largest further delay, drawn for each packet."""
    link_loss: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the notifications that are lost."""
    faults: tuple[FaultSettings, ...] = ()
    """Mishaps to come, to see how a session bears them."""

    @model_validator(mode="after")
    def _white_is_brighter(self) -> Self:
        if self.white_lux - self.black_lux < _LEAST_SPAN_LUX:
            raise ValueError(f"white_lux must lie {_LEAST_SPAN_LUX:g} lux or more above black_lux")
        return self
