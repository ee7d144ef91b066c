"""Tracking a 1280x720 H.264 segment against decoding the same file, the limit."""

import numpy as np
import pytest

from lab.experiment import run_experiment
from lab.settings import load_settings
from lab.store import SessionReader
from tests.lab.conftest import STARTED
from tracking.background import background_of
from tracking.calibration import Calibration
from tracking.track import track_video
from tracking.video import read_frames


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    settings = load_settings(
        None, {"out": str(tmp_path_factory.mktemp("film")), "shape": "eiffel", "stop.lines": 6, "seed": 1}
    )
    session = SessionReader(run_experiment(settings, started=STARTED).folder)
    segments = list(session.segments().values())
    longest = max(segments, key=lambda path: path.stat().st_size)
    return longest, background_of(segments), Calibration.from_dict(session.manifest["calibration"]["camera"])


def test_decode_alone(benchmark, film):
    benchmark(lambda: np.sum([frame.luma[0, 0] for frame in read_frames(film[0])]))


def test_track(benchmark, film):
    video, background, calibration = film
    benchmark(track_video, video, calibration=calibration, background=background)
