"""What is exported: a stored session's tables, raw light, track and film, opened piece by piece."""

# pyright: reportUnknownMemberType=false
# pyarrow's stubs leave its tables' keywords open; nothing of them leaves this module.

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from lab.store.layout import LIGHT, VIDEO, SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import Tables, tables_of
from tracking.segment import frames_table

TRACK = "track.parquet"
_PLACES = ("line", "t_s", "x_smooth_cm", "y_smooth_cm", "vx_cm_s", "vy_cm_s")
_ROWS = 4096  # of a table that are in memory at a time


@dataclass(frozen=True, slots=True)
class Segment:
    """One piece of the film: the run in whose folder it lies, and the host's times (s) of its first and last frame.

    ``shift_s`` is to be added to its own time stamps (the camera's clock) to have the host's.
    """

    line: int
    path: Path
    frames: int
    shift_s: float
    t_first_s: float
    t_last_s: float


@dataclass(frozen=True, slots=True)
class Source:
    """A session to export.

    Attributes:
        session: the folder.
        events: its log, in order.
        tables: what the log says.
        robots: the names that its runs bear, in the order of their first run.
        film: the pieces of its film that belong to runs of the log, by time.
        track: the track's file, None where the film was not tracked yet.
    """

    session: SessionReader
    events: tuple[dict[str, Any], ...]
    tables: Tables
    robots: tuple[str, ...]
    film: tuple[Segment, ...]
    track: Path | None

    @property
    def name(self) -> str:
        """The folder's own name."""
        return self.session.folder.resolve().name

    def light(self, line: int) -> pd.DataFrame:
        """One run's raw samples by time; empty for a run that kept none (a robot that estimates by itself).

        Raises SessionFolderError for a table that cannot be read.
        """
        path = self.session.line_path(line, LIGHT)
        if not path.exists():
            return pd.DataFrame()
        samples = _table(self.session, path, ("t_host_s", "light_lux", "x_cm", "y_cm", "speed_cm_s"))
        return samples.sort_values("t_host_s", kind="stable")

    def light_starts_s(self, line: int) -> float | None:
        """The time of a run's first raw sample; None for a run without samples."""
        path = self.session.line_path(line, LIGHT)
        times = _table(self.session, path, ("t_host_s",))["t_host_s"].dropna() if path.exists() else ()
        return float(min(times)) if len(times) else None

    def track_rows(self) -> Iterator[pd.DataFrame]:
        """The track in its file's order, some thousand rows at a time, the first time none; nothing without a track.

        Raises SessionFolderError for a track that cannot be read or is none.
        """
        if self.track is None:
            return
        try:
            with pq.ParquetFile(self.track) as file:
                if missing := [name for name in _PLACES if name not in file.schema_arrow.names]:
                    raise ValueError(f"no column {missing[0]}")
                yield file.schema_arrow.empty_table().to_pandas()
                for batch in file.iter_batches(batch_size=_ROWS):
                    yield batch.to_pandas()
        except (OSError, ValueError, pa.ArrowException) as error:
            raise _unreadable(self.session, self.track, error) from error

    def track_length(self) -> int:
        """How many rows the track has. Raises SessionFolderError for a track that cannot be read."""
        try:
            return 0 if self.track is None else pq.read_metadata(self.track).num_rows
        except (OSError, ValueError, pa.ArrowException) as error:
            raise _unreadable(self.session, self.track or Path(), error) from error


def source_of(session: SessionReader) -> Source:
    """Open a session for export; nothing in its folder is changed. Raises SessionFolderError for a broken one."""
    tables = tables_of(session)
    track = session.path(TRACK)
    segments = session.segments()
    film = [_segment(session, line, segments[line]) for line in map(int, tables.lines["line"]) if line in segments]
    return Source(
        session=session,
        events=tuple(session.events()),
        tables=tables,
        robots=tuple(dict.fromkeys(map(str, tables.lines["robot"]))),
        film=tuple(sorted((piece for piece in film if piece.frames), key=lambda piece: piece.t_first_s)),
        track=track if track.exists() else None,
    )


def _segment(session: SessionReader, line: int, path: Path) -> Segment:
    stamps = _table(session, session.line_path(line, frames_table(VIDEO).name), ("t_host_s", "t_camera_s"))
    host_s, camera_s = stamps["t_host_s"], stamps["t_camera_s"]
    if stamps.empty:
        return Segment(line, path, 0, 0.0, 0.0, 0.0)
    shift_s = float((host_s - camera_s).median())
    first_s, last_s = float(camera_s.iloc[0]) + shift_s, float(camera_s.iloc[-1]) + shift_s
    return Segment(line, path, len(stamps), shift_s, first_s, last_s)


def _table(session: SessionReader, path: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    try:
        return pq.read_table(path, columns=list(columns)).select(list(columns)).to_pandas().astype(float)
    except (OSError, ValueError, TypeError, KeyError, pa.ArrowException) as error:
        raise _unreadable(session, path, error) from error


def _unreadable(session: SessionReader, path: Path, error: Exception) -> SessionFolderError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return SessionFolderError(session.folder, f"{path.relative_to(session.folder)} cannot be read ({reason})")
