import builtins
import subprocess
import sys

import cv2
import numpy as np
import pytest

from projector.device import ProjectorDevice, ProjectorError, ProjectorRequestError, open_projector
from projector.images import ImageFolder


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
    assert sorted(path.name for path in folder.iterdir()) == ["000001.png", "000002.png", "000003.png"]
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


@pytest.mark.parametrize("way", ["escape", "quit"])
def test_window_that_the_operator_closes(screen, way):
    window = open_projector("display:0")
    assert window.pump()
    screen.event.post(screen.event.Event(screen.KEYDOWN, key=screen.K_a))
    assert window.pump()
    kind = {"escape": screen.event.Event(screen.KEYDOWN, key=screen.K_ESCAPE), "quit": screen.event.Event(screen.QUIT)}
    screen.event.post(kind[way])
    width, height = window.image_size
    with pytest.raises(ProjectorError, match="was closed"):
        window.show(np.zeros((height, width), np.uint8))
    assert not window.is_open
    assert not window.pump()


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
        "import projector.device, projector.dictionary, projector.virtual, projector.draw\n"
        "assert 'pygame' not in sys.modules\n"
        "projector.device.open_projector('display:0').close()\n"
        "assert 'pygame' in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == ""
