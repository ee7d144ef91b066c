"""The messages of an MCAP file: their JSON schemas, by the names that Foxglove knows or by our own.

Of Foxglove's schemas (foxglove.dev/docs/visualization/message-schemas) the fields that are filled are declared.
Lengths are in metres there, which is what its 3D panel takes them for; our own are in cm, as everywhere else.
"""

from __future__ import annotations

import json
from typing import Any

_TIME: dict[str, Any] = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}
_DURATION: dict[str, Any] = {
    "type": "object",
    "title": "duration",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999}},
}
_NUMBER, _WHOLE, _TEXT, _FLAG = {"type": "number"}, {"type": "integer"}, {"type": "string"}, {"type": "boolean"}
_MAYBE = {"type": ["number", "null"]}


def _object(title: str, about: str = "", /, **fields: Any) -> dict[str, Any]:
    described = {"description": about} if about else {}
    return {"title": title, **described, "type": "object", "properties": fields}


def _list(of: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": of}


_XYZ: dict[str, Any] = {"x": _NUMBER, "y": _NUMBER, "z": _NUMBER}
_POSE = _object(
    "foxglove.Pose",
    position=_object("foxglove.Vector3", **_XYZ),
    orientation=_object("foxglove.Quaternion", **_XYZ, w=_NUMBER),
)
_COLOUR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_LINE = _object(
    "foxglove.LinePrimitive",
    type=_WHOLE,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_list(_object("foxglove.Point3", **_XYZ)),
    color=_COLOUR,
    colors=_list(_COLOUR),
    indices=_list(_WHOLE),
)
UNUSED_PRIMITIVES = ("arrows", "cubes", "spheres", "cylinders", "triangles", "texts", "models")
_UNUSED: dict[str, Any] = {name: _list(_object(name)) for name in UNUSED_PRIMITIVES}
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    lines=_list(_LINE),
    **_UNUSED,
)

LOG, POSE, SCENE, IMAGE = "foxglove.Log", "foxglove.PoseInFrame", "foxglove.SceneUpdate", "foxglove.CompressedImage"
LIGHT, LINE, CROSSING, ESTIMATE = "chordlab.Light", "chordlab.Line", "chordlab.Crossing", "chordlab.Estimate"

SCHEMAS: dict[str, dict[str, Any]] = {
    LOG: _object(LOG, timestamp=_TIME, level=_WHOLE, message=_TEXT, name=_TEXT, file=_TEXT, line=_WHOLE),
    POSE: _object(POSE, timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
    SCENE: _object(SCENE, deletions=_list(_object("foxglove.SceneEntityDeletion", id=_TEXT)), entities=_list(_ENTITY)),
    IMAGE: _object(
        IMAGE,
        timestamp=_TIME,
        frame_id=_TEXT,
        data={"type": "string", "contentEncoding": "base64"},
        format=_TEXT,
    ),
    LIGHT: _object(
        LIGHT,
        "One raw sample of a robot's light sensor; x, y by its own odometer, in its own frame.",
        timestamp=_TIME,
        t_s=_NUMBER,
        line=_WHOLE,
        light_lux=_MAYBE,
        x_cm=_MAYBE,
        y_cm=_MAYBE,
        speed_cm_s=_MAYBE,
    ),
    LINE: _object(
        LINE,
        "One run, at its end.",
        timestamp=_TIME,
        line=_WHOLE,
        t_start_s=_NUMBER,
        t_rolling_s=_MAYBE,
        t_end_s=_NUMBER,
        length_cm=_MAYBE,
        end_cm=_MAYBE,
        speed_cm_s=_MAYBE,
        k=_WHOLE,
        l1_cm=_MAYBE,
        l3_cm3=_MAYBE,
        ended=_TEXT,
        counts=_FLAG,
        whole=_FLAG,
        weight=_MAYBE,
        starts_lit=_FLAG,
        ends_lit=_FLAG,
    ),
    CROSSING: _object(
        CROSSING,
        "The light came (entering) or went, s_cm along the run.",
        timestamp=_TIME,
        line=_WHOLE,
        order=_WHOLE,
        t_s=_NUMBER,
        s_cm=_MAYBE,
        entering=_FLAG,
    ),
    ESTIMATE: _object(
        ESTIMATE,
        "Area and perimeter after n counted lines that crossed the shape, and the most probable name.",
        timestamp=_TIME,
        n=_WHOLE,
        line=_WHOLE,
        t_s=_NUMBER,
        area_cm2=_MAYBE,
        perimeter_cm=_MAYBE,
        sigma_area_cm2=_MAYBE,
        sigma_perimeter_cm=_MAYBE,
        correlation=_MAYBE,
        leading=_TEXT,
        posterior=_MAYBE,
    ),
}


def encoded(schema: str) -> bytes:
    """One schema as MCAP keeps it (encoding ``jsonschema``)."""
    return json.dumps(SCHEMAS[schema]).encode()
