"""A recorder of what a program does to a folder, and every state in which a power cut may leave that folder.

The disk's model is the weakest that the rules of fsync allow. Data that no fsync of its file followed may be there,
half there, read as zeros, or be missing. A name that no fsync of its folder followed may be there or not, each by
itself.
"""

import contextlib
import hashlib
import itertools
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

DATA_LOSSES = ("lost", "half", "zeros", "hole", "there")
_FEW = 5  # names that are not synced: up to so many in every combination


@dataclass
class Recorder:
    """Notes what happens below ``root`` while `recording`; ``steps`` are (kind, ...) in order."""

    root: Path
    steps: list[tuple] = field(default_factory=list)
    _seen: dict[int, tuple[int, int]] = field(default_factory=dict)
    _names: dict[int, dict[str, int]] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock)

    def promise(self, *what):
        """From here on the program has told its caller something."""
        with self._lock:
            self._scan()
            self.steps.append(("promise", *what))

    @contextlib.contextmanager
    def recording(self, monkeypatch) -> Iterator["Recorder"]:
        self._names[self.root.stat().st_ino] = {}
        with monkeypatch.context() as patch:
            real = {name: getattr(os, name) for name in ("fsync", "rename", "replace", "unlink", "ftruncate")}

            def fsync(descriptor):
                with self._lock:
                    self._scan()
                    real["fsync"](descriptor)
                    if (inode := os.fstat(descriptor).st_ino) in self._seen or inode in self._names:
                        self.steps.append(("fsync", inode))

            def move(name):
                def moved(old, new, **options):
                    with self._lock:
                        self._scan()
                        inode, folders = os.lstat(old).st_ino, [Path(p).parent.stat().st_ino for p in (old, new)]
                        real[name](old, new, **options)
                        assert folders[0] == folders[1], "the model knows renames within a folder alone"
                        self._enter(folders[0], {Path(old).name: None, Path(new).name: inode})

                return moved

            def unlink(path, *, dir_fd=None):
                with self._lock:
                    self._scan()
                    real["unlink"](path, dir_fd=dir_fd)
                    assert dir_fd is None
                    self._enter(Path(path).parent.stat().st_ino, {Path(path).name: None})

            def ftruncate(descriptor, length):
                with self._lock:
                    self._scan()
                    real["ftruncate"](descriptor, length)
                    self._scan()

            for name, fake in {
                "fsync": fsync, "rename": move("rename"), "replace": move("replace"), "unlink": unlink,
                "remove": unlink, "ftruncate": ftruncate,
            }.items():  # fmt: skip
                patch.setattr(os, name, fake)
            yield self
            self._scan()

    def _enter(self, folder: int, names: dict[str, int | None]):
        if folder in self._names:
            self._names[folder].update(names)
            self.steps.append(("enter", folder, names))

    def _scan(self):
        """Note the names and bytes that are new, whoever made them: libraries write behind Python's back."""
        self._scan_folder(self.root)

    def _scan_folder(self, folder: Path):
        inode = folder.stat().st_ino
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            found = entry.stat(follow_symlinks=False)
            if entry.is_dir() and found.st_ino not in self._names:
                self._names[found.st_ino] = {}
                self.steps.append(("folder", found.st_ino))
            if not entry.is_dir() and self._seen.get(found.st_ino) != (found.st_size, found.st_mtime_ns):
                self._seen[found.st_ino] = (found.st_size, found.st_mtime_ns)
                self.steps.append(("write", found.st_ino, Path(entry.path).read_bytes()))
            if self._names[inode].get(entry.name) != found.st_ino:
                self._enter(inode, {entry.name: found.st_ino})
            if entry.is_dir():
                self._scan_folder(Path(entry.path))


@dataclass
class Disk:
    """What is on the disk for certain, and what may be, after some of a recorder's steps."""

    root: int
    synced: dict[int, bytes] = field(default_factory=dict)
    written: dict[int, bytes] = field(default_factory=dict)
    names: dict[int, dict[str, int]] = field(default_factory=dict)
    pending: list[tuple[int, dict[str, int | None]]] = field(default_factory=list)

    def __post_init__(self):
        self.names[self.root] = {}

    def take(self, step: tuple):
        match step:
            case ("folder", inode):
                self.names[inode] = {}
            case ("write", inode, data):
                self.written[inode] = data
                self.synced.setdefault(inode, b"")
            case ("enter", folder, names):
                self.pending.append((folder, names))
            case ("fsync", inode) if inode in self.written:
                self.synced[inode] = self.written[inode]
            case ("fsync", folder):
                for other, names in self.pending:
                    if other == folder:
                        _apply(self.names[folder], names)
                self.pending = [entry for entry in self.pending if entry[0] != folder]

    def states(self) -> Iterator[dict[str, bytes | None]]:
        """Every state after a cut now: path → bytes, or None for a folder."""
        losses = DATA_LOSSES if any(self.written[i] != self.synced[i] for i in self.written) else ("there",)
        for done in _subsets(len(self.pending)):
            names = {folder: dict(entries) for folder, entries in self.names.items()}
            for index in done:
                folder, change = self.pending[index]
                _apply(names[folder], change)
            for loss in losses:
                yield dict(self._tree(self.root, "", names, loss))

    def _tree(self, folder: int, prefix: str, names, loss: str) -> Iterator[tuple[str, bytes | None]]:
        for name, inode in names[folder].items():
            if inode in self.names:
                yield prefix + name, None
                yield from self._tree(inode, f"{prefix}{name}/", names, loss)
            else:
                yield prefix + name, _torn(self.synced[inode], self.written[inode], loss)


def _apply(entries: dict[str, int], change: dict[str, int | None]):
    for name, inode in change.items():
        if inode is None:
            entries.pop(name, None)
        else:
            entries[name] = inode


def _subsets(count: int) -> Iterator[tuple[int, ...]]:
    if count <= _FEW:
        for size in range(count + 1):
            yield from itertools.combinations(range(count), size)
        return
    for kept in range(count + 1):  # as many as there is time for: in order, and all but one
        yield tuple(range(kept))
        yield tuple(index for index in range(count) if index != kept)


def _torn(synced: bytes, written: bytes, loss: str) -> bytes:
    """A file whose last bytes were not synced."""
    if synced == written:
        return written
    apart = (place for place, (old, new) in enumerate(zip(synced, written, strict=False)) if old != new)
    common = next(apart, min(len(synced), len(written)))
    new = written[common:]
    match loss:
        case "lost":
            return synced
        case "half":
            return written[: common + len(new) // 2]
        case "zeros":
            return written[:common] + bytes(len(new))
        case "hole":  # the last block reached the disk, the ones before it did not
            return written[:common] + bytes(len(new) // 2) + new[len(new) // 2 :]
    return written


def key_of(state: dict[str, bytes | None]) -> str:
    digest = hashlib.sha256()
    for name in sorted(state):
        data = state[name]
        digest.update(name.encode() + b"\0" + (b"/" if data is None else hashlib.sha256(data).digest()))
    return digest.hexdigest()


def lay_out(state: dict[str, bytes | None], folder: Path, pool: Path):
    """Make the state's files below ``folder``; equal files are links into ``pool``."""
    folder.mkdir()
    for name, data in state.items():
        if data is None:
            (folder / name).mkdir()
    for name, data in state.items():
        if data is not None:
            kept = pool / hashlib.sha256(data).hexdigest()
            if not kept.exists():
                kept.write_bytes(data)
            os.link(kept, folder / name)
