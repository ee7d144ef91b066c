"""`chordlab project`: what the projector is given to show."""

import json

import numpy as np
import pytest
from PIL import Image

from lab.cli.main import main
from lab.settings.load import load_settings
from projector.dictionary import load_dictionary
from projector.patterns import fiducials

SENSOR_CM = 6.0


def shown(folder, capsys, *flags):
    """The picture as relative light, and where each pixel's middle lies in the sensor's plane, cm."""
    assert main(["project", "square", "--projector", f"image:{folder}", "--json", *flags]) == 0
    assert json.loads(capsys.readouterr().out)["image_size"] == [1920, 1080]
    light = (np.asarray(Image.open(folder / "000001.png").convert("L"), dtype=float) / 255) ** 2.2
    optics = load_settings(None).projector_optics.pinhole()
    y_px, x_px = np.mgrid[0:1080:9, 0:1920:9]
    places = optics.to_plane(np.column_stack([x_px.ravel(), y_px.ravel()]).astype(float), SENSOR_CM)
    return light[::9, ::9].ravel(), places


def test_a_shape_alone_is_white_on_black_at_true_size(tmp_path, capsys):
    light, places = shown(tmp_path, capsys)
    half_cm = np.sqrt(load_dictionary()["square"].area_cm2) / 2
    inside = np.abs(places).max(axis=1)
    assert (light[inside < half_cm - 0.3] > 0.99).all()
    assert (light[inside > half_cm + 0.3] < 0.01).all()


def test_a_dark_ring_lies_along_the_wall_of_a_dim_floor(tmp_path, capsys):
    light, places = shown(tmp_path, capsys, "--ring", "dark")
    ring_cm = load_settings(None).arena.ring_cm
    depth_cm = np.minimum(60 - np.abs(places[:, 0]), 45 - np.abs(places[:, 1]))
    floor = (depth_cm > ring_cm + 0.3) & (np.abs(places).max(axis=1) > 23)
    assert np.median(light[floor]) == pytest.approx(0.4, abs=0.02)
    assert (light[(depth_cm > 0.3) & (depth_cm < ring_cm - 0.3)] < 0.01).all()


def test_fiducials_are_laid_over_it(tmp_path, capsys):
    main(["project", "square", "--projector", f"image:{tmp_path}", "--fiducials"])
    picture = np.asarray(Image.open(tmp_path / "000001.png").convert("L"))
    markers = fiducials([(0.0, 0.0)] * 8, 7.0)  # the numbers are what is looked for, wherever they lie
    assert len(markers.find(picture)) == 8


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ([], "shows nothing to people"),
        (["--projector", "wall:1"], "wall:1"),
        (["--projector", "display:0", "--ring", "loud"], "ring"),
    ],
)
def test_wrong_requests_are_one_line(capsys, flags, says):
    assert main(["project", "square", *flags]) == 2
    said = capsys.readouterr().err.strip()
    assert says in said
    assert "\n" not in said


def test_a_window_is_held_for_as_long_as_asked(capsys, monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert main(["project", "square", "--projector", "display:0", "--seconds", "0.3"]) == 0
    assert "display:0" in capsys.readouterr().out
