"""The follower on pictures drawn from a known truth: raw centres on flat floor and near projected edges."""

import math
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
import pytest

from lab.base.pinhole import Pinhole
from tracking.background import background_from
from tracking.follow import LedFollower
from tracking.ledstate import led_states
from tracking.sighting import places
from tracking.synthetic import CameraSettings, OverheadScene, RobotView
from tracking.video import read_frames

SIZE = (640, 360)
PX_PER_CM = 4.0
HALF_CM = 14.0
NEAR_PX = 40.0
# Passes over the shape; the proof in full takes 12 or more.
PASSES = 4


@dataclass
class Picture:
    luma: np.ndarray
    planes: tuple | None

    def chroma(self):
        return self.planes


@dataclass
class Shot:
    """Pictures with their truth; ``edge_px``: distance of the robot from the nearest projected edge."""

    pictures: list
    t_s: np.ndarray
    passes: np.ndarray
    truth_px: np.ndarray
    level: np.ndarray
    edge_px: np.ndarray


def shoot(
    *,
    blur_cm=0.08,
    half_cm=HALF_CM,
    dim=0.25,
    colour=False,
    seed=1,
    speed_cm_s=22.0,
    passes=PASSES,
    flicker=0.0,
    **camera,
):
    """A robot that crosses a lit square again and again, its LED bright inside; projector and camera hang apart."""
    rng = np.random.default_rng(seed)
    optics = Pinhole.looking_down(
        SIZE,
        height_cm=205.0,
        field_width_cm=SIZE[0] / PX_PER_CM,
        distortion=(-0.04, 0, 0, 0, 0),
        tilt_rad=(0.02, -0.01),
    )

    def light_at(x_cm, y_cm, height_cm):
        spread = 250.0 / (250.0 - height_cm)
        sides = (20.0 + (x_cm - 20.0) * spread, 10.0 + (y_cm - 10.0) * spread)
        inside = [1 / (1 + np.exp(np.clip((np.abs(side) - half_cm) / blur_cm, -60, 60))) for side in sides]
        return 20.0 + 100.0 * inside[0] * inside[1]

    scene = OverheadScene(optics, light_at, rng, CameraSettings(**camera), light_from_cm=(20.0, 10.0, 250.0))
    pictures, where, level, edge, times, which = [], [], [], [], [], []
    for number in range(passes):
        angle, aside = rng.uniform(0, 2 * np.pi), rng.uniform(-half_cm, half_cm)
        along = np.array([math.cos(angle), math.sin(angle)])
        across = aside * np.array([-along[1], along[0]])
        way = [across + s * along for s in np.arange(-60.0, 60.0, speed_cm_s / 30.0)]
        way = [place for place in way if (np.abs(place) < (60.0, 38.0)).all()]
        for step, place in enumerate(way):
            outside = np.abs(place) - half_cm
            inside = bool((outside < 0).all())
            shines = 1.0 if inside else dim
            robots = [RobotView(*place, shines, *(speed_cm_s * along))]
            rows = np.arange(SIZE[1])
            lamp = 1.0 + flicker * np.sin(2 * np.pi * (rows / 90.0 + 0.37 * step)) if flicker else None
            packed = scene.render(robots, light=lamp)
            u, v = packed[SIZE[1] :].reshape(2, SIZE[1] // 2, SIZE[0] // 2)
            pictures.append(Picture(packed[: SIZE[1]], (u, v) if colour else None))
            where.append(place)
            level.append(shines)
            edge.append(PX_PER_CM * abs(float(outside.max() if inside else np.hypot(*np.maximum(outside, 0)))))
            times.append(step / 30.0)
            which.append(number)
    truth = optics.project(np.column_stack([where, np.full(len(where), 7.3)]))
    return Shot(pictures, np.array(times), np.array(which), truth, np.array(level), np.array(edge))


def compressed(shot, path):
    """The same pictures after H.264 at constant quality 20."""
    with av.open(str(path), "w") as container:
        options = {"preset": "veryfast", "tune": "zerolatency", "crf": "20"}
        stream = container.add_stream("libx264", rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for number, picture in enumerate(shot.pictures):
            grey = np.full((2, SIZE[1] // 2, SIZE[0] // 2), 128, np.uint8) if picture.planes is None else picture.planes
            packed = np.vstack([picture.luma, np.reshape(grey, (-1, SIZE[0]))])
            frame = av.VideoFrame.from_ndarray(packed, format="yuv420p")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    pictures = []
    with read_frames(path) as reader:
        for frame, before in zip(reader, shot.pictures, strict=True):
            planes = None if before.planes is None else tuple(plane.copy() for plane in frame.chroma())
            pictures.append(Picture(frame.luma.copy(), planes))
    return Shot(pictures, shot.t_s, shot.passes, shot.truth_px, shot.level, shot.edge_px)


def follow(shot):
    """(n, 4) places of all passes, each followed by itself as a session's segments are; and the sightings."""
    picked = np.linspace(0, len(shot.pictures) - 1, 31).round().astype(int)
    floor = background_from([shot.pictures[number] for number in picked])
    found, sightings = np.full((len(shot.pictures), 4), np.nan), []
    for number in np.unique(shot.passes):
        mine = np.flatnonzero(shot.passes == number)
        follower = LedFollower(floor)
        for place in mine:
            follower.step(shot.t_s[place], shot.pictures[place].luma, shot.pictures[place].chroma)
        seen = follower.finish()
        sightings += seen
        found[mine] = places(seen, shot.t_s[mine])
    return found, sightings


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


CASES = {
    "grey": {},
    "grey, blurred edge": {"blur_cm": 0.5},
    "grey, noisy": {"noise_sigma": 4.0},
    "grey, motion blur": {"exposure_s": 0.02, "speed_cm_s": 40.0},
    "red": {"colour": True},
    "red, blurred edge": {"colour": True, "blur_cm": 0.5},
    "grey, compressed": {},
    "red, compressed": {"colour": True},
}


@pytest.mark.parametrize("case", CASES)
def test_projected_edges_do_not_pull_the_spot(case, tmp_path):
    shot = shoot(**CASES[case])
    if "compressed" in case:
        shot = compressed(shot, tmp_path / "film.mkv")
    found, sightings = follow(shot)
    near, bright = shot.edge_px < NEAR_PX, shot.level > 0.5
    assert np.isfinite(found[:, 0]).mean() > 0.98
    error = found[:, :2] - shot.truth_px
    seen = np.isfinite(error).all(axis=1)
    for here in (near & bright & seen, near & ~bright & seen):
        assert here.sum() > 25
        assert rms(error[here]) <= 0.25
    # The stated variance is the error's, on flat floor and near edges alike.
    for here in (near & seen, ~near & seen):
        assert 0.4 < np.mean(error[here] ** 2 / found[here, 2:]) < 2.5
    amplitude = np.array([s.amplitude if s else np.nan for s in sightings])
    sigma = np.array([s.amplitude_sigma if s else np.nan for s in sightings])
    states = led_states(amplitude, sigma, found[:, 0], found[:, 1])
    assert (states.on == bright)[seen].mean() >= 0.995


@pytest.mark.parametrize("colour", [False, True])
def test_lit_centres_away_from_edges_come_near_the_cramer_rao_bound(colour):
    shot = shoot(noise_sigma=6.0, colour=colour, seed=3, half_cm=26.0, dim=1.0)
    found, _ = follow(shot)
    flat = (shot.edge_px >= NEAR_PX) & (shot.level > 0.5)
    error = (found[:, :2] - shot.truth_px)[flat]
    # Grey levels are rounded besides: their variance is 1/12. Colour adds to what luma alone can give.
    bound = math.sqrt(2.0 / math.pi) * math.hypot(6.0, math.sqrt(1.0 / 6.0)) / 110.0
    assert flat.sum() > 60
    assert rms(error) < 1.3 * bound


@pytest.mark.parametrize("seed", [3, 4])
def test_a_dim_led_in_noise_is_not_sought_in_the_shape(seed):
    # The shape covers half of the picture; its LED dims to 27 grey levels outside, with noise of 6.
    shot = shoot(noise_sigma=6.0, seed=seed, half_cm=26.0)
    found, _ = follow(shot)
    seen = np.isfinite(found[:, 0])
    assert seen[shot.level > 0.5].all()
    assert seen.mean() > 0.97
    assert np.hypot(*(found[:, :2] - shot.truth_px)[seen].T).max() < 3.0


def test_a_flickering_lamp_does_not_change_the_leds_state():
    shot = shoot(flicker=0.15, seed=5)
    found, sightings = follow(shot)
    amplitude = np.array([s.amplitude if s else np.nan for s in sightings])
    sigma = np.array([s.amplitude_sigma if s else np.nan for s in sightings])
    states = led_states(amplitude, sigma, found[:, 0], found[:, 1])
    assert (states.on == (shot.level > 0.5)).mean() >= 0.995
    assert rms(found[:, :2][np.isfinite(found[:, 0])] - shot.truth_px[np.isfinite(found[:, 0])]) < 0.25


def test_an_led_that_is_off_in_the_dark_is_found_again_in_the_light():
    shot = shoot(dim=0.0, seed=6)
    found, sightings = follow(shot)
    on = shot.level > 0.5
    seen = np.isfinite(found[:, 0])
    assert (seen == on).mean() > 0.995
    assert not (seen & ~on).any()
    amplitude = np.array([s.amplitude if s else np.nan for s in sightings])
    states = led_states(amplitude, np.where(seen, 2.0, np.nan), found[:, 0], found[:, 1])
    assert (states.on == on).mean() >= 0.995
    assert rms((found[:, :2] - shot.truth_px)[seen]) < 0.25
