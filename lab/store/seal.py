"""The checksums of a finished session, as ``sha256sum`` writes and checks them."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from lab.base.files import PLAIN, write_aside
from lab.store.layout import CHECKSUMS, LOCK, SessionFolderError
from lab.store.lock import writing
from lab.store.reader import SessionReader

_NOT_SEALED = {CHECKSUMS, f"{CHECKSUMS}.part", LOCK}
_ROW = re.compile(rb"(\\?)([0-9a-f]{64}) [ *](.+)", re.DOTALL)
_ESCAPES = {b"\\": b"\\\\", b"\n": b"\\n", b"\r": b"\\r"}
_UNESCAPES = {escape: plain for plain, escape in _ESCAPES.items()}


def write_checksums(folder: Path) -> Path:
    """Write SHA256SUMS over every file of the session, readable by ``sha256sum -c``.

    Each file is synced before it is read, so that the sums are of what is on the disk. A link is never followed,
    and has no sum.

    Raises:
        SessionFolderError: another process writes in the folder.
        OSError: a file cannot be read, or the sums cannot be written.
    """
    with writing(folder):
        rows = [_row(name, _digest(folder / name, sync=True)) for name, is_plain in _names_in(folder) if is_plain]
        target = folder / CHECKSUMS
        write_aside(target, b"".join(rows))
    return target


def verify_checksums(folder: Path, *, digest: Callable[[Path], str] | None = None) -> list[str]:
    """Hold a session against its SHA256SUMS: one line for each file that is changed, missing or new; none if whole.

    ``digest`` gives a file's SHA-256 where that is known already; default: each file is read.

    Raises SessionFolderError: there are no sums, or they cannot be read.
    """
    sums = SessionReader(folder).path(CHECKSUMS)
    try:
        known = _read_sums(folder, sums.read_bytes())
        there = dict(_names_in(folder))
        digest_of = digest or partial(_digest, sync=False)
        said: list[str] = []
        for name in sorted(known.keys() | there.keys()):
            if name not in there:
                said.append(f"{name}: missing")
            elif name not in known:
                said.append(f"{name}: new" if there[name] else f"{name}: new, and no plain file")
            elif not there[name] or digest_of(folder / name) != known[name]:
                said.append(f"{name}: changed")
    except FileNotFoundError:
        raise SessionFolderError(folder, f"holds no {CHECKSUMS}; run chordlab finalize on it") from None
    except OSError as error:
        raise SessionFolderError(folder, f"{error.filename} cannot be read: {error.strerror}") from error
    return said


def _names_in(folder: Path) -> Iterator[tuple[str, bool]]:
    """What lies in the folder and below, in order, and whether it is a plain file; links are not followed."""
    found: dict[str, bool] = {}
    for place, folders, files in os.walk(folder, followlinks=False):
        for name in files + [name for name in folders if os.path.islink(os.path.join(place, name))]:  # noqa: PTH114, PTH118
            path = Path(place, name)
            found[path.relative_to(folder).as_posix()] = stat.S_ISREG(path.lstat().st_mode)
    yield from sorted((name, plain) for name, plain in found.items() if name not in _NOT_SEALED)


def _digest(path: Path, *, sync: bool) -> str:
    descriptor = os.open(path, (os.O_RDWR if sync and os.name == "nt" else os.O_RDONLY) | PLAIN)
    with os.fdopen(descriptor, "rb") as file:
        if sync:
            os.fsync(descriptor)
        return hashlib.file_digest(file, "sha256").hexdigest()


def _row(name: str, digest: str) -> bytes:
    """One row; a name that would break it is escaped, which the row's first character says."""
    plain = os.fsencode(name)
    escaped = re.sub(rb"[\\\n\r]", lambda match: _ESCAPES[match.group()], plain)
    return (b"\\" if escaped != plain else b"") + digest.encode("ascii") + b"  " + escaped + b"\n"


def _read_sums(folder: Path, text: bytes) -> dict[str, str]:
    known: dict[str, str] = {}
    for number, row in enumerate(text.split(b"\n")[:-1], start=1):
        match = _ROW.fullmatch(row)
        if match is None:
            raise SessionFolderError(folder, f"{CHECKSUMS} line {number} is no checksum; the file was changed")
        escaped, digest, name = match.groups()
        if escaped:
            name = re.sub(rb"\\[\\nr]", lambda found: _UNESCAPES[found.group()], name)
        known[os.fsdecode(name)] = digest.decode("ascii")
    return known
