"""The virtual camera: what it draws is where it should be, and its clock and faults are as set."""

import asyncio

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from lab.clock import run
from tracking.cameras import Camera, CameraRequestError, chroma_planes
from tracking.synthetic import CameraSettings, OverheadScene, RobotView
from tracking.virtual import VirtualCamera

SIZE = (640, 360)
OPTICS = Pinhole.looking_down(
    SIZE,
    height_cm=205.0,
    field_width_cm=165.0,
    centre_cm=(2.0, -1.0),
    tilt_rad=(0.02, -0.03),
    distortion=(-0.12, 0.03, 0.0, 0.0, 0.0),
)
PLAIN = CameraSettings(noise_sigma=0.0, vignetting=0.0, floor_texture=0.0, exposure_s=0.0)


def even_light(x_cm, y_cm, height_cm):
    return np.full(np.shape(x_cm), 60.0)


def projected(points) -> np.ndarray:
    """OpenCV's own forward projection."""
    pixels, _ = cv2.projectPoints(
        np.asarray(points, dtype=float).reshape(-1, 1, 3),
        OPTICS.rvec,
        OPTICS.tvec,
        OPTICS.camera_matrix,
        OPTICS.distortion,
    )
    return np.asarray(pixels).reshape(-1, 2)


def scene(light=even_light, camera=PLAIN, seed=1, **more) -> OverheadScene:
    return OverheadScene(OPTICS, light, np.random.default_rng(seed), camera, **more)


def luma(packed):
    return packed[: SIZE[1]].astype(float)


def centroid(picture) -> tuple[np.ndarray, np.ndarray]:
    """First and second moments (u, v), (var_u, var_v) of a picture that is dark but for one spot."""
    total = picture.sum()
    u, v = np.arange(picture.shape[1]), np.arange(picture.shape[0])
    mean = np.array([(picture.sum(0) * u).sum(), (picture.sum(1) * v).sum()]) / total
    var = np.array([(picture.sum(0) * (u - mean[0]) ** 2).sum(), (picture.sum(1) * (v - mean[1]) ** 2).sum()])
    return mean, var / total


SCENE = scene()


@settings(deadline=None, max_examples=40)
@given(st.floats(-65, 65), st.floats(-34, 34), st.floats(0.2, 1.0))
def test_the_led_lies_where_opencv_projects_it(x_cm, y_cm, level):
    lit = SCENE.render([RobotView(x_cm, y_cm, level)])
    unlit = SCENE.render([RobotView(x_cm, y_cm, 0.0)])
    truth = projected([(x_cm, y_cm, 7.3)])[0]
    spot, _ = centroid(luma(lit) - luma(unlit))
    assert np.allclose(spot, truth, atol=0.1)
    assert (luma(lit) - luma(unlit)).max() == pytest.approx(110 * level, rel=0.06, abs=1.0)


def test_the_led_is_red():
    lit = SCENE.render([RobotView(20.0, 10.0, 1.0)])
    u, v = (plane.astype(float) for plane in chroma_planes(lit))
    # Colour samples lie between two luma pixels.
    spot, _ = centroid(v - 128.0)
    assert np.allclose(2.0 * spot + 0.5, projected([(20.0, 10.0, 7.3)])[0], atol=0.2)
    assert v.max() > 200
    assert u.min() < 110
    middle = cv2.cvtColor(lit, cv2.COLOR_YUV2BGR_I420)[
        tuple(projected([(20.0, 10.0, 7.3)])[0][::-1].round().astype(int))
    ]
    assert middle[2] == 255
    assert middle[2] > 1.4 * max(int(middle[0]), int(middle[1]))


