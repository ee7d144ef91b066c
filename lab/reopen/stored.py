"""What a stored session was: its shape and its settings, by what its own manifest holds."""

from __future__ import annotations

from typing import Any

from shapely.geometry import shape as shape_of

from lab.base.errors import RequestError
from lab.base.given import one_line
from lab.base.pinhole import Pinhole
from lab.settings.load import parse_settings
from lab.settings.settings import Settings
from lab.store.reader import SessionReader
from projector.geojson import parse_drawing
from projector.shape import Shape, check_sane
from projector.text import is_installed
from robot.profile import profile_of


def stored_shape(session: SessionReader) -> Shape:
    """The shape that was projected, from the session's own manifest."""
    try:
        stored = session.manifest["shape"]
        name, title = stored["name"], stored["title"]
        if not (isinstance(name, str) and isinstance(title, str)):
            raise TypeError("its name and title are no texts")
        # what a shape's file must hold too; its own coordinates are taken as they stand
        check_sane(parse_drawing(stored["geometry"], name).geometry, name)
        geometry: Any = shape_of(stored["geometry"])
        return Shape(name, title, geometry, "the session's manifest")
    except (KeyError, TypeError, AttributeError, ValueError, RequestError) as error:
        raise RequestError(one_line(f"{session.folder}: the manifest's shape is not whole ({error!r})")) from error


def asked_settings(session: SessionReader) -> Settings:
    """The settings that a session was begun with, files of that machine and all."""
    return parse_settings(session.manifest.get("settings", {}), origin=f"{session.folder}: manifest settings")


def stored_settings(session: SessionReader) -> Settings:
    """The settings that a session ran with; for the files that they name stands what the manifest holds of them.

    No file outside of the session's folder is read, whatever the manifest says, but for a font that is one of this
    system's; otherwise texts are set in what `find_font` finds.

    Raises:
        RequestError: the manifest's settings, profile or calibration are not whole.
    """
    settings, manifest = asked_settings(session), session.manifest
    font = settings.font if settings.font is not None and is_installed(settings.font) else None
    unread = {"camera_optics": None, "projector_optics": None, "robot_profile": None}  # how the bench really was
    settings = settings.model_copy(update={"font": font, "virtual": settings.virtual.model_copy(update=unread)})
    try:
        optics = {
            f"{role}_optics": getattr(settings, f"{role}_optics").holding(
                Pinhole.from_dict(manifest["calibration"][role])
            )
            for role in ("camera", "projector")
            if getattr(settings, f"{role}_optics").calibration is not None
        }
        devices: dict[str, Any] = manifest.get("devices") or {}
        profile = devices.get("profile")
        if profile is not None:
            settings = settings.holding(profile_of(profile))
        elif settings.robot_profile is not None:
            settings = settings.model_copy(update={"robot_profile": None})
    except (KeyError, TypeError, AttributeError, RequestError) as error:
        raise RequestError(
            one_line(f"{session.folder}: the manifest is not whole ({error}); take another copy")
        ) from error
    return settings.model_copy(update=optics)
