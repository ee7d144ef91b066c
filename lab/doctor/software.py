"""Python, packages, fonts, encoders: what an installation must bring."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import av
from packaging.requirements import Requirement

from lab.base.compiled import compiled
from lab.doctor.finding import Finding
from projector.text import find_font
from tracking.segment import EncoderSettings

OUR_PACKAGES = ("lab", "projector", "tracking", "robot", "analysis")
_EXTRAS = {
    "projector": "the window on a real projector",
    "live": "the live page of a session",
    "cluster": "batches on a Dask cluster",
}


def python() -> Iterator[Finding]:
    """The interpreter's own version."""
    version = ".".join(map(str, sys.version_info[:3]))
    fine = sys.version_info >= (3, 11)
    cure = "" if fine else "install Python 3.11 or newer"
    yield Finding("python", "ok" if fine else "broken", version, cure, "python")


def packages() -> Iterator[Finding]:
    """Every requirement of chordlab itself, from its own metadata."""
    for requirement in _requirements():
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        found, fine = _installed(requirement)
        cure = "" if fine else f"pip install '{requirement.name}{requirement.specifier}'"
        yield Finding(requirement.name, "ok" if fine else "broken", found, cure, "package")


def extras() -> Iterator[Finding]:
    """What is installed only where it is wanted."""
    for extra, what in _EXTRAS.items():
        wanted = [
            requirement
            for requirement in _requirements()
            if requirement.marker is not None
            and requirement.marker.evaluate({"extra": extra})
            and not requirement.marker.evaluate({"extra": ""})
        ]
        found = {requirement.name: _installed(requirement) for requirement in wanted}
        fine = all(good for _, good in found.values())
        text = ", ".join(f"{name} {version}" for name, (version, _) in found.items())
        cure = "" if fine else f"for {what}: pip install 'chordlab[{extra}]'"
        yield Finding(f"extra {extra}", "ok" if fine else "missing", text, cure, "python")


def clashes() -> Iterator[Finding]:
    """Our top-level names are common (`robot` is also Robot Framework's): see that ours are the ones found."""
    home = Path(__file__).resolve().parents[2]
    found = False
    for name in OUR_PACKAGES:
        spec = importlib.util.find_spec(name)
        origin = Path(spec.origin).resolve().parent if spec and spec.origin else None
        if origin == home / name:
            continue
        found = True
        where = str(origin or "nowhere")
        cure = "use a virtual environment of its own for chordlab"
        yield Finding(f"package {name}", "broken", f"found in {where}", cure, "python")
    if not found:
        yield Finding("our packages", "ok", ", ".join(OUR_PACKAGES), area="python")


def fonts() -> Iterator[Finding]:
    """A font of Helvetica's kind: letters of another one are other shapes."""
    font = find_font()
    cure = "install TeX Gyre Heros or Liberation Sans, or give --font" if font.fallback else ""
    yield Finding("font", "missing" if font.fallback else "ok", font.name, cure)


def encoders() -> Iterator[Finding]:
    """Whether films can be written as H.264."""
    versions = cast("dict[str, tuple[int, ...]]", av.library_versions)
    codec = ".".join(map(str, versions.get("libavcodec", ())))
    if EncoderSettings().encoder() == "h264":
        yield Finding("encoder", "ok", f"libx264, libavcodec {codec}", area="python")
    else:
        cure = "films become Motion JPEG, ten times as big; pip install --force-reinstall --only-binary :all: av"
        yield Finding("encoder", "missing", f"no libx264 in libavcodec {codec}", cure, "python")


def kernel_cache() -> Iterator[Finding]:
    """Whether compiled kernels outlive the process; else each command begins with seconds of compiling."""
    cure = "set NUMBA_CACHE_DIR to a folder that you may write to"
    cache: str | None = cast("Any", compiled()(_nothing)).stats.cache_path
    if cache is None:
        yield Finding("kernel cache", "missing", "no folder for it can be written", cure, "python")
        return
    place = next(folder for folder in (Path(cache), *Path(cache).parents) if folder.exists())
    fine = os.access(place, os.W_OK)
    yield Finding("kernel cache", "ok" if fine else "missing", cache, "" if fine else cure, "python")


def _nothing() -> None:
    """What is never compiled: the cache of this folder's kernels is asked where it would lie."""


def _requirements() -> list[Requirement]:
    return [Requirement(text) for text in importlib.metadata.requires("chordlab") or ()]


def _installed(requirement: Requirement) -> tuple[str, bool]:
    """What is installed, and whether it is what is required."""
    try:
        version = importlib.metadata.version(requirement.name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed", False
    if requirement.specifier.contains(version, prereleases=True):
        return version, True
    return f"{version}, but {requirement.specifier} is needed", False