@pytest.mark.parametrize(("x_cm", "y_cm"), [(0.0, 0.0), (50.0, -30.0), (-60.0, 20.0)])
def test_the_ball_hides_the_floor_that_opencv_says(x_cm, y_cm):
    changed = np.abs(luma(SCENE.render([RobotView(x_cm, y_cm, 0.0)])) - luma(SCENE.render())) > 2
    # The silhouette of many points on the sphere, outlined by their convex hull.
    rng = np.random.default_rng(5)
    points = rng.normal(size=(4000, 3))
    points = 3.65 * points / np.linalg.norm(points, axis=1, keepdims=True) + [x_cm, y_cm, 3.65]
    hull = cv2.convexHull(projected(points).astype(np.float32))
    moments = cv2.moments(hull)
    v, u = np.nonzero(changed)
    assert changed.sum() == pytest.approx(cv2.contourArea(hull), rel=0.1)
    assert np.hypot(u.mean() - moments["m10"] / moments["m00"], v.mean() - moments["m01"] / moments["m00"]) < 0.5


def test_the_floor_shows_the_light_where_it_falls():
    def ramp(x_cm, y_cm, height_cm):
        assert height_cm == 0.0
        return 100.0 + 0.8 * x_cm - 0.5 * y_cm

    floor = luma(scene(ramp).render())
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-60, 60, 200), rng.uniform(-32, 32, 200), np.zeros(200)])
    expected = 16.0 + 0.8 * (100.0 + 0.8 * points[:, 0] - 0.5 * points[:, 1])
    pixels = projected(points).astype(np.float32)
    found = cv2.remap(floor.astype(np.float32), pixels[None, :, 0], pixels[None, :, 1], cv2.INTER_LINEAR)[0]
    assert np.abs(found - expected).max() < 0.9
    assert abs(float((found - expected).mean())) < 0.1


def test_the_ball_takes_the_light_that_falls_on_it():
    def half(x_cm, y_cm, height_cm):
        return np.where(x_cm > 0, 120.0, 20.0)

    picture = luma(scene(half).render([RobotView(0.0, 0.0, 0.0)]))
    right, left = (projected([(x_cm, 0.0, 6.5)])[0].round().astype(int) for x_cm in (1.8, -1.8))
    bright, dim = picture[right[1], right[0]], picture[left[1], left[0]]
    assert bright - 16 == pytest.approx(6 * (dim - 16), rel=0.25)
    floor = luma(scene(half).render())
    assert bright < floor[right[1], right[0]]


def test_scene_changed_draws_the_floor_anew():
    level = {"lux": 20.0}
    drawn = scene(lambda x, y, h: np.full(np.shape(x), level["lux"]))
    assert luma(drawn.render()).mean() == pytest.approx(32.0)
    level["lux"] = 100.0
    assert luma(drawn.render()).mean() == pytest.approx(32.0)
    drawn.scene_changed()
    assert luma(drawn.render()).mean() == pytest.approx(96.0)
    assert drawn.floor_luma().mean() == pytest.approx(96.0)


def test_the_shadow_falls_away_from_the_projector():
    robot = [RobotView(40.0, 0.0, 0.0)]
    without = luma(scene().render(robot))
    shadowed = luma(scene(light_from_cm=(0.0, 0.0, 100.0)).render(robot))
    v, u = np.nonzero(without - shadowed > 5)
    assert len(u) > 20
    place = OPTICS.to_plane(np.column_stack([u, v]).astype(float), 0.0)
    assert (place[:, 0] > 40.0).all()
    # The ray that grazes the ball's far side ends here: d' from the shadow's closed form in the plane through both.
    to_ball, depth = np.arctan2(40.0, 100.0 - 3.65), np.hypot(40.0, 100.0 - 3.65)
    edge_cm = 100.0 * np.tan(to_ball + np.arcsin(3.65 / depth))
    assert place[:, 0].max() == pytest.approx(edge_cm, abs=0.5)


def test_noise_has_its_size_and_comes_from_the_seed():
    camera = CameraSettings(noise_sigma=2.0, vignetting=0.0, floor_texture=0.0)
    first, again, other = scene(camera=camera), scene(camera=camera), scene(camera=camera, seed=2)
    frames = [first.render() for _ in range(3)]
    assert all(np.array_equal(frame, again.render()) for frame in frames)
    assert not np.array_equal(frames[0], other.render())
    difference = luma(frames[0]) - luma(frames[1])
    # Rounding adds 1/12 to each variance.
    assert difference.std() == pytest.approx(np.sqrt(2 * (4.0 + 1 / 12)), rel=0.02)
    assert luma(frames[2]).mean() == pytest.approx(64.0, abs=0.1)
    assert chroma_planes(frames[0])[0].std() == pytest.approx(np.sqrt(1.0 + 1 / 12), rel=0.03)


