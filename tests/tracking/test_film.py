"""The synthesiser: what it says is in a film is what a reader finds there, for every container and fault."""

import numpy as np
import pytest
import shapely

from lab.base.errors import RequestError
from tracking.film import (
    FilmEncoding,
    FilmFaults,
    blink_in,
    default_optics,
    light_of,
    make_film,
    rolling,
    together,
    wander,
)
from tracking.stamps import frozen, timing_of
from tracking.synthetic import CameraSettings
from tracking.track import track_video
from tracking.video import VideoError, ending_of, probe, read_frames

OPTICS = default_optics((320, 240), px_per_cm=4.0)
SHAPE = shapely.box(-8, -6, 8, 6)
QUIET = CameraSettings(noise_sigma=0.5, floor_texture=0.0)


def film(path, *, faults=None, encoding=None, duration_s=2.0, seed=1, robots=None, **more):
    rng = np.random.default_rng(seed)
    robots = robots or rolling(wander(rng, (60.0, 40.0), length_cm=100.0), 25.0, blink_in(SHAPE))
    more = {"optics": OPTICS, "light_at": light_of(SHAPE)} | more
    return make_film(path, robots, rng, duration_s=duration_s, faults=faults, encoding=encoding, **more)


@pytest.mark.parametrize("ending", ["mkv", "mp4", "avi"])
@pytest.mark.parametrize("codec", ["h264", "mjpeg"])
@pytest.mark.parametrize("b_frames", [0, 2])
def test_rows_are_frames_with_their_own_times(tmp_path, ending, codec, b_frames):
    faults = FilmFaults(
        dropped=0.1, duplicated=0.1, jitter=0.0 if ending == "avi" else 0.2, rotation_deg=0 if ending == "avi" else 90
    )
    truth = film(tmp_path / f"film.{ending}", faults=faults, encoding=FilmEncoding(codec=codec, b_frames=b_frames))
    assert len(truth.dropped) > 1 and truth.frames["duplicate"].sum() > 1
    assert truth.frames["dropped_before"].sum() == len(truth.dropped)
    table = track_video(truth.path, calibration=truth.calibration)
    assert len(table) == len(truth.frames) == 60 - len(truth.dropped)
    delay = 0.0
    if ending == "avi" and b_frames and codec == "h264":  # an AVI does not say when a frame is shown
        delay = np.median(table["t_s"] - truth.frames["t_s"])
        assert abs(delay) < 0.1
        assert np.mean(np.abs(table["t_s"] - delay - truth.frames["t_s"]) < 1e-6) > 0.8
    else:
        assert np.abs(table["t_s"] - truth.frames["t_s"]).max() < 1e-6


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_places_are_those_of_the_upright_picture(tmp_path, turn):
    robots = rolling([(-30, -20), (30, 15)], 30.0)
    truth = film(tmp_path / "film.mp4", faults=FilmFaults(rotation_deg=turn), robots=robots, light_at=None)
    assert probe(truth.path).size == OPTICS.image_size
    table = track_video(truth.path, calibration=truth.calibration)
    here = truth.of()
    assert np.hypot(table["x_px"] - here["x_px"], table["y_px"] - here["y_px"]).median() < 0.3
    seen = OPTICS.project(np.column_stack([here[["x_cm", "y_cm"]], np.full(len(here), 7.3)]))
    assert np.allclose(seen, here[["x_px", "y_px"]])


def test_a_grey_camera_has_no_colour_and_a_glint_is_where_it_is_said(tmp_path):
    truth = film(tmp_path / "grey.mkv", faults=FilmFaults(grey=True, still_glints=1), robots=lambda _: [], camera=QUIET)
    plain = film(tmp_path / "plain.mkv", robots=lambda _: [], camera=QUIET)
    with read_frames(truth.path) as glinting, read_frames(plain.path) as other:
        with_glint, without = next(glinting), next(other)
    colour = with_glint.chroma()
    assert colour is None or all((plane == 128).all() for plane in colour)
    assert np.abs(without.chroma()[1].astype(int) - 128).max() < 6
    difference = with_glint.luma.astype(int) - without.luma
    assert difference.max() > 50
    assert (difference > 20).sum() < 400
    assert len(truth.robots) == 0


def test_flicker_is_the_mean_over_the_exposure(tmp_path):
    """Against the mean of the light's own samples over each exposure."""
    faults = FilmFaults(flicker=0.5, flicker_hz=37.0)
    camera = CameraSettings(noise_sigma=0.0, floor_texture=0.0, vignetting=0.0, exposure_s=0.01)
    encoding = FilmEncoding(codec="mjpeg", quality=10)
    truth = film(tmp_path / "f.mkv", faults=faults, robots=lambda _: [], camera=camera, encoding=encoding)
    lit = [float(frame.luma[118:122, 158:162].mean()) for frame in read_frames(truth.path)]
    moments = truth.frames["t_s"].to_numpy()[:, None] + np.linspace(-0.005, 0.005, 2001)
    light = 1.0 + 0.5 * np.cos(2 * np.pi * 37.0 * moments).mean(axis=1)
    assert np.abs(lit - (16.0 + 0.8 * 120.0 * light)).max() < 1.5


