import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image, ImageDraw

from tests.lab.conftest import roll
from tracking.calibration import save_calibration
from tracking.film import blink_in, light_of, make_film, rolling, wander


@pytest.fixture(scope="module")
def workshop(tmp_path_factory) -> Path:
    """A folder with what the pages speak of: a session, a drawing, a photograph, a film and its calibration."""
    home = tmp_path_factory.mktemp("workshop")
    folder = roll(home / "sessions", stop__lines=12, seed=1).folder
    folder.rename(home / "sessions/2026-11-23T1042_eiffel_ab12")
    shutil.copytree(home / "sessions", home / "elsewhere")
    drawing = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 30 70"><path d="M0 70 L15 0 L30 70 Z"/></svg>'
    (home / "tower.svg").write_text(drawing)
    photo = Image.new("L", (300, 200), 255)
    ImageDraw.Draw(photo).ellipse((60, 40, 240, 160), fill=0)
    photo.save(home / "photo.png")
    rng, square = np.random.default_rng(1), shapely.box(-15, -15, 15, 15)
    robots = rolling(wander(rng, (90.0, 50.0), length_cm=60.0), 20.0, blink_in(square))
    film = make_film(home / "video.mkv", robots, rng, light_at=light_of(square))
    save_calibration(film.calibration, home / "calibration.json")
    for name in ("one", "two", "three"):
        shutil.copy(film.path, home / f"{name}.mkv")
    return home
