"""The window on a real X server: what a camera in front of the screen would see, pixel by pixel.

Xvfb keeps each screen's framebuffer in a file in the X Window Dump format, which is read here by hand: pygame
paints, and has no part in the looking.
"""

import contextlib
import importlib.util
import json
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

WAIT_S = 30
SIZE = (800, 600)

# The projector's process: obeys one JSON command a line and answers each with one line.
HAND = """
import json, sys
import numpy as np
from lab.base.errors import ChordlabError
from projector.opening import open_projector
projector = None
for line in sys.stdin:
    command = json.loads(line)
    try:
        if "open" in command:
            projector = open_projector(command["open"])
        elif "show" in command:
            projector.show(np.load(command["show"]))
        elif "close" in command:
            projector.close()
        said = {"shown_s": projector.shown_s, "size": projector.image_size, "open": projector.pump()}
    except ChordlabError as error:
        said = {"error": str(error), "code": error.exit_code}
    print(json.dumps(said), flush=True)
"""


def lacking(what):
    """Fail on CI, where it must be installed; elsewhere skip."""
    if os.environ.get("CI") == "true":
        pytest.fail(what, pytrace=False)
    pytest.skip(what)


@contextlib.contextmanager
def process(*command, **options):
    child = subprocess.Popen(command, **options)
    try:
        yield child
    finally:
        if child.stdin is not None:
            child.stdin.close()  # the hand ends with its commands
        else:
            child.terminate()
        try:
            child.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait(WAIT_S)
        if child.stdout is not None:
            child.stdout.close()


def line_of(file):
    ready, _, _ = select.select([file], [], [], WAIT_S)
    assert ready, "no answer in time"
    return file.readline()


@pytest.fixture
def screens():
    """The X screens' sizes; a test may ask for others."""
    return [SIZE]


@pytest.fixture
def framebuffers(screens, tmp_path, monkeypatch):
    """An X server with ``screens`` of its own; yields the files of their framebuffers."""
    if shutil.which("Xvfb") is None:
        lacking("Xvfb is missing: apt-get install xvfb")
    if importlib.util.find_spec("pygame") is None:
        lacking("pygame-ce is missing: pip install chordlab[projector]")
    folder = tmp_path / "framebuffers"
    folder.mkdir()
    asked = [word for n, (w, h) in enumerate(screens) for word in ("-screen", str(n), f"{w}x{h}x24")]
    number, told = os.pipe()
    with os.fdopen(number) as number_file:
        # -displayfd: the server picks a free display number and tells it;
        # -retro: a pointer and a background that can be seen, as on a desktop
        command = ["Xvfb", "-displayfd", str(told), *asked, "-nolisten", "tcp", "-retro", "-fbdir", str(folder)]
        with process(*command, pass_fds=[told], stderr=subprocess.DEVNULL):
            os.close(told)
            display = line_of(number_file).strip()
            assert display.isdecimal(), "Xvfb did not start"
            monkeypatch.setenv("DISPLAY", f":{display}")
            monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
            yield [folder / f"Xvfb_screen{n}" for n in range(len(screens))]


class Hand:
    def __init__(self, child):
        self.child = child

    def __call__(self, **command):
        self.child.stdin.write(json.dumps(command) + "\n")
        self.child.stdin.flush()
        return json.loads(line_of(self.child.stdout))


@pytest.fixture
def hand(framebuffers):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with process(sys.executable, "-c", HAND, **pipes) as child:
        yield Hand(child)