def test_light_lies_where_the_shape_is():
    ring = shapely.Point(3, -2).buffer(10).difference(shapely.box(0, -4, 6, 0))
    light = light_of(ring, blur_cm=0.05, light_from_cm=(10.0, 0.0, 250.0))
    points = np.random.default_rng(2).uniform(-20, 20, (5000, 2))
    clear = shapely.distance(ring.boundary, shapely.points(points)) > 0.3
    inside = shapely.contains_xy(ring, *points.T)
    assert np.allclose(light(*points[clear].T, 0.0), np.where(inside[clear], 120.0, 20.0), atol=0.5)
    # At a height the light stands nearer to the projector: the ray through (10, 0, 250) tells where it would land.
    landing = np.array([10.0, 0.0]) + (points - (10.0, 0.0)) * 250.0 / 240.0
    clear = shapely.distance(ring.boundary, shapely.points(landing)) > 0.3
    inside = shapely.contains_xy(ring, *landing.T)
    assert np.allclose(light(*points[clear].T, 10.0), np.where(inside[clear], 120.0, 20.0), atol=0.5)


def test_robots_roll_at_their_pace_and_stay_within_their_walls():
    points = wander(np.random.default_rng(3), (80.0, 40.0), length_cm=2000.0)
    assert (np.abs(points) <= (40.0 + 1e-9, 20.0 + 1e-9)).all()
    on_wall = np.isclose(np.abs(points), (40.0, 20.0)).any(axis=1)
    assert on_wall.all()
    one = rolling([(0, 0), (3, 4), (3, 10)], 2.0)
    places = [(view.x_cm, view.y_cm, view.vx_cm_s, view.vy_cm_s) for t in (0.5, 3.5, 99.0) for view in one(t)]
    assert np.allclose(places, [(0.6, 0.8, 1.2, 1.6), (3, 6, 0, 2), (3, 10, 0, 0)])
    assert len(together(one, one)(0.0)) == 2


def test_what_cannot_be_filmed_is_told(tmp_path):
    with pytest.raises(RequestError, match="has no stamps"):
        film(tmp_path / "a.avi", faults=FilmFaults(jitter=0.1))
    with pytest.raises(RequestError, match="name it so"):
        film(tmp_path / "a.gif")
    with pytest.raises(RequestError, match="no such folder"):
        film(tmp_path / "no" / "a.mkv")
    with pytest.raises(RequestError, match="make it longer"):
        film(tmp_path / "a.mkv", duration_s=0.001)
    for broken in ({"dropped": 1.0}, {"rotation_deg": 45}, {"flicker": 2.0}):
        with pytest.raises(RequestError, match="film"):
            FilmFaults(**broken)
    with pytest.raises(RequestError, match="codec"):
        FilmEncoding(codec="vp9")
    with pytest.raises(RequestError, match="path"):
        rolling([(0, 0)], 1.0)


def test_stamps_tell_the_rate_and_what_is_missing(tmp_path):
    truth = film(tmp_path / "f.mkv", faults=FilmFaults(dropped=0.1, duplicated=0.1), duration_s=4.0)
    table = track_video(truth.path)
    timing = timing_of(table["t_s"])
    assert timing.rate_hz == pytest.approx(30.0, rel=2e-3)
    assert timing.dropped == len(truth.dropped)
    assert timing.duplicated == 0
    found = frozen(table["t_s"], table["x_px"], table["y_px"])
    assert np.mean(found == truth.frames["duplicate"]) > 0.97
    assert timing_of([0.0, 0.04, 0.04, 0.08, 0.2]).duplicated == 1
    assert timing_of([0.0, 0.04, 0.08, 0.2, 0.24]).dropped == 2
    assert np.isnan(timing_of([1.0]).rate_hz)


CUTS = 27
CASES = {
    "a.mkv": FilmEncoding(),
    "b.mkv": FilmEncoding(codec="mjpeg"),
    "c.mkv": FilmEncoding(b_frames=2),
    "d.mp4": FilmEncoding(movflags="faststart", b_frames=2),
    "e.mp4": FilmEncoding(movflags="frag_keyframe+empty_moov", key_frames=8),
    "f.mp4": FilmEncoding(),
    "g.avi": FilmEncoding(),
    "h.avi": FilmEncoding(codec="mjpeg"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_file_cut_anywhere_gives_its_good_frames_and_says_so(tmp_path, name):
    """Eight kinds of file, 27 cuts each: what is read is what the whole file holds, or one line says why not."""
    optics = default_optics((96, 64), px_per_cm=1.0)
    path = film(tmp_path / name, encoding=CASES[name], optics=optics).path
    data = path.read_bytes()
    with read_frames(path) as reader:
        whole = {round(frame.t_s, 4): frame.luma.copy() for frame in reader}
        assert not reader.truncated and reader.frames_lost == 0 and reader.damage is None
    cut, good = path.with_name(f"cut.{name}"), 0
    for length in sorted(np.random.default_rng(4).integers(1, len(data) - 1, CUTS)):
        cut.write_bytes(data[:length])
        try:
            with read_frames(cut, quiet=True) as reader:
                for frame in reader:
                    assert np.array_equal(frame.luma, whole[round(frame.t_s, 4)])
        except VideoError as error:
            assert str(cut) in str(error) and "\n" not in str(error)
            continue
        good += 1
        assert reader.truncated
        assert "cut short" in reader.damage
        if name[0] in "abdgh":
            assert reader.frames_lost == len(whole) - reader.frames_read
        ending = ending_of(reader.info, reader.frames_read, frame.t_s)
        assert ending.truncated and ending.frames_lost == reader.frames_lost
    assert good == 0 if name == "f.mp4" else good > CUTS // 2
