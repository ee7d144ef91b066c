"""The bench: what it does when a device fails by itself, or hangs elsewhere than it is said to."""

import math

import numpy as np
import pytest

from lab.bench.rigcheck import RigError
from lab.session.experiment import run_experiment
from lab.settings.load import load_settings
from lab.store.reader import SessionReader
from projector.device import ProjectorError
from projector.virtual import VirtualProjector
from tests.lab.conftest import STARTED
from tracking.calibration import Calibration, save_calibration


def test_a_window_that_closes_by_itself_ends_the_session_in_its_own_words(tmp_path, monkeypatch):
    """Without light the robot would go on measuring darkness."""
    monkeypatch.setattr(VirtualProjector, "problem", None, raising=False)

    def watch(step):
        if step.line == 4:
            monkeypatch.setattr(VirtualProjector, "problem", "the window was closed; run again")

    settings = load_settings(None, {"out": str(tmp_path), "camera": "none", "stop.lines": 100})
    finished = run_experiment(settings, started=STARTED, watch=watch)
    assert isinstance(finished.failure, ProjectorError)
    assert str(finished.failure) == "the window was closed; run again"
    lines = [event["line"] for event in SessionReader(finished.folder).events() if event["event"] == "line"]
    assert lines == [0, 1, 2, 3, 4]


def turned_camera(folder, tilt_deg):
    """A calibration file of the default camera, tilted further about the arena's y axis than a session believes."""
    believed = load_settings(None).camera_optics
    truth = believed.model_copy(update={"tilt_deg": (believed.tilt_deg[0], believed.tilt_deg[1] + tilt_deg)})
    path = folder / "truth.json"
    save_calibration(Calibration(truth.pinhole(), 7.3), path)
    return path


def test_a_camera_that_was_turned_is_refused_with_what_was_seen(tmp_path):
    """Turned by the angle a, a camera at the height H sees the point below it H tan a off: 18 mm for half a degree."""
    keys = {"out": str(tmp_path), "stop.lines": 2, "virtual.camera_optics": str(turned_camera(tmp_path, 0.5))}
    with pytest.raises(RigError, match="calibrate projector") as caught:
        run_experiment(load_settings(None, keys), started=STARTED)
    below_mm = 10 * 205 * math.tan(math.radians(0.5))
    assert below_mm < caught.value.shift_mm < 1.5 * below_mm  # more towards the picture's edge
    assert not list(tmp_path.glob("2026*"))


def test_a_rig_that_hangs_as_calibrated_is_filmed(tmp_path):
    keys = {"out": str(tmp_path), "stop.lines": 2, "virtual.camera_optics": str(turned_camera(tmp_path, 0.02))}
    assert run_experiment(load_settings(None, keys), started=STARTED).outcome.n == 2


def test_the_check_can_be_left_out(tmp_path):
    path = str(turned_camera(tmp_path, 0.5))
    keys = {"out": str(tmp_path), "stop.lines": 2, "virtual.camera_optics": path, "rig_limit_mm": 0}
    assert np.isfinite(run_experiment(load_settings(None, keys), started=STARTED).outcome.rolling_s)
