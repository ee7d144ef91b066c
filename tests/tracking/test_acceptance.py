"""Films with every fault at once, against their truth: the figures that the tracker is to reach."""

import numpy as np
import pytest
import shapely

from tracking.film import FilmFaults, blink_in, light_of, make_film, rolling, wander
from tracking.synthetic import CameraSettings
from tracking.track import track_video

SHAPE = shapely.box(-28, -18, 28, 18).difference(shapely.box(-8, -6, 8, 6))
SPEED_CM_S = 25.0
FAULTS = {
    "none": FilmFaults(),
    "uneven": FilmFaults(dropped=0.03, duplicated=0.03, jitter=0.2),
    "glints": FilmFaults(still_glints=5, moving_glints=5),
    "flicker": FilmFaults(flicker=0.15, readout_s=0.012),
    "all": FilmFaults(dropped=0.03, duplicated=0.02, flicker=0.15, readout_s=0.012, still_glints=4, moving_glints=4),
    "grey": FilmFaults(dropped=0.03, duplicated=0.02, flicker=0.15, readout_s=0.012, grey=True),
    "grey, glints": FilmFaults(still_glints=5, moving_glints=8, grey=True),
    "grey, all": FilmFaults(
        dropped=0.03, duplicated=0.02, flicker=0.15, readout_s=0.012, still_glints=4, moving_glints=4, grey=True
    ),
}


ALWAYS = ("uneven", "all", "grey, all")  # the others are parts of these, and wait for --full


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_film_with_faults_is_tracked_to_a_millimetre(tmp_path, name, full):
    """720p, 4 px/cm, tilted, noise 2.5, blur over 12 ms, a lit shape, 25 s of rolling."""
    if not full and name not in ALWAYS:
        pytest.skip("run with --full")
    rng = np.random.default_rng(11)
    way = wander(rng, (110.0, 66.0), length_cm=700.0)
    camera = CameraSettings(exposure_s=0.012, noise_sigma=2.5)
    robots = rolling(way, SPEED_CM_S, blink_in(SHAPE))
    film = make_film(
        tmp_path / "film.mkv",
        robots,
        rng,
        light_at=light_of(SHAPE),
        duration_s=25.0,
        camera=camera,
        faults=FAULTS[name],
    )
    table, truth = track_video(film.path, calibration=film.calibration), film.of()
    assert len(table) == len(film.frames)
    fresh = ~film.frames["duplicate"].to_numpy()
    error_px = np.hypot(table["x_px"] - truth["x_px"], table["y_px"] - truth["y_px"]).to_numpy()
    assert np.isfinite(error_px).mean() > 0.99
    assert np.nanmax(error_px[fresh]) < 3.0  # no jump to a glint
    assert np.mean(table["led_on"].to_numpy()[fresh] == truth["led_on"].to_numpy()[fresh]) >= 0.995
    turns_s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T)) / SPEED_CM_S])
    t_s = table["t_s"].to_numpy()
    straight = (np.abs(t_s[:, None] - turns_s).min(axis=1) > 0.2) & (t_s < t_s[-1] - 0.2)
    off_cm = np.hypot(table["x_smooth_cm"] - truth["x_cm"], table["y_smooth_cm"] - truth["y_cm"]).to_numpy()
    assert np.sqrt(np.mean(off_cm[straight] ** 2)) <= 0.1
