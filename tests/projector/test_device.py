import asyncio
import builtins
import errno
import subprocess
import sys
import time

import cv2
import numpy as np
import pandas as pd
import pytest

from lab.base.pinhole import Pinhole
from lab.clock import run
from projector import images as projector_images
from projector import window as projector_window
from projector.device import ProjectorDevice, ProjectorError, ProjectorRequestError, now_s
from projector.images import ImageFolder
from projector.opening import open_projector
from projector.virtual import VirtualProjector


@pytest.fixture
def screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    yield pygame
    pygame.display.quit()


def test_images_are_numbered_and_survive_a_restart(tmp_path):
    folder = tmp_path / "out" / "images"
    projector = open_projector(f"image:{folder}", image_size=(64, 48))
    assert isinstance(projector, ProjectorDevice)
    assert projector.image_size == (64, 48)
    ramp = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64).astype(np.uint8)
    projector.show(ramp)
    projector.show(255 - ramp)
    projector.close()
    open_projector(f"image:{folder}", image_size=(64, 48)).show(ramp // 2)
    names = ["000001.png", "000002.png", "000003.png"]
    assert sorted(path.name for path in folder.iterdir()) == [*names, "index.csv"]
    assert pd.read_csv(folder / "index.csv")["image"].to_list() == names
    assert (cv2.imread(str(folder / "000001.png"), cv2.IMREAD_UNCHANGED) == ramp).all()
    assert (cv2.imread(str(folder / "000003.png"), cv2.IMREAD_UNCHANGED) == ramp // 2).all()


def test_a_folder_that_cannot_be_made_or_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ProjectorRequestError, match="cannot make the folder"):
        ImageFolder(tmp_path / "file" / "images")
    projector = ImageFolder(tmp_path / "images", image_size=(4, 4))
    (tmp_path / "images").rmdir()
    with pytest.raises(ProjectorError, match="cannot write") as caught:
        projector.show(np.zeros((4, 4), np.uint8))
    assert caught.value.exit_code == 1


def test_the_index_keeps_when_each_image_was_shown(tmp_path):
    projector = ImageFolder(tmp_path, image_size=(4, 4))
    assert projector.shown_s is None
    shown_s = []

    async def session():
        for wait_s in (1.5, 60.25):
            await asyncio.sleep(wait_s)
            projector.show(np.zeros((4, 4), np.uint8))
            shown_s.append(projector.shown_s)

    run(session(), virtual=True)
    assert shown_s == pytest.approx([1.5, 61.75])
    assert pd.read_csv(tmp_path / "index.csv")["shown_s"].to_list() == pytest.approx(shown_s)


def test_an_image_whose_row_cannot_be_written_does_not_count(tmp_path, monkeypatch):
    projector = ImageFolder(tmp_path, image_size=(4, 4))
    projector.show(np.zeros((4, 4), np.uint8))
    before = (tmp_path / "index.csv").read_bytes(), projector.shown_s
    write = projector_images.write_aside

    def full(path, data):
        if path.suffix == ".csv":
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, data)

    monkeypatch.setattr(projector_images, "write_aside", full)
    with pytest.raises(ProjectorError, match=r"index.csv \(No space"):
        projector.show(np.full((4, 4), 1, np.uint8))
    assert ((tmp_path / "index.csv").read_bytes(), projector.shown_s) == before
    monkeypatch.undo()
    projector.show(np.full((4, 4), 2, np.uint8))
    assert cv2.imread(str(tmp_path / "000002.png"), cv2.IMREAD_UNCHANGED).max() == 2
    assert pd.read_csv(tmp_path / "index.csv")["image"].to_list() == ["000001.png", "000002.png"]


@pytest.mark.parametrize("content", [b"", b"a,b\n1,2\n", b"image,shown_s\n000001.png\n", b"\xff\xfe"])
def test_a_foreign_index_is_left_alone(tmp_path, content):
    (tmp_path / "index.csv").write_bytes(content)
    with pytest.raises(ProjectorRequestError, match="name another folder"):
        ImageFolder(tmp_path)
    assert (tmp_path / "index.csv").read_bytes() == content


def test_the_virtual_projector_tells_when_its_light_changed():
    optics = Pinhole((8, 6), np.diag([10.0, 10.0, 1.0]), np.zeros(5), np.zeros(3), np.array([0.0, 0.0, 100.0]))
    projector = VirtualProjector(optics)
    assert projector.shown_s is None

    async def session():
        await asyncio.sleep(7)
        projector.show(np.zeros((6, 8), np.uint8))
        await asyncio.sleep(7)

    run(session(), virtual=True)
    assert projector.shown_s == pytest.approx(7)


@pytest.mark.parametrize(
    ("device", "words"),
    [
        ("display", "needs the display's number"),
        ("display:one", "needs the display's number"),
        ("display:-1", "needs the display's number"),
        ("image:", "needs a folder"),
        ("virtual", "use display:N or image:DIR"),
        ("", "use display:N"),
    ],
)
def test_device_strings_that_are_none(device, words):
    with pytest.raises(ProjectorRequestError, match=words) as caught:
        open_projector(device)
    assert caught.value.device == device
    assert caught.value.exit_code == 2


def test_window_shows_pixel_for_pixel(screen):
    window = open_projector("display:0")
    assert isinstance(window, ProjectorDevice)
    width, height = window.image_size
    assert screen.display.get_window_size() == (width, height)
    assert not screen.mouse.get_visible()
    assert not screen.display.get_allow_screensaver()
    shown = screen.surfarray.array3d(screen.display.get_surface())
    assert shown.max() == 0  # black before the first image
    image = (np.arange(width)[None, :] + 3 * np.arange(height)[:, None]).astype(np.uint8)
    window.show(image)
    shown = screen.surfarray.array3d(screen.display.get_surface())
    assert (shown.transpose(1, 0, 2) == image[:, :, None]).all()
    with pytest.raises(ProjectorRequestError, match=f"{width} x {height}"):
        window.show(image[:-1])
    window.close()
    window.close()
    assert not screen.display.get_init()


