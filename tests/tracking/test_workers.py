"""Several segments on several cores: the same as on one, and an interrupt that is told once."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
import shapely

from tracking.film import blink_in, default_optics, light_of, make_film, rolling
from tracking.track import track_segments

OPTICS = default_optics((320, 240))
SHAPE = shapely.box(-8, -6, 8, 6)


@pytest.fixture(scope="module")
def segments(tmp_path_factory):
    folder = tmp_path_factory.mktemp("segments")
    for number in range(5):
        robots = rolling([(-30, -8 + 4 * number), (30, 8 - 3 * number)], 30.0, blink_in(SHAPE))
        rng = np.random.default_rng(number)
        make_film(folder / f"{number}.mkv", robots, rng, light_at=light_of(SHAPE), optics=OPTICS, duration_s=1.5)
    return sorted(folder.iterdir())


def test_processes_find_what_one_finds(segments):
    done = []
    alone = track_segments(segments, None, workers=1)
    shared = track_segments(segments, None, workers=2, progress=lambda *now: done.append(now))
    assert alone.equals(shared)
    assert done == [(number, 5) for number in range(1, 6)]
    assert alone.groupby("line").size().tolist() == [45] * 5


@pytest.mark.skipif(sys.platform == "win32", reason="the keyboard's interrupt goes to a process group")
def test_an_interrupt_is_told_once_and_leaves_neither_files_nor_processes(segments, tmp_path):
    """As from the keyboard: to all processes at once, while the workers start or work."""
    script = textwrap.dedent(
        """
        import sys
        from lab.cli.main import main
        import tracking.track
        if __name__ == "__main__":
            print("ready", flush=True)
            sys.exit(main(["track", *sys.argv[1:]]))
        """
    )
    (tmp_path / "go.py").write_text(script)
    films = [tmp_path / f"{number}.mkv" for number in range(400)]
    for number, film in enumerate(films):
        film.symlink_to(segments[number % len(segments)])
    out = tmp_path / "out" / "t.csv"
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "go.py"), *map(str, films), "--workers", "2", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout.readline().strip() == "ready"
        time.sleep(3.0)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)  # returns once no process holds the pipes any more
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    assert process.returncode == 1
    assert "Traceback" not in said
    assert said.lower().count("interrupt") <= 1
    assert not out.exists()