def test_vignetting_darkens_the_corners_and_texture_is_fine():
    dim = luma(scene(camera=CameraSettings(noise_sigma=0, vignetting=0.3, floor_texture=0)).render())
    assert dim[0, 0] - 16 == pytest.approx(0.7 * 48, abs=1)
    assert dim[180, 320] - 16 == pytest.approx(48, abs=1)
    rough = luma(scene(camera=CameraSettings(noise_sigma=0, vignetting=0, floor_texture=0.05)).render())
    assert 0.5 < rough.std() / (0.05 * 48) < 1.1


def test_a_moving_led_smears_along_its_way():
    camera = CameraSettings(noise_sigma=0, vignetting=0, floor_texture=0, exposure_s=0.1)
    drawn = scene(camera=camera)
    moving = [RobotView(0.0, 0.0, 1.0, vx_cm_s=20.0), RobotView(0.0, 0.0, 0.0)]
    still = [RobotView(0.0, 0.0, 0.0)]
    place, var = centroid(luma(drawn.render(moving[:1])) - luma(drawn.render(still)))
    assert np.allclose(place, projected([(0.0, 0.0, 7.3)])[0], atol=0.1)
    start, end = projected([(-1.0, 0.0, 7.3), (1.0, 0.0, 7.3)])
    length_px = np.hypot(*(end - start))
    assert var[0] - var[1] == pytest.approx(length_px**2 / 12, rel=0.1)
    assert var[1] == pytest.approx(9.0, rel=0.06)


def test_robots_side_by_side_do_not_wipe_each_other_out():
    pair = [RobotView(0.0, 0.0, 1.0), RobotView(7.5, 0.0, 1.0)]
    both = luma(SCENE.render(pair))
    for robot in pair:
        u, v = projected([(robot.x_cm, robot.y_cm, 7.3)])[0].round().astype(int)
        assert both[v, u] > 110
    middle = projected([(3.75, 0.0, 0.0)])[0].round().astype(int)
    assert both[middle[1], middle[0]] < 64
    assert np.array_equal(both, luma(SCENE.render(pair[::-1])))


@pytest.mark.parametrize(("x_cm", "y_cm"), [(500.0, 0.0), (0.0, -300.0), (float("nan"), 0.0)])
def test_a_robot_out_of_sight_draws_nothing(x_cm, y_cm):
    assert np.array_equal(SCENE.render([RobotView(x_cm, y_cm, 1.0)]), SCENE.render())


def test_a_robot_at_the_border_is_drawn_as_far_as_it_is_seen():
    edge = OPTICS.to_plane([[-3.0, 100.0], [642.0, 100.0], [300.0, -2.0], [300.0, 361.0]], 7.3)
    for x_cm, y_cm in edge:
        assert np.count_nonzero(SCENE.render([RobotView(x_cm, y_cm, 1.0)]) != SCENE.render()) > 20


def test_a_width_that_is_no_multiple_of_four_works():
    optics = Pinhole.looking_down((322, 182), height_cm=205, field_width_cm=165)
    drawn = OverheadScene(optics, even_light, np.random.default_rng(1), PLAIN)
    for u in (300.0, 318.0, 321.0, 327.0):
        x_cm, y_cm = optics.to_plane([[u, 181.0]], 7.3)[0]
        assert drawn.render([RobotView(x_cm, y_cm, 1.0)]).shape == (273, 322)


def test_wrong_settings_are_told():
    for wrong in ({"rate_hz": 0.0}, {"noise_sigma": -1.0}, {"drop_probability": 1.0}, {"vignetting": 1.2}):
        with pytest.raises(RequestError, match="virtual camera"):
            CameraSettings(**wrong)
    odd = Pinhole.looking_down((321, 180), height_cm=205, field_width_cm=165)
    with pytest.raises(CameraRequestError, match=r"321x180.*even"):
        OverheadScene(odd, even_light, np.random.default_rng(1))


