"""Decoding ahead: every frame in order, errors handed over, no thread left behind."""

import threading
from contextlib import closing

import numpy as np
import pytest

from tracking.ahead import read_ahead
from tracking.film import make_film
from tracking.video import read_frames


def decoders():
    return [thread for thread in threading.enumerate() if thread.name == "chordlab-decoder"]


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    path = tmp_path_factory.mktemp("ahead") / "film.mkv"
    make_film(path, lambda _: [], np.random.default_rng(1), duration_s=1.0)
    return path


@pytest.mark.parametrize("depth", [1, 2, 7])
def test_frames_come_whole_and_in_order(film, depth):
    with read_frames(film) as reader:
        alone = [(frame.index, frame.t_s, int(frame.luma.sum())) for frame in reader]
    with read_frames(film) as reader, closing(read_ahead(reader, depth=depth)) as frames:
        ahead = [(frame.index, frame.t_s, int(frame.luma.sum())) for frame in frames]
    assert ahead == alone
    assert len(alone) == 30
    assert not decoders()


def test_no_more_frames_are_decoded_ahead_than_may_wait():
    taken = []

    def reader():
        for number in range(100):
            taken.append(number)
            yield number

    frames = read_ahead(reader(), depth=3)
    assert next(frames) == 0
    frames.close()
    assert len(taken) <= 1 + 3 + 2  # handed out, waiting, and one in the hand on either side
    assert not decoders()


def test_an_error_comes_where_the_frame_would_have():
    def reader():
        yield "one"
        raise OSError("the disc is gone")

    frames = read_ahead(reader())
    assert next(frames) == "one"
    with pytest.raises(OSError, match="disc is gone"):
        next(frames)
    assert not decoders()


def test_whoever_stops_early_leaves_no_thread(film):
    with read_frames(film) as reader, closing(read_ahead(reader)) as frames:
        assert next(frames).index == 0
        assert len(decoders()) == 1
    assert not decoders()