def screenshot(path):
    """RGB (height, width, 3) of an X Window Dump, version 7: header big-endian, pixels in the order it names."""
    data = path.read_bytes()
    fields = struct.unpack(">25I", data[:100])
    header_size, version, pixmap_format, depth, width, height, _, least_first = fields[:8]
    bits_per_pixel, bytes_per_line, _, *masks = fields[11:17]
    colours = fields[19]
    assert (version, pixmap_format, depth, bits_per_pixel) == (7, 2, 24, 32)
    start = header_size + 12 * colours
    words = np.frombuffer(data[start : start + height * bytes_per_line], ">u4" if least_first else "<u4")
    words = words.reshape(height, bytes_per_line // 4)[:, :width]
    # each mask is 8 bits wide; its lowest bit says how far to shift
    return np.stack([(words & mask) // (mask & -mask) for mask in masks], axis=-1).astype(np.uint8)


def noise(path, size, seed=1):
    image = np.random.default_rng(seed).integers(0, 256, size[::-1], dtype=np.uint8)
    np.save(path, image)
    return image


def shows(framebuffers, image):
    """Whether the screen is ``image``: every pixel, every channel, the exact size."""
    seen = screenshot(framebuffers[0])
    return seen.shape == (*image.shape, 3) and (seen == image[:, :, None]).all()


@pytest.mark.parametrize("screens", [[SIZE], [(1920, 1080)], [(853, 481)]])
def test_every_pixel_reaches_the_screen_and_nothing_else(framebuffers, hand, screens, tmp_path):
    opened = hand(open="display:0")
    assert opened["size"] == list(screens[0])
    assert shows(framebuffers, np.zeros(screens[0][::-1], np.uint8))
    for seed in (1, 2):
        image = noise(tmp_path / "image.npy", screens[0], seed)
        before_s = time.monotonic()
        shown = hand(show=str(tmp_path / "image.npy"))
        assert before_s <= shown["shown_s"] <= time.monotonic()
        # the pointer waits in the middle of the screen; not a pixel of it is seen
        assert shows(framebuffers, image)


def test_another_size_is_refused_and_the_picture_stays(framebuffers, hand, tmp_path):
    hand(open="display:0")
    image = noise(tmp_path / "fits.npy", SIZE)
    noise(tmp_path / "other.npy", (640, 480))
    shown = hand(show=str(tmp_path / "fits.npy"))
    refused = hand(show=str(tmp_path / "other.npy"))
    assert refused["code"] == 2
    assert "800 x 600" in refused["error"]
    assert "\n" not in refused["error"]
    assert shows(framebuffers, image)
    assert hand()["shown_s"] == shown["shown_s"]


@pytest.mark.parametrize("screens", [[SIZE, (1024, 640)]])
def test_the_displays_there_are(framebuffers, hand):
    refused = hand(open="display:2")
    assert refused["code"] == 2
    assert "there is display:0 (800 x 600), display:1 (1024 x 640);" in refused["error"]


@pytest.mark.parametrize("screens", [[SIZE, (1024, 640)]])
def test_a_window_that_opens_on_another_display_is_found_out(framebuffers, hand):
    # X screens, like mirrored displays, all lie at the origin, where the desktop takes the first
    refused = hand(open="display:1")
    assert refused["code"] == 1
    assert "display:1 opened on display:0" in refused["error"]
    assert hand(open="display:0")["size"] == list(SIZE)


def test_closing_gives_the_screen_back_and_it_opens_again(framebuffers, hand, tmp_path):
    desktop = screenshot(framebuffers[0])
    assert desktop.any()
    hand(open="display:0")
    image = noise(tmp_path / "image.npy", SIZE)
    hand(show=str(tmp_path / "image.npy"))
    assert hand(close=True)["open"] is False
    assert "was closed" in hand(show=str(tmp_path / "image.npy"))["error"]
    after = screenshot(framebuffers[0])
    assert np.array_equal(after[:200], desktop[:200])  # above the pointer, which comes back too
    hand(open="display:0")
    hand(show=str(tmp_path / "image.npy"))
    assert shows(framebuffers, image)
    assert hand(open="display:0")["error"].startswith("display:0 cannot be opened beside another window")


def test_the_window_leaves_signals_to_the_session(framebuffers, hand):
    hand(open="display:0")
    hand.child.send_signal(signal.SIGTERM)
    assert hand.child.wait(WAIT_S) == -signal.SIGTERM
