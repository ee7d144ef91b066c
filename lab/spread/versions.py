"""What a result may depend on besides its input: this program's own source, and the packages that it computes with."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from projector.collections import shapes_folder

Versions = Mapping[str, str]

PROGRAM = "chordlab"
_ROOMS = ("analysis", "lab", "projector", "robot", "tracking")
_PACKAGES = (
    "av",
    "contourpy",
    "filterpy",
    "numba",
    "numpy",
    "opencv-python-headless",
    "pandas",
    "pyarrow",
    "scikit-learn",
    "scipy",
    "shapely",
)
_SOURCES = {".py", ".json", ".geojson", ".toml", ".j2", ".txt"}


def versions() -> Versions:
    """The versions of Python and of the packages, and under ``chordlab`` the digest of the program's own source.

    As they were when this process first asked: what it has imported by then is what it goes by.
    """
    return dict(_versions())


@cache
def _versions() -> Versions:
    found = {"python": ".".join(map(str, sys.version_info[:3])), PROGRAM: _source_digest()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # another wheel of the same package, as opencv has
            found[name] = "unknown"
    return found


def differences(ours: Versions, theirs: Versions) -> list[str]:
    """Say what differs, one text each: ``numpy 2.4.6 there, 2.3.0 here``."""
    return [
        f"another {PROGRAM}" if name == PROGRAM else f"{name} {theirs.get(name)} there, {ours.get(name)} here"
        for name in sorted(ours.keys() | theirs.keys())
        if ours.get(name) != theirs.get(name)
    ]


def digest_of_source(folders: Mapping[str, Path]) -> str:
    """SHA-256 of all sources and shapes below some folders, whose places do not matter."""
    found = hashlib.sha256()
    for name, folder in sorted(folders.items()):
        for path in sorted(folder.rglob("*")):
            if path.suffix in _SOURCES and path.is_file():
                found.update(f"{name}/{path.relative_to(folder).as_posix()}\n".encode())
                found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def _source_digest() -> str:
    folders = {"shapes": shapes_folder()}
    for room in _ROOMS:
        spec = importlib.util.find_spec(room)
        if spec is not None and spec.origin is not None:
            folders[room] = Path(spec.origin).parent
    return digest_of_source(folders)
