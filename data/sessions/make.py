"""Rolls the sample sessions anew, on the virtual bench: `make samples`."""

from __future__ import annotations

import shutil
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from lab.review.review import examine, keep
from lab.session.experiment import run_experiment
from lab.settings.load import load_settings
from lab.store.seal import write_checksums

HERE = Path(__file__).parent
STARTED = datetime(2026, 11, 23, 10, 42, tzinfo=UTC)  # of all: what is virtual has no date, and equal runs equal bytes


def make(recipe: Path, root: Path) -> Path:
    """Roll what ``recipe`` (a TOML file) says into ``root`` under its name, with tables, track and seal.

    The report is left out: `chordlab validate --out` writes it.
    """
    target = root / recipe.stem
    with tempfile.TemporaryDirectory(dir=root) as aside:
        finished = run_experiment(load_settings(recipe, {"out": Path(aside)}), started=STARTED)
        if finished.failure is not None:
            raise finished.failure
        keep(examine(finished.folder))
        write_checksums(finished.folder)
        shutil.rmtree(target, ignore_errors=True)
        finished.folder.rename(target)
    return target


if __name__ == "__main__":
    for each in sorted(HERE.glob("*.toml")):
        make(each, HERE)