# ---- the camera's clock

SMALL = Pinhole.looking_down((64, 36), height_cm=205, field_width_cm=165)


def camera(seed=3, robots=lambda t_s: (), **more) -> VirtualCamera:
    chosen = CameraSettings(**({"drop_probability": 0.0} | more))
    return VirtualCamera(SMALL, even_light, robots, np.random.default_rng(seed), chosen)


async def take(device, count):
    await device.start()
    return [await device.next_frame() for _ in range(count)]


def test_frames_come_at_their_moments_on_the_loops_clock():
    asked = []
    device = camera(robots=lambda t_s: asked.append(t_s) or (), rate_hz=25.0, clock_drift_ppm=100.0)

    async def main():
        await asyncio.sleep(5.0)
        return await take(device, 100)

    frames = run(main(), virtual=True)
    due = 5.0 + (np.arange(100) + 1) / 25.0
    assert np.allclose([frame.t_host_s for frame in frames], due, atol=1e-6)
    assert np.allclose([frame.t_camera_s for frame in frames], (due - 5.0) * 1.0001, atol=1e-6)
    assert asked == [frame.t_host_s for frame in frames]
    assert [frame.index for frame in frames] == list(range(100))
    assert device.dropped == 0
    assert isinstance(device, Camera)
    assert (device.size, device.rate_hz, device.name, device.live) == ((64, 36), 25.0, "virtual", False)
    assert frames[0].size == (64, 36)
    assert frames[0].luma.shape == (36, 64)
    assert frames[0].chroma[1].shape == (18, 32)


def test_dropped_frames_are_jumps_in_the_index_and_counted():
    device = camera(drop_probability=0.1)
    frames = run(take(device, 600), virtual=True)
    index = np.array([frame.index for frame in frames])
    missing = int((np.diff(index) - 1).sum()) + int(index[0])
    assert device.dropped == missing
    # Binomial: 600 kept need about 667 tries, so 67 losses, give or take 4 sigma = 34.
    assert 33 < missing < 101
    assert np.allclose([frame.t_camera_s for frame in frames], (index + 1) / 30.0, atol=1e-6)


def test_the_same_seed_films_the_same():
    def pictures(seed):
        return [frame.i420.tobytes() for frame in run(take(camera(seed, drop_probability=0.2), 30), virtual=True)]

    assert pictures(3) == pictures(3)
    assert pictures(3) != pictures(4)


def test_a_late_taker_loses_frames_and_sees_it():
    async def main():
        device = camera(rate_hz=10.0)
        await device.start()
        first = await device.next_frame()
        await asyncio.sleep(0.75)  # 7 frames go by, and the 8th is half a period away
        second = await device.next_frame()
        return device, first, second

    device, first, second = run(main(), virtual=True)
    assert (first.index, second.index) == (0, 7)
    assert device.dropped == 6
    assert second.t_host_s - first.t_host_s == pytest.approx(0.75, abs=0.1)


def test_stop_ends_the_frames():
    async def main():
        device = camera()
        assert await device.next_frame() is None
        await device.start()
        waiting = asyncio.create_task(device.next_frame())
        await asyncio.sleep(0.001)
        await device.stop()
        last = await waiting
        await device.stop()
        return last, await device.next_frame()

    assert run(main(), virtual=True) == (None, None)


def test_scene_changed_reaches_the_picture():
    lux = {"now": 10.0}

    async def main():
        device = VirtualCamera(
            SMALL,
            lambda x, y, h: np.full(np.shape(x), lux["now"]),
            lambda t_s: (),
            np.random.default_rng(1),
        )
        await device.start()
        before = await device.next_frame()
        lux["now"] = 100.0
        device.scene_changed()
        return before.luma.mean(), (await device.next_frame()).luma.mean()

    before, after = run(main(), virtual=True)
    assert after > before + 50
