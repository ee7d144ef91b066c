"""One archive for a bug report: what was found, what is installed, and the log of a session."""

from __future__ import annotations

import importlib.metadata
import io
import json
import os
import platform
import sys
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import av
import psutil

from analysis.montecarlo import available_cores
from lab.base.errors import ChordlabError, RequestError
from lab.doctor.finding import Finding
from lab.doctor.scrub import Scrubber
from lab.export.aside import whole_file
from lab.export.source import source_of
from lab.export.text import write_light
from lab.store.layout import EVENTS, MANIFEST, SessionFolderError
from lab.store.reader import SessionReader

_ENVIRONMENT = ("CHORDLAB_", "NUMBA_", "OPENCV_", "SDL_", "PYTHON", "DISPLAY", "WAYLAND_DISPLAY", "XDG_SESSION_TYPE")
_MOST_FILES = 5000
_README = """What this archive holds: what `chordlab doctor` found (findings.json), the versions of all Python packages
(versions.json), what machine it is (platform.json) and, of a session where one was named, its manifest, its log and
the names and sizes of its files. No video. Raw light samples only where they were asked for.

What was masked: the home folder, the user's and the machine's name (<home>, <user>, <host>), absolute paths (<path 1>)
and Bluetooth addresses (<address 1>). One mask is one thing throughout.

What was not: the names of robots (SB-7E57), which are printed on them and without which the log cannot be read, though
the last digits of their addresses are in them; names of shapes; relative paths in the settings. Look through it.
"""


def write_bundle(
    path: Path,
    findings: Sequence[Finding],
    *,
    session: Path | None = None,
    with_light: bool = False,
    scrubber: Scrubber | None = None,
) -> Path:
    """Write the archive. A session may be broken as it will: what can be read of it is taken as it is.

    Args:
        path: the .zip.
        findings: what ``examine`` found.
        session: a session folder.
        with_light: take the session's raw light samples too, where its log can be read.
        scrubber: what masks; by default one that knows this machine.

    Raises:
        RequestError: the archive cannot be written, or ``session`` is no session folder.
    """
    if path.suffix.lower() != ".zip":
        raise RequestError(f"{path}: a bundle is a .zip; name it so")
    scrub = scrubber or Scrubber.of_this_machine()
    with whole_file(path) as aside, zipfile.ZipFile(aside, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("README.txt", _README)
        for name, data in (
            ("findings.json", [asdict(finding) for finding in findings]),
            ("versions.json", _versions()),
            ("platform.json", _platform()),
        ):
            archive.writestr(name, scrub.json(json.dumps(data)))
        if session is not None:
            for name, text in _session(session, scrub):
                archive.writestr(f"session/{name}", text)
            if with_light:
                archive.writestr("session/light.csv", _light(session, scrub))
    return path


def _versions() -> dict[str, str]:
    """Every distribution that is installed, by name."""
    found = {found.metadata["Name"]: found.version for found in importlib.metadata.distributions()}
    ffmpeg: dict[str, Any] = dict(av.library_versions)
    ours = {"python": sys.version, **{name: ".".join(map(str, version)) for name, version in ffmpeg.items()}}
    return {**ours, **{name: found[name] for name in sorted(found, key=str.lower)}}


def _platform() -> dict[str, Any]:
    return {
        "made": datetime.now(tz=UTC).isoformat(timespec="seconds"),
        "system": platform.system(),
        "release": platform.release(),
        "version": platform.version(),
        "machine": platform.machine(),
        "processor": platform.processor(),
        "cores": available_cores(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "interpreter": [platform.python_implementation(), sys.executable, sys.prefix],
        "encoding": [sys.getfilesystemencoding(), sys.stdout.encoding],
        "environment": {name: value for name, value in os.environ.items() if name.startswith(_ENVIRONMENT)},
    }


def _session(folder: Path, scrub: Scrubber) -> Iterator[tuple[str, str]]:
    if not folder.is_dir():
        raise SessionFolderError(folder, "is no folder; name a session's")
    found = False
    for name, mask in ((MANIFEST, scrub.json), (EVENTS, scrub.lines)):
        text = _text(folder, name)
        if text is not None:
            found = True
            yield name, mask(text)
    if not found:
        raise SessionFolderError(folder, f"holds neither {MANIFEST} nor {EVENTS}, so it is no session folder")
    yield "files.txt", scrub.text(f"folder: {folder.resolve().name}") + "\n" + "\n".join(_listing(folder, scrub)) + "\n"


def _text(folder: Path, name: str) -> str | None:
    """A file of the session as text, whatever is in it; None where there is none, or it leads out of the folder."""
    path = folder / name
    if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        return None
    return path.read_bytes().decode("utf-8", errors="replace")


def _listing(folder: Path, scrub: Scrubber) -> Iterator[str]:
    """Names and sizes in bytes of what lies in the folder; links are named and not followed."""
    for number, path in enumerate(sorted(folder.rglob("*"))):
        if number == _MOST_FILES:
            yield "and more"
            return
        size = "link" if path.is_symlink() else "folder" if path.is_dir() else str(path.lstat().st_size)
        yield f"{size:>12}  {scrub.text(path.relative_to(folder).as_posix())}"


def _light(folder: Path, scrub: Scrubber) -> str:
    """The raw samples of all runs as one CSV table, or why there are none."""
    file = io.StringIO()
    try:
        source = source_of(SessionReader(folder))
        lines = source.tables.lines.assign(robot=source.tables.lines["robot"].map(scrub.text))
        write_light(replace(source, tables=replace(source.tables, lines=lines)), file)
    except ChordlabError as error:
        return scrub.text(str(error))
    return file.getvalue()
