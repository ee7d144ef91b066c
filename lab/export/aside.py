"""A file that somebody else's library writes, there whole or not at all."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from pathlib import Path

from lab.base.errors import RequestError
from lab.base.files import open_new, sync_file, sync_folder


@contextlib.contextmanager
def whole_file(path: Path) -> Generator[Path]:
    """Yield the empty file ``NAME.part`` to write to; synced and renamed to ``path`` at the end, gone after an error.

    Whatever stood there under either name, a link included, is replaced and never followed.

    Raises:
        RequestError: it cannot be written there.
    """
    target = path.absolute()
    aside = target.with_name(target.name + ".part")
    try:
        open_new(aside).close()
        try:
            yield aside
            sync_file(aside)
            aside.replace(target)
        finally:
            aside.unlink(missing_ok=True)
        sync_folder(target.parent)
    except OSError as error:
        raise RequestError(f"{path}: cannot be written ({error.strerror or error}); choose another --out") from error
