"""Tracking a 1280x720 film against decoding the same file, which is the limit, and against two other trackers.

The films are as cameras send them: H.264 of about 12 Mbit/s with arithmetic coding and smoothed blocks, and Motion
JPEG of about 34 Mbit/s. Each row's ``extra_info`` holds, from rounds in turn with what it is compared with and the best
round of each:

- ``decode_ratio``: time of pure decoding (PyAV, luma touched, two frame threads) over the tracker's, per frame;
  ``decode_ratio_cpu``: likewise of both processors' time, in which nothing can hide behind the decoder;
- ``slower_than_track``: a peer's time per frame over chordlab's, for the whole of ``track_video``;
- ``rms_px``: error against the film's truth per axis, LED lit or dim alike; ``seen``: share of frames with a position.

``test_track`` learns the empty floor from this one film; ``test_track_on_a_known_floor`` was handed it, as a session's
segments are: tens of thousands of frames share one.
"""

import time
import warnings
from dataclasses import dataclass

import av
import cv2
import numpy as np
import pytest
import shapely

from tracking.background import background_of
from tracking.film import FilmEncoding, blink_in, light_of, make_film, rolling, wander
from tracking.synthetic import CameraSettings
from tracking.track import track_video
from tracking.video import read_frames

SECONDS = 50.0
TURNS = 4
SHAPE = shapely.box(-28, -18, 28, 18)
ENCODINGS = {
    "h264": FilmEncoding("h264", quality=23, preset="superfast"),
    "mjpeg": FilmEncoding("mjpeg", quality=10),
}


@pytest.fixture(scope="module", params=list(ENCODINGS))
def film(request, tmp_path_factory):
    """1500 frames at 30 Hz of a robot that rolls over a lit shape, under a webcam's noise."""
    rng = np.random.default_rng(1)
    robots = rolling(wander(rng, (110.0, 66.0), length_cm=25.0 * SECONDS), 25.0, blink_in(SHAPE))
    return make_film(
        tmp_path_factory.mktemp("film") / f"{request.param}.mkv",
        robots,
        rng,
        light_at=light_of(SHAPE),
        duration_s=SECONDS,
        camera=CameraSettings(noise_sigma=3.0),
        encoding=ENCODINGS[request.param],
    )


@dataclass
class Stopwatch:
    """The best of several runs, in s per frame: on the wall, and of all processors."""

    wall_s: float = np.inf
    cpu_s: float = np.inf

    def time(self, subject):
        start_s, spent_s = time.perf_counter(), time.process_time()
        result = subject()
        frames = len(result)
        self.cpu_s = min(self.cpu_s, (time.process_time() - spent_s) / frames)
        self.wall_s = min(self.wall_s, (time.perf_counter() - start_s) / frames)
        return result


def decode(film):
    """Nothing but the luma planes; FFmpeg decodes Motion JPEG on one thread whatever it is told."""
    with av.open(str(film.path)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 2
        stream.thread_type = "FRAME"
        return [np.frombuffer(frame.planes[0], np.uint8)[0] for frame in container.decode(stream)]


def track(film, background=None):
    table = track_video(film.path, calibration=film.calibration, background=background)
    return table[["x_px", "y_px"]].to_numpy()


def race(benchmark, film, subject, against_track=False, turns=TURNS):
    """Run the subject in turn with the decoder, and with chordlab's tracker where it is another one."""
    own, limit, ours = Stopwatch(), Stopwatch(), Stopwatch()
    subject()  # compiled, and the file in the system's cache

    def others():
        limit.time(lambda: decode(film))
        if against_track:
            ours.time(lambda: track(film))

    places = benchmark.pedantic(lambda: own.time(subject), setup=others, rounds=turns)
    error = places - film.of()[["x_px", "y_px"]].to_numpy()[: len(places)]
    seen = np.isfinite(error).all(axis=1)
    benchmark.extra_info["decode_ratio"] = limit.wall_s / own.wall_s
    benchmark.extra_info["decode_ratio_cpu"] = limit.cpu_s / own.cpu_s
    benchmark.extra_info["frames_per_s"] = 1.0 / own.wall_s
    if against_track:
        benchmark.extra_info["slower_than_track"] = own.wall_s / ours.wall_s
    benchmark.extra_info["rms_px"] = float(np.sqrt(np.mean(error[seen] ** 2)))
    benchmark.extra_info["seen"] = float(seen.mean())
    benchmark.extra_info["mbit_per_s"] = film.path.stat().st_size * 8e-6 / SECONDS


def test_track(benchmark, film):
    race(benchmark, film, lambda: track(film))


def test_track_on_a_known_floor(benchmark, film):
    floor = background_of([film.path])
    race(benchmark, film, lambda: track(film, floor))


def test_full_frame_hsv(benchmark, film):
    """What most scripts do: colour, threshold, the largest component's centroid."""

    def subject():
        places = []
        with read_frames(film.path) as reader:
            for frame in reader:
                if frame.index >= 300:
                    break
                hsv = cv2.cvtColor(frame.decoded.to_ndarray(format="bgr24"), cv2.COLOR_BGR2HSV)
                mask = cv2.inRange(hsv, (0, 110, 45), (12, 255, 255)) | cv2.inRange(
                    hsv, (168, 110, 45), (180, 255, 255)
                )
                count, _, sizes, centres = cv2.connectedComponentsWithStats(mask)
                best = 1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA])) if count > 1 else 0
                places.append(centres[best] if best else (np.nan, np.nan))
        return np.array(places)

    race(benchmark, film, subject, against_track=True, turns=3)


def test_trackpy(benchmark, film):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trackpy = pytest.importorskip("trackpy")

    def subject():
        places = []
        with read_frames(film.path) as reader, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for frame in reader:
                if frame.index >= 60:
                    break
                spots = trackpy.locate(frame.luma, diameter=17, topn=1, engine="numba")
                places.append(spots[["x", "y"]].to_numpy()[0] if len(spots) else (np.nan, np.nan))
        return np.array(places)

    race(benchmark, film, subject, against_track=True, turns=3)
