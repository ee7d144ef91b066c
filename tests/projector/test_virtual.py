import numpy as np
import pytest
import scipy.ndimage
from shapely.geometry import box

from lab.base.errors import RequestError
from lab.base.pinhole import Pinhole
from projector import kernels
from projector.device import ProjectorDevice, ProjectorRequestError
from projector.dictionary import load_dictionary
from projector.render import render
from projector.virtual import LightSettings, VirtualProjector

SENSOR_CM = 6.0
STRAIGHT = Pinhole.looking_down((1920, 1080), height_cm=250, field_width_cm=180)
BENT = Pinhole.looking_down(
    (1920, 1080), height_cm=250, field_width_cm=200, tilt_rad=(0.02, 0.03), distortion=(0.05, -0.02, 0.001, 0.001, 0)
)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def by_hand(projector, x, y, height_cm):
    """The same light by scipy: blur, then bilinear lookup at the projected points, ambient outside."""
    settings = projector.settings
    light = (projector.image / 255.0) ** settings.gamma
    blurred = scipy.ndimage.gaussian_filter(light, settings.blur_px, mode="nearest", truncate=4)
    lux = settings.black_lux + (settings.white_lux - settings.black_lux) * blurred
    u, v = projector.pinhole.project(np.column_stack([x, y, np.full(len(x), height_cm)])).T
    return settings.ambient_lux + scipy.ndimage.map_coordinates(np.pad(lux, 1), [v + 1, u + 1], order=1, cval=0.0)


@pytest.mark.parametrize("pinhole", [STRAIGHT, BENT])
@pytest.mark.parametrize("height_cm", [0.0, SENSOR_CM])
def test_light_is_the_blurred_image_seen_along_the_ray(pinhole, height_cm, rng):
    projector = VirtualProjector(pinhole)
    projector.show(rng.integers(0, 256, (1080, 1920), dtype=np.uint8))
    # some points fall beyond the image
    x, y = rng.uniform(-110, 110, 4000), rng.uniform(-70, 70, 4000)
    assert projector.light_at(x, y, height_cm) == pytest.approx(by_hand(projector, x, y, height_cm), abs=0.6)


def test_dark_and_lit_and_beyond():
    projector = VirtualProjector(STRAIGHT)
    assert projector.light_at(0.0, 0.0, SENSOR_CM) == pytest.approx(20)
    projector.show(render(box(-10, -10, 10, 10), STRAIGHT, SENSOR_CM))
    light = projector.light_at(np.array([0, 30, 300, np.nan]), np.array([0, 0, 0, 0]), SENSOR_CM)
    assert light == pytest.approx([120, 20, 15, 15])
    assert projector.settings.dark_lux == 20
    assert projector.settings.lit_lux == 120


@pytest.mark.parametrize("name", ["circle", "square", "triangle", "chichen_itza", "eiffel", "liberty"])
def test_the_sensor_meets_every_shape_at_true_size(name):
    shape = load_dictionary()[name]
    projector = VirtualProjector(STRAIGHT)
    projector.show(render(shape.geometry, STRAIGHT, SENSOR_CM))
    step = 0.1
    x, y = np.meshgrid(np.arange(-55, 55, step), np.arange(-42, 42, step))
    share = (projector.light_at(x, y, SENSOR_CM) - 20) / 100
    assert share.shape == x.shape
    assert share.sum() * step**2 == pytest.approx(shape.area_cm2, rel=2e-3)
    above = (projector.light_at(x, y, 12.0) - 20) / 100
    assert above.sum() * step**2 == pytest.approx(shape.area_cm2 * (238 / 244) ** 2, rel=2e-3)


def test_the_edge_lies_at_half_light():
    projector = VirtualProjector(STRAIGHT)
    projector.show(render(box(-20.03, -20.03, 20.03, 20.03), STRAIGHT, SENSOR_CM))
    x = np.linspace(19, 21, 2001)
    light = projector.light_at(x, np.zeros_like(x), SENSOR_CM)
    assert (np.diff(light) <= 1e-9).all()
    assert x[np.argmax(light < 70)] == pytest.approx(20.03, abs=0.01)


def test_shapes_of_arguments(rng):
    projector = VirtualProjector(STRAIGHT)
    projector.show(rng.integers(0, 256, (1080, 1920), dtype=np.uint8))
    assert projector.light_at(1.0, 2.0, 0.0).shape == ()
    rows = projector.light_at(np.arange(3.0)[:, None], np.arange(4.0), 0.0)
    assert rows.shape == (3, 4)
    assert rows[2, 3] == projector.light_at(2, 3, 0.0)
    every_other = projector.light_at(np.arange(10.0)[::2], np.arange(10.0)[::-2], 0.0)
    assert every_other[1] == projector.light_at(2.0, 7.0, 0.0)
    assert projector.light_at([], [], 0.0).shape == (0,)


def test_the_compiled_loop_does_what_the_plain_one_does(rng):
    image = rng.uniform(0, 100, (30, 40)).astype(np.float32)
    homography = np.array([[1.0, 0.1, 20], [0.05, -1.1, 15], [1e-3, -2e-3, 1]])
    x, y = rng.uniform(-30, 30, (2, 200))
    x[0] = np.nan
    plain, compiled = np.empty(200), np.empty(200)
    kernels._sample_plane(image, homography, x, y, 15.0, plain)
    kernels.sample_plane(image, homography, x, y, 15.0, compiled)
    assert compiled == pytest.approx(plain, rel=1e-12)
    assert (plain > 15).sum() > 50


def test_many_heights_stay_bounded():
    projector = VirtualProjector(STRAIGHT)
    for height_cm in np.linspace(0, 50, 200):
        projector.light_at(0.0, 0.0, float(height_cm))
    assert len(projector._homographies) <= 32


def test_it_is_a_projector_and_counts_its_images():
    projector = VirtualProjector(STRAIGHT)
    assert isinstance(projector, ProjectorDevice)
    assert projector.image_size == (1920, 1080)
    image = np.zeros((1080, 1920), np.uint8)
    projector.show(image)
    image[:] = 255
    assert projector.shows == 1
    assert projector.image.max() == 0
    projector.close()
    with pytest.raises(ProjectorRequestError, match="1920 x 1080"):
        projector.show(np.zeros((10, 10), np.uint8))
    with pytest.raises(ProjectorRequestError, match="float64"):
        projector.show(np.zeros((1080, 1920)))


def test_without_blur_pixels_are_exact():
    projector = VirtualProjector(STRAIGHT, LightSettings(blur_px=0, ambient_lux=0, black_lux=0, white_lux=100, gamma=1))
    image = np.zeros((1080, 1920), np.uint8)
    image[500, 1000] = 255
    projector.show(image)
    (x, y), (xr, yr) = STRAIGHT.to_plane([[1000, 500], [1000.25, 500]], 0.0)
    assert projector.light_at(x, y, 0.0) == pytest.approx(100)
    assert projector.light_at(xr, yr, 0.0) == pytest.approx(75)


@pytest.mark.parametrize(
    "settings", [{"blur_px": -1}, {"gamma": 0}, {"ambient_lux": float("nan")}, {"white_lux": 5}, {"black_lux": 200}]
)
def test_settings_that_make_no_sense(settings):
    with pytest.raises(RequestError, match="light: "):
        LightSettings(**settings)
