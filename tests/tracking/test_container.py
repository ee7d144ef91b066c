"""Whether a file is all there, from its outermost boxes: files of a real muxer, whole, cut, and never closed."""

import struct

import numpy as np
import pytest

from tracking.container import wholeness_of
from tracking.film import FilmEncoding, make_film


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    for ending in ("mkv", "mp4", "avi"):
        make_film(folder / f"film.{ending}", lambda _: [], np.random.default_rng(1), duration_s=0.5)
    parts = FilmEncoding(movflags="frag_keyframe+empty_moov", key_frames=5)
    make_film(folder / "parts.mp4", lambda _: [], np.random.default_rng(1), duration_s=0.5, encoding=parts)
    return folder


@pytest.mark.parametrize("name", ["film.mkv", "film.mp4", "film.avi", "parts.mp4"])
def test_a_whole_file_is_whole_and_a_byte_less_is_not(films, tmp_path, name):
    whole = wholeness_of(films / name)
    assert (whole.known, whole.is_whole, whole.missing_bytes) == (True, True, 0)
    assert whole.fragmented == (name == "parts.mp4")
    assert whole.counts_periods == (name == "film.avi")
    data = (films / name).read_bytes()
    cut = tmp_path / name
    for lost in (2, 100, len(data) // 2):
        cut.write_bytes(data[:-lost])
        judged = wholeness_of(cut)
        assert not judged.is_whole
        assert judged.missing_bytes > 0
        assert judged.missing_bytes <= lost


def test_a_matroska_of_unknown_length_was_never_closed(films, tmp_path):
    data = bytearray((films / "film.mkv").read_bytes())
    at = data.index(bytes.fromhex("18538067")) + 4
    data[at : at + 8] = b"\x01" + b"\xff" * 7
    (tmp_path / "open.mkv").write_bytes(data)
    judged = wholeness_of(tmp_path / "open.mkv")
    assert (judged.known, judged.closed, judged.is_whole) == (True, False, False)


def test_an_avi_whose_length_is_still_held_free_was_never_closed(films, tmp_path):
    data = bytearray((films / "film.avi").read_bytes())
    data[4:8] = struct.pack("<I", 0)
    (tmp_path / "open.avi").write_bytes(data)
    assert not wholeness_of(tmp_path / "open.avi").closed


def test_boxes_of_64_bits_and_boxes_to_the_end(tmp_path):
    first = struct.pack(">I4s", 16, b"ftyp") + b"isom" * 2
    wide = struct.pack(">I4sQ", 1, b"mdat", 16 + 50) + b"x" * 50
    file = tmp_path / "box.mp4"
    file.write_bytes(first + wide)
    assert wholeness_of(file).is_whole
    file.write_bytes((first + wide)[:-20])
    assert wholeness_of(file).missing_bytes == 20
    file.write_bytes(first + struct.pack(">I4s", 0, b"mdat") + b"x" * 33)
    assert wholeness_of(file).is_whole


@pytest.mark.parametrize("data", [b"", b"words", b"\x00" * 64, b"\xff\xd8\xff\xe0" * 9])
def test_of_other_files_nothing_is_known(tmp_path, data):
    (tmp_path / "other").write_bytes(data)
    assert not wholeness_of(tmp_path / "other").known
