"""Decoding ahead: the next frames of a video while the caller works on this one."""

from __future__ import annotations

import threading
from collections.abc import Generator
from queue import SimpleQueue

from tracking.video import FrameReader, VideoFrame


def read_ahead(reader: FrameReader, *, depth: int = 2) -> Generator[VideoFrame]:
    """Iterate over a reader's frames while the next ones are decoded in a thread of its own.

    Decoding holds no interpreter lock, so work that the caller does on a frame costs no time as long as it is done
    before the next frame is. Close this generator before the reader.

    Args:
        reader: the file; nobody else may read it meanwhile.
        depth: how many decoded frames may wait: more would only push each other out of the processor's cache.

    Raises:
        VideoError: as the reader.
    """
    waiting: SimpleQueue[VideoFrame | BaseException | None] = SimpleQueue()
    room, left = threading.Semaphore(depth), threading.Event()

    def work() -> None:
        try:
            for frame in reader:
                room.acquire()
                if left.is_set():
                    return
                waiting.put(frame)
            waiting.put(None)
        except BaseException as error:  # noqa: BLE001 - raised again where the frames are taken
            waiting.put(error)

    worker = threading.Thread(target=work, name="chordlab-decoder", daemon=True)
    worker.start()
    try:
        while (found := waiting.get()) is not None:
            if isinstance(found, BaseException):
                raise found
            room.release()
            yield found
    finally:
        left.set()
        room.release()
        worker.join()
