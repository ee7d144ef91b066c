import re

import numpy as np
import pytest
from shapely.geometry import box

from lab.base.errors import ChordlabError, RequestError
from projector import catalogue
from projector.collections import COLLECTIONS, LETTERS, charter_words, load_dictionary
from projector.dictionary import check_fits, shape_from
from projector.draw import draw_gallery
from projector.geojson import write_shape
from projector.outlines import installed_font
from projector.text import find_font

REACHABLE = box(-56.35, -41.35, 56.35, 41.35)  # the default arena less a ball's radius


@pytest.fixture(scope="module")
def font():
    return find_font(installed_font("DejaVu Sans"))


@pytest.fixture(scope="module")
def everything(font):
    return load_dictionary("all", font=font)


def test_paper_is_the_default():
    assert list(load_dictionary()) == list(load_dictionary("paper"))
    assert len(load_dictionary()) == 6


def test_all_is_the_sum_of_its_parts_and_holds_hundreds(everything, font):
    parts = [load_dictionary(name, font=font) for name in COLLECTIONS if name != "all"]
    assert list(everything) == [name for part in parts for name in part]
    assert len(everything) == sum(len(part) for part in parts) >= 6 + 32 + 36 + 130
    assert all(name == shape.name for name, shape in everything.items())
    assert all(shape.title and shape.source for shape in everything.values())


def test_no_two_entries_are_drawn_alike(everything):
    assert len({shape.digest for shape in everything.values()}) == len(everything)


def test_every_entry_fits_the_default_arena(everything):
    for shape in everything.values():
        check_fits(shape, REACHABLE)
        x_low, y_low, x_high, y_high = shape.geometry.bounds
        assert (x_low + x_high, y_low + y_high) == pytest.approx((0, 0), abs=1e-6)


def test_an_entry_is_what_its_name_asks_for(everything, font):
    for name in ("eiffel", *list(load_dictionary("monuments"))[:3], "text:Q", "text:FREEDOM"):
        again = shape_from(name, font=font if name.startswith("text:") else None)
        assert again.digest == everything[name].digest


def test_letters_are_capitals_and_digits_of_one_scale(font):
    letters = load_dictionary("letters", font=font)
    assert [name.removeprefix("text:") for name in letters] == list(LETTERS)
    assert len(letters) == 36
    flat = [letters[f"text:{letter}"].size_cm[1] for letter in "EFHIKLMNTXZ147"]
    assert flat == pytest.approx([40.0] * len(flat), abs=0.1)
    assert all(shape.font == font for shape in letters.values())


def test_words_of_the_charter_are_normalised_capitals_each_once(font):
    words = charter_words()
    assert len(set(words)) == len(words) == 130
    assert all(re.fullmatch("[A-Z]{2,}", word) for word in words)
    assert words[:3] == ["WE", "THE", "PEOPLES"]
    assert {"UNITED", "NATIONS", "FREEDOM", "PEACE", "ARMED", "CHARTER"} <= set(words)
    shapes = load_dictionary("words", font=font)
    assert list(shapes) == [f"text:{word}" for word in words]
    assert all(shape.size_cm[0] <= 100 + 1e-6 for shape in shapes.values())


def test_drawn_collections_go_from_compact_to_intricate():
    for name in ("paper", "monuments"):
        ratios = [shape.perimeter_cm**2 / shape.area_cm2 for shape in load_dictionary(name).values()]
        assert ratios == sorted(ratios)


def test_a_collection_that_is_none():
    with pytest.raises(RequestError, match="no collection of shapes; known are paper, monuments, letters, words, all"):
        load_dictionary("animals")


def test_an_installation_that_lacks_files(tmp_path, monkeypatch):
    package = tmp_path / "projector"
    (package / "shapes" / "monuments").mkdir(parents=True)
    monkeypatch.setattr(catalogue, "__file__", str(package / "catalogue.py"))
    for missing in ("paper", "monuments", "words"):
        with pytest.raises(ChordlabError, match="install chordlab again"):
            load_dictionary(missing)


def test_two_shapes_of_one_name_are_told(tmp_path, monkeypatch):
    shapes = tmp_path / "projector" / "shapes"
    (shapes / "monuments").mkdir(parents=True)
    square = shape_from("square")
    monkeypatch.setattr(catalogue, "__file__", str(tmp_path / "projector" / "catalogue.py"))
    write_shape(square, shapes / "square.geojson")
    write_shape(square, shapes / "monuments" / "block.geojson")
    (shapes / "words").mkdir()
    (shapes / "words" / "un_charter_preamble.txt").write_text("# none\n")
    with pytest.raises(ChordlabError, match="two shapes of the dictionary are called square"):
        load_dictionary("all")


def test_a_gallery_draws_all_to_one_scale(tmp_path, font):
    cv2 = pytest.importorskip("cv2")
    chosen = [*load_dictionary().values(), shape_from("text:HI", font=font)]
    figure = draw_gallery(chosen, tmp_path / "gallery.png")
    spans = {round(float(np.diff(axes.get_xlim())[0]), 6) for axes in figure.axes}
    assert len(figure.axes) == len(chosen)
    assert len(spans) == 1
    image = cv2.imread(str(tmp_path / "gallery.png"), cv2.IMREAD_GRAYSCALE).astype(float)
    frame = figure.axes[0].get_window_extent()
    pixels_per_cm = frame.width / spans.pop()
    assert pixels_per_cm == pytest.approx(frame.height / np.diff(figure.axes[0].get_ylim())[0], rel=1e-6)
    window = image[int(image.shape[0] - frame.y1) : int(image.shape[0] - frame.y0), : int(frame.x1)]
    ink = (1 - np.clip((window - window.min()) / (255 - window.min()), 0, 1)).sum() / pixels_per_cm**2
    assert ink == pytest.approx(chosen[0].area_cm2, rel=0.03)
    words = " ".join(text.get_text() for text in figure.texts)
    assert "Eiffel Tower" in words
    assert "text:HI" in words
    with pytest.raises(RequestError, match="at least one"):
        draw_gallery([])
