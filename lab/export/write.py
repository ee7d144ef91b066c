"""One session into the formats that are asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from lab.base.errors import RequestError
from lab.export.bag import write_mcap
from lab.export.film import write_film, write_overlay
from lab.export.source import Source, source_of
from lab.export.text import write_csv
from lab.store.lock import writing
from lab.store.reader import SessionReader

KINDS = ("csv", "mcap", "mp4")
Progress = Callable[[int, int], None]
Bar = Callable[[str], AbstractContextManager[Progress]]


@dataclass(frozen=True, slots=True)
class Exported:
    """What came of an export.

    Attributes:
        out: the folder.
        files: the files written, in the order of their making.
        messages: how many messages each topic of the MCAP file holds.
        copied: whether the mp4 holds the film's pictures bit by bit; None without one.
        remarks: one line for everything that was left out, with the cure.
    """

    out: Path
    files: tuple[Path, ...]
    messages: dict[str, int] = field(default_factory=dict[str, int])
    copied: bool | None = None
    remarks: tuple[str, ...] = ()


def kinds_of(text: str) -> tuple[str, ...]:
    """Read "csv,mcap". Raises RequestError for a format that is not known, or none."""
    kinds = tuple(dict.fromkeys(part.strip().lower() for part in text.split(",") if part.strip()))
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise RequestError(
            f"--to {text}: {unknown[0] if unknown else 'nothing'} is no format; give any of csv,mcap,mp4"
        )
    return kinds


def export_folder(session: SessionReader, out: Path | None) -> Path:
    """Where an export goes: ``out``, by default ./NAME_export. The folder is made.

    Raises:
        RequestError: it cannot be made, or nobody said where and it would lie in the session's own folder.
    """
    folder = session.folder.resolve()
    target = out or Path(f"{folder.name}_export")
    if out is None and folder in (target.resolve(), *target.resolve().parents):
        raise RequestError(f"{folder}: you stand in the session's own folder; say with --out where the export goes")
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"{target}: no folder can be made there ({error.strerror}); choose another --out") from error
    return target


def export_session(
    session: SessionReader,
    out: Path,
    kinds: Sequence[str],
    bar: Bar,
    *,
    every: int = 3,
    overlay: bool = False,
) -> Exported:
    """Export a session into the folder ``out``, which exists; files of an export before it are replaced.

    The session's folder is only read. What it lacks (a film, a track) is left out and named in ``remarks``.

    Args:
        session: the session.
        out: the folder.
        kinds: of ``KINDS``.
        bar: opens a progress bar with a label.
        every: which pictures of the film go into the MCAP file.
        overlay: draw the track over the mp4.

    Raises:
        RequestError: something cannot be read or written, or the overlay was asked for and there is no track.
    """
    with _held(session, out):
        return _export(source_of(session), out, kinds, bar, every=every, overlay=overlay)


def _held(session: SessionReader, out: Path) -> AbstractContextManager[None]:
    """The session's lock where its folder is written to; one that is only read is not locked."""
    root = session.folder.resolve()
    return writing(session.folder) if root in (out.resolve(), *out.resolve().parents) else nullcontext()


def _export(source: Source, out: Path, kinds: Sequence[str], bar: Bar, *, every: int, overlay: bool) -> Exported:
    session = source.session
    files: list[Path] = []
    remarks: list[str] = []
    messages: dict[str, int] = {}
    copied: bool | None = None
    if overlay and "mp4" in kinds and source.film and source.track is None:
        raise RequestError(f"{session.folder}: there is no track to draw; run chordlab validate {session.folder} first")
    if source.film and source.track is None:
        remarks.append(f"no track: the film was not tracked yet; run chordlab validate {session.folder}")
    if "csv" in kinds:
        with bar("csv") as progress:
            files += write_csv(source, out, progress)
    if "mcap" in kinds:
        files.append(out / "session.mcap")
        with bar("mcap") as progress:
            messages = write_mcap(source, files[-1], every=every, progress=progress)
    if "mp4" in kinds and not source.film:
        remarks.append("no mp4: the session was not filmed")
    elif "mp4" in kinds:
        files.append(out / "film.mp4")
        with bar("mp4") as progress:
            if overlay:
                write_overlay(source, files[-1], progress)
            copied = False if overlay else write_film(source, files[-1], progress)
    return Exported(out, tuple(files), messages, copied, tuple(remarks))