def test_a_window_tells_when_its_light_changed(screen, monkeypatch):
    order = []
    flip = screen.display.flip
    monkeypatch.setattr(screen.display, "flip", lambda: order.append(flip()))
    monkeypatch.setattr(projector_window, "now_s", lambda: float(len(order)))
    window = open_projector("display:0")
    width, height = window.image_size
    assert window.shown_s == 1  # stamped after the flip that made it black
    window.show(np.zeros((height, width), np.uint8))
    assert window.shown_s == 2
    with pytest.raises(ProjectorRequestError):
        window.show(np.zeros((height, width + 1), np.uint8))
    assert window.shown_s == 2


def test_now_is_the_loops_clock_and_else_the_monotonic_one():
    async def both():
        return now_s(), asyncio.get_running_loop().time(), time.monotonic()

    virtual, loop, machine = run(both(), virtual=True)
    assert virtual == loop != machine
    earlier, loop, later = run(both(), virtual=False)
    assert earlier <= loop <= later <= now_s() <= time.monotonic()


@pytest.mark.parametrize("way", ["KEYDOWN", "QUIT", "WINDOWMINIMIZED", "WINDOWDISPLAYCHANGED"])
def test_window_that_the_operator_takes_away(screen, way):
    window = open_projector("display:0")
    assert window.pump()
    screen.event.post(screen.event.Event(screen.KEYDOWN, key=screen.K_a))
    screen.event.post(screen.event.Event(screen.WINDOWDISPLAYCHANGED, display_index=0))
    assert window.pump()
    assert window.problem is None
    screen.event.post(screen.event.Event(getattr(screen, way), key=screen.K_ESCAPE, display_index=1))
    width, height = window.image_size
    with pytest.raises(ProjectorError, match=r"was (closed|minimised|moved)") as caught:
        window.show(np.zeros((height, width), np.uint8))
    assert str(caught.value) == window.problem
    assert not window.is_open
    assert not window.pump()
    assert not screen.display.get_init()


@pytest.mark.parametrize(
    ("name", "answer", "words"),
    [
        ("get_desktop_sizes", [], "lost its display or its mode; there is none"),
        ("get_desktop_sizes", [(640, 480)], r"lost its display or its mode; there is display:0 \(640 x 480\)"),
        ("get_window_size", (99, 98), "was resized to 99 x 98 pixels"),
    ],
)
def test_a_display_that_changes_meanwhile(screen, monkeypatch, name, answer, words):
    window = open_projector("display:0")
    width, height = window.image_size
    monkeypatch.setattr(screen.display, name, lambda: answer)
    with pytest.raises(ProjectorError, match=words) as caught:
        window.show(np.zeros((height, width), np.uint8))
    assert "\n" not in str(caught.value)
    assert not window.is_open


@pytest.mark.parametrize("name", ["event.get", "display.flip", "display.get_desktop_sizes"])
def test_pygame_that_fails_meanwhile(screen, monkeypatch, name):
    window = open_projector("display:0")
    width, height = window.image_size

    def fail():
        raise screen.error("device lost")

    monkeypatch.setattr(f"pygame.{name}", fail)
    shown_s = window.shown_s
    with pytest.raises(ProjectorError, match=r"on display:0 failed \(device lost\)"):
        window.show(np.zeros((height, width), np.uint8))
    assert window.shown_s == shown_s
    assert not window.pump()


def test_the_size_is_the_windows_not_the_one_asked_for(screen, monkeypatch):
    set_mode = screen.display.set_mode
    monkeypatch.setattr(screen.display, "set_mode", lambda *args, **kwargs: set_mode((320, 200)))
    window = open_projector("display:0")
    assert window.image_size == (320, 200)
    window.show(np.zeros((200, 320), np.uint8))
    with pytest.raises(ProjectorError, match="beside another window"):
        open_projector("display:0")


def test_a_display_that_is_not_connected(screen):
    with pytest.raises(ProjectorRequestError, match=r"there is display:0 \(\d+ x \d+\)"):
        open_projector("display:7")


def test_no_desktop_session(screen, monkeypatch):
    screen.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "no-such-driver")
    with pytest.raises(ProjectorError, match="no display can be opened"):
        open_projector("display:0")


def test_a_display_that_refuses_full_screen(screen, monkeypatch):
    def refuse(*args, **kwargs):
        raise screen.error("no mode")

    monkeypatch.setattr(screen.display, "set_mode", refuse)
    with pytest.raises(ProjectorError, match="cannot go full screen"):
        open_projector("display:0")


def test_without_pygame_the_cure_is_told(monkeypatch):
    real_import = builtins.__import__

    def without_pygame(name, *args, **kwargs):
        if name == "pygame":
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_pygame)
    with pytest.raises(ProjectorError, match=r"pip install chordlab\[projector\]"):
        open_projector("display:0")


def test_pygame_is_imported_only_for_a_window_and_greets_nobody():
    code = (
        "import sys, os; os.environ['SDL_VIDEODRIVER'] = 'dummy'\n"
        "import projector.device, projector.opening, projector.dictionary, projector.virtual, projector.draw\n"
        "assert 'pygame' not in sys.modules\n"
        "projector.opening.open_projector('display:0').close()\n"
        "assert 'pygame' in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == ""
