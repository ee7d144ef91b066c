"""An append-only file of whole records, each synced before the next."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from lab.base.files import PLAIN, write_all

_PIECE_BYTES = 1 << 20


def whole_length(log: bytes) -> int:
    """How many bytes of a log are whole records: all but a torn last one.

    It is torn where it lacks its end of line, or where a part of it never reached the disk, which reads as zeros.
    """
    end = log.rfind(b"\n") + 1
    begin = log.rfind(b"\n", 0, max(end - 1, 0)) + 1
    return begin if b"\0" in log[begin:end] else end


class EventLog:
    """The open log of a session.

    After a record that could not be written whole (a full disk), the file is cut back to the last whole one; where
    even that fails, nothing is ever appended again. So no record is glued to a torn one.
    """

    def __init__(self, path: Path, *, new: bool) -> None:
        """Open for appending. Raises OSError, for a link and, if ``new``, for a file that is there too."""
        flags = os.O_RDWR | os.O_APPEND | PLAIN | (os.O_CREAT | os.O_EXCL if new else 0)
        self._descriptor = os.open(path, flags, 0o666)
        self._whole = os.fstat(self._descriptor).st_size
        self._trouble: OSError | None = None

    @property
    def is_whole(self) -> bool:
        """Whether it ends with a whole record, or is empty."""
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        log = bytearray()
        while piece := os.read(self._descriptor, _PIECE_BYTES):
            log += piece
        return whole_length(bytes(log)) == len(log)

    def append(self, record: bytes) -> None:
        """Append one record, with its end of line, and sync it. Raises OSError."""
        if self._trouble is not None:
            raise OSError(self._trouble.errno, self._trouble.strerror)
        try:
            write_all(self._descriptor, record)
            os.fsync(self._descriptor)
        except BaseException:  # a second Ctrl-C may land here as well
            self._cut_back()
            raise
        self._whole += len(record)

    def close(self) -> None:
        """Close the file. Safe to call twice."""
        if self._descriptor >= 0:
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)

    def _cut_back(self) -> None:
        """Drop what was appended since the last whole record, on the disk too."""
        self._trouble = OSError(errno.EIO, "the log could not be mended after a failed write")
        try:
            os.ftruncate(self._descriptor, self._whole)
            os.fsync(self._descriptor)
        except OSError as error:
            self._trouble = error
        else:
            self._trouble = None
