"""`chordlab robot`, run as a user runs it: in this process, and `virtual` beside a client in another."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from lab.cli.main import main
from robot.errors import BluetoothUnavailableError

ROOT = Path(__file__).resolve().parents[2]


def answer(capsys, *argv: str) -> dict:
    """The JSON object that a command prints, and nothing beside it."""
    assert main([*argv, "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def complaint(capsys, code: int, *argv: str) -> str:
    """The one line that a command fails with."""
    assert main(list(argv)) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.endswith("\n")
    assert err.count("\n") == 1
    assert err.startswith("error: ")
    return err


@contextlib.contextmanager
def serving(*options: str):
    """`chordlab robot virtual` in another process; yields it and what it says at its start."""
    command = [sys.executable, "-c", "from lab.cli.main import entry; entry()", "robot", "virtual", "--json"]
    child = subprocess.Popen(
        [*command, "--hci", "127.0.0.1:0", *options],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout is not None
        line = child.stdout.readline()
        if not line:
            raise AssertionError(child.communicate(timeout=10)[1])
        yield child, json.loads(line)
    finally:
        if child.poll() is None:
            child.kill()
        child.communicate(timeout=10)


def test_info_of_the_virtual_robot(capsys) -> None:
    identity = answer(capsys, "robot", "info", "virtual")
    assert identity["name"] == "SB-7E57"
    assert identity["address"] == "D0:5F:B8:00:7E:57"
    assert 3.4 < identity["battery_v"] <= 4.1
    assert main(["robot", "info", "virtual"]) == 0
    assert "firmware: 6.0.46" in capsys.readouterr().out


def test_drive_of_the_virtual_robot(capsys) -> None:
    far = answer(capsys, "robot", "drive", "virtual", "--speed", "20", "--seconds", "1")
    # A second at 20 cm/s, up and down at 80 cm/s²: 20 cm, to the speed's unit, its errors and the radio's delay.
    assert far["rolled_cm"] == pytest.approx(20.0, abs=3.0)
    assert far["samples"] >= 25
    assert far["mean_light_lux"] > 0
    assert main(["robot", "drive", "virtual", "--seconds", "0.5"]) == 0
    assert "light samples" in capsys.readouterr().out


def test_without_bluetooth_it_says_so_in_one_line(capsys, monkeypatch) -> None:
    async def no_radio(timeout_s: float, scanner_backend: object = None) -> list[object]:
        raise BluetoothUnavailableError("robots", "its Bluetooth service is not running")

    monkeypatch.setattr("robot.bolt.scan", no_radio)
    assert "no Bluetooth on this machine" in complaint(capsys, 1, "robot", "scan", "--seconds", "0.5")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the platform's own radio answers")
def test_a_scan_of_the_platforms_own_radio_ends_in_a_list_or_in_one_line(capsys, monkeypatch) -> None:
    # No system bus, so no Bluetooth service, whatever this machine has.
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", "unix:path=/nonexistent/bus")
    assert "no Bluetooth on this machine" in complaint(capsys, 1, "robot", "scan", "--seconds", "0.5")
    assert "no Bluetooth on this machine" in complaint(capsys, 1, "robot", "info", "SB-1234")


def test_virtual_serves_until_its_time_is_up(capsys) -> None:
    served = answer(capsys, "robot", "virtual", "--hci", "127.0.0.1:0", "--name", "SB-beef", "--seconds", "0.2")
    assert served["name"] == "SB-beef"
    assert served["address"] == "D0:5F:B8:00:BE:EF"
    assert served["hci"] == f"127.0.0.1:{served['port']}"
    assert served["shape"] is None
    assert main(["robot", "virtual", "--hci", "127.0.0.1:0", "--seconds", "0.1"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("SB-1234 (D0:5F:B8:00:12:34) advertises at 127.0.0.1:")
    assert out.count("\n") == 1


def test_virtual_is_found_asked_and_driven_from_another_process(capsys) -> None:
    with serving("--name", "SB-1A2B", "--shape", "square") as (child, served):
        there = ("--hci", served["hci"])
        robots = answer(capsys, "robot", "scan", "--seconds", "0.6", *there)["robots"]
        assert [robot["name"] for robot in robots] == ["SB-1A2B"]
        assert answer(capsys, "robot", "info", "SB-1A2B", *there)["address"] == served["address"]
        lights: list[float] = []
        # Round the arena, in and out of the lit square.
        for heading in ("0", "120", "240"):
            far = answer(
                capsys, "robot", "drive", "SB-1A2B", "--speed", "60", "--seconds", "1.2", "--heading", heading, *there
            )
            assert far["samples"] >= 20
            assert far["rolled_cm"] > 1.0
            lights.append(far["mean_light_lux"])
        # Its dark is some 20 lux, its light some 120.
        assert max(lights) > 30.0
        child.send_signal(signal.SIGINT)
        out, err = child.communicate(timeout=20)
        assert (child.returncode, out, err) == (0, "", "")
        assert "no HCI server at" in complaint(capsys, 1, "robot", "scan", *there)


def test_virtual_serves_the_arena_of_a_settings_file_its_ring_of_light_too(capsys, tmp_path) -> None:
    file = tmp_path / "s.toml"
    file.write_text('robot = "ble:SB-0001"\nprojector = "display:1"\nseed = 4\n[arena]\nedge = "dark_ring"\n')
    with serving("--name", "SB-1A2B", "--shape", "circle", "--settings", str(file)) as (_, served):
        drive = ("robot", "drive", "SB-1A2B", "--speed", "5", "--seconds", "0.5", "--hci", served["hci"])
        found = answer(capsys, *drive)
    # Where light marks the edge the floor itself has 0.4 of the projector's light; dark it has some 20 lux, lit 120.
    assert found["mean_light_lux"] == pytest.approx(60, abs=3)


def test_bad_requests_are_one_line(capsys, tmp_path) -> None:
    alone = tmp_path / "alone.toml"
    alone.write_text('robot = "onboard:virtual"\n')
    assert "is no BOLT" in complaint(capsys, 2, "robot", "virtual", "--settings", str(alone))
    assert "No such file" in complaint(capsys, 2, "robot", "virtual", "--settings", str(tmp_path / "none.toml"))
    for wrong in ("here", "127.0.0.1:99999", "127.0.0.1:x"):
        assert "is no HOST:PORT" in complaint(capsys, 2, "robot", "virtual", "--hci", wrong)
        assert "is no HOST:PORT" in complaint(capsys, 2, "robot", "scan", "--hci", wrong)
    assert "other machines" in complaint(capsys, 2, "robot", "virtual", "--hci", "0.0.0.0:0")
    assert "four hexadecimal digits" in complaint(capsys, 2, "robot", "virtual", "--name", "Bob")
    assert "nosuch" in complaint(capsys, 2, "robot", "virtual", "--shape", "nosuch")
    assert "with --hci, name" in complaint(capsys, 2, "robot", "info", "virtual", "--hci", "127.0.0.1:1")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        assert "choose another HOST:PORT" in complaint(capsys, 2, "robot", "virtual", "--hci", where)
