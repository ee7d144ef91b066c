"""A session bears what goes wrong: broken links, silence, held wheels, a stuck sensor, an empty battery."""

import asyncio
import math
import signal

import numpy as np
import pytest

from lab.base.errors import ChordlabError
from lab.cli.main import main
from lab.session.roller import SessionError
from lab.store.reader import SessionReader
from robot.errors import ReconnectError
from tests.lab.traces import area_perimeter, rolled

DISCONNECT_S, VANISH_S, STALL_S = 40.0, 80.0, 130.0
LINES = 15


def fault(kind, at_s, for_s=5.0, **more):
    return {"kind": kind, "at_s": at_s, "for_s": for_s, **more}


@pytest.fixture(scope="session")
def troubled(tmp_path_factory):
    """The link breaks for 5 s, the robot falls silent for 12 s, its wheels are held for 6 s."""
    faults = [fault("disconnect", DISCONNECT_S), fault("vanish", VANISH_S, 12.0), fault("stall", STALL_S, 6.0)]
    return rolled(tmp_path_factory.mktemp("troubled"), stop__lines=LINES, virtual__faults=faults)


@pytest.fixture(scope="session")
def starved(tmp_path_factory):
    """The battery is low from 20 s to 150 s."""
    return rolled(
        tmp_path_factory.mktemp("starved"), stop__lines=8, virtual__faults=[fault("low_battery", 20.0, 130.0)]
    )


@pytest.fixture(scope="session")
def never_charged(tmp_path_factory):
    return rolled(
        tmp_path_factory.mktemp("flat"), link__charge_wait_s=60, virtual__faults=[fault("low_battery", 20.0, 1e5)]
    )


@pytest.fixture(scope="session")
def gone(tmp_path_factory):
    return rolled(
        tmp_path_factory.mktemp("gone"), link__reconnect_s=20, virtual__faults=[fault("vanish", DISCONNECT_S, 1e5)]
    )


@pytest.fixture(scope="session")
def not_called_back(tmp_path_factory):
    return rolled(
        tmp_path_factory.mktemp("let_go"), link__reconnect_s=0, virtual__faults=[fault("disconnect", DISCONNECT_S)]
    )


def line_at(session, t_s):
    """The run during which something happened."""
    (found,) = [run for run in session.runs if run["t_start_s"] < t_s <= run["t_end_s"]]
    return found


# --- links ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("t_s", [DISCONNECT_S, VANISH_S], ids=["disconnect", "vanish"])
def test_the_line_in_progress_is_dropped_and_counted_among_the_runs(troubled, t_s):
    run = line_at(troubled, t_s)
    assert run["ended"] == "link"
    assert not run["counts"]
    assert not run["whole"]
    assert "estimate" not in run
    assert [run["line"] for run in troubled.runs] == list(range(len(troubled.runs)))
    assert troubled.finished.outcome.runs == len(troubled.runs)


def test_the_session_goes_on_to_its_lines(troubled):
    assert troubled.finished.failure is None
    assert troubled.finished.outcome.state == "complete"
    assert troubled.finished.outcome.n == LINES
    assert sum(run["counts"] and run["k"] > 0 for run in troubled.runs) == LINES
    after = [run for run in troubled.runs if run["t_start_s"] > STALL_S + 10 and run["counts"]]
    assert len(after) > 3


def test_the_estimates_are_as_if_the_dropped_lines_had_never_been(troubled):
    counted, estimates = [], []
    for run in troubled.runs:
        if run["counts"]:
            counted.append(run)
        if "estimate" in run:
            estimates.append(run["estimate"])
            area, perimeter = area_perimeter(counted)
            assert run["estimate"]["area_cm2"] == pytest.approx(area)
            assert run["estimate"]["perimeter_cm"] == pytest.approx(perimeter)
    assert [estimate["n"] for estimate in estimates] == list(range(1, LINES + 1))
    # and it is no idle question: a line was lost that had crossed the shape, and with it the result is another
    dropped = [run for run in troubled.runs if run["ended"] in ("link", "stall") and run["crossings"]]
    assert dropped
    assert area_perimeter(counted + dropped)[0] != pytest.approx(estimates[-1]["area_cm2"], rel=1e-3)


def test_the_log_says_that_the_robot_was_lost_why_and_after_how_many_calls_it_was_back(troubled):
    events = [event for event in troubled.events if event["event"] in ("lost", "back")]
    assert [event["event"] for event in events] == ["lost", "back", "lost", "back"]
    assert all(event["robot"] == "SB-7E57" for event in events)
    (broken, back, silent, again) = events
    assert broken["t_s"] == pytest.approx(DISCONNECT_S, abs=0.2)
    assert "disconnected" in broken["reason"]
    assert "did not answer" in silent["reason"] or "silent" in silent["reason"]
    for event, over_s in ((back, DISCONNECT_S + 5), (again, VANISH_S + 12)):
        assert event["attempts"] >= 1
        assert over_s <= event["t_s"] < over_s + 12  # a scan that finds nobody takes 10 s
    for text in ("the link was lost", "back after"):
        assert sum(text in said for said in troubled.said) == 2


def test_a_robot_that_falls_silent_is_noticed_within_three_seconds_of_its_last_sample(troubled):
    run = line_at(troubled, VANISH_S)
    last_s = troubled.light(run["line"])["t_host_s"].iloc[-1]
    assert last_s == pytest.approx(VANISH_S, abs=0.06)
    noticed_s = troubled.told("lost")[1]["t_s"] - last_s
    assert 0.5 < noticed_s <= 3.0


def test_the_way_after_a_return_starts_anywhere_and_does_not_count(troubled):
    """Its frame is a new one, and it stands in mid-arena: the next leg is no line from edge to edge."""
    for event in troubled.told("back"):
        first = next(run for run in troubled.runs if run["t_start_s"] >= event["t_s"])
        assert not first["counts"]


def test_gone_for_good_ends_the_session_in_one_line_and_what_was_before_reads(gone):
    assert isinstance(gone.finished.failure, ReconnectError)
    assert gone.finished.failure.exit_code == 1
    assert "\n" not in str(gone.finished.failure)
    assert "20 s" in str(gone.finished.failure)
    assert gone.events[-1]["event"] == "end"
    assert gone.events[-1]["state"] == "failed"
    assert SessionReader(gone.folder).manifest["end"]["state"] == "failed"
    assert DISCONNECT_S + 3 < gone.events[-1]["t_s"] < DISCONNECT_S + 3 + 20 + 8
    assert [run["ended"] for run in gone.runs][-1] == "link"
    assert not (gone.folder / "writer.lock").exists()
    for run in gone.runs:
        assert len(gone.light(run["line"])) > 0


def test_a_robot_that_is_not_to_be_called_back_ends_the_session_at_once(not_called_back):
    failure = not_called_back.finished.failure
    assert isinstance(failure, SessionError)
    assert failure.exit_code == 1
    assert "SB-7E57: the link was lost (it disconnected)" in str(failure)
    assert "\n" not in str(failure)
    assert not_called_back.events[-1]["t_s"] == pytest.approx(DISCONNECT_S, abs=1)


def test_the_command_says_it_in_one_line_exits_1_and_still_reports(tmp_path, capsys):
    file = tmp_path / "s.toml"
    file.write_text(
        "shape = 'square'\ncamera = 'none'\n[link]\nreconnect_s = 0\n"
        "[[virtual.faults]]\nkind = 'disconnect'\nat_s = 60\nfor_s = 5\n"
    )
    assert main(["run", str(file), "--out", str(tmp_path / "out"), "--quiet"]) == 1
    out, err = capsys.readouterr()
    assert err.startswith("error: SB-7E57: the link was lost")
    assert err.count("\n") == 1
    (report,) = out.splitlines()
    (folder,) = (tmp_path / "out").iterdir()
    assert report == str(folder / "report.html")
    assert "ended early (failed)" in (folder / "report.html").read_text(encoding="utf-8")


def test_an_interrupt_while_a_robot_is_called_back(tmp_path):
    def interrupt(text):
        if "calling it back" in text:
            signal.raise_signal(signal.SIGINT)

    session = rolled(tmp_path, say=interrupt, virtual__faults=[fault("vanish", 20.0, 1e5)])
    assert session.finished.interrupted
    assert session.events[-1]["state"] == "interrupted"


# --- wheels, sensor, air ----------------------------------------------------------------------------------------


def test_a_run_whose_wheels_are_held_is_no_line(troubled):
    run = line_at(troubled, STALL_S)
    assert run["ended"] == "stall"
    assert not run["counts"]
    assert 1.5 < run["t_end_s"] - STALL_S < 3
    held = [run for run in troubled.runs if STALL_S < run["t_start_s"] < STALL_S + 4]
    assert all(run["ended"] == "stall" and run["length_cm"] < 1 for run in held)


def test_a_stuck_sensor_spoils_the_lines_of_its_time_and_no_others(tmp_path):
    session = rolled(tmp_path, virtual__faults=[fault("stuck_sensor", 30.0, 12.0)])
    assert session.finished.outcome.n == 12
    seen = [session.light(run["line"]) for run in session.runs]
    stuck = [frame["light_lux"][frame["t_host_s"].between(30.1, 41.9)] for frame in seen]
    assert len(set(np.concatenate(stuck))) == 1
    for run in session.runs:
        if run["t_start_s"] > 43 or run["t_end_s"] < 30:
            assert not (run["starts_lit"] or run["ends_lit"])
            assert all(chord <= math.hypot(44, 44) + 4 for chord in chords(run))


def chords(run):
    s_cm = [crossing[1] for crossing in run["crossings"]]
    return [out - into for into, out in zip(s_cm[::2], s_cm[1::2], strict=True)]


def test_a_slow_and_jittery_link_changes_no_chord(tmp_path):
    session = rolled(tmp_path, virtual__link_latency_s=0.08, virtual__link_jitter_s=0.02, stop__lines=25)
    assert session.finished.failure is None
    longest = max(chord for run in session.runs if run["counts"] for chord in chords(run))
    assert longest < 1.06 * math.hypot(44, 44) + 1  # 2 % of speed, thrice, and a step of the sensor
    area, _ = area_perimeter([run for run in session.runs if run["counts"]])
    assert area == pytest.approx(44**2, rel=3.5 * 0.393 / 5)


def test_lost_notifications_cost_lines_and_not_the_session(tmp_path):
    faults = [fault("loss", 30.0, 60.0, share=0.3)]
    session = rolled(tmp_path, stop__lines=12, virtual__faults=faults)
    assert session.finished.failure is None
    assert session.finished.outcome.n == 12
    diagonal_cm = math.hypot(112.7, 82.7)
    assert all(run["length_cm"] < diagonal_cm + 1 for run in session.runs if run["counts"])
    rates = [len(session.light(run["line"])) / (run["t_end_s"] - run["t_start_s"]) for run in session.runs]
    assert min(rates) < 16  # of 20 a second
    assert max(rates) > 18


# --- the battery ------------------------------------------------------------------------------------------------


def test_a_low_battery_pauses_the_session_until_it_is_charged(starved):
    assert starved.finished.failure is None
    assert starved.finished.outcome.n == 8
    (pause,), (resume,) = starved.told("pause"), starved.told("resume")
    assert pause["battery_v"] < 3.5
    assert 60 < pause["t_s"] < 120  # read once a minute
    assert 150 <= resume["t_s"] < 150 + 2 * 15 + 1
    assert not [run for run in starved.runs if pause["t_s"] < run["t_end_s"] <= resume["t_s"]]
    (said,) = [text for text in starved.said if "paused" in text]
    assert "charge it" in said
    assert f"{pause['battery_v']:.2f} V" in said
    assert any("going on" in text for text in starved.said)
    after = next(run for run in starved.runs if run["t_start_s"] >= resume["t_s"])
    assert not after["counts"]  # somebody has put it anywhere


def test_a_battery_that_nobody_charges_ends_the_session_in_one_line(never_charged):
    failure = never_charged.finished.failure
    assert isinstance(failure, SessionError)
    assert failure.exit_code == 1
    assert "after 60 s" in str(failure)
    assert "\n" not in str(failure)
    (pause,) = never_charged.told("pause")
    assert 60 <= never_charged.events[-1]["t_s"] - pause["t_s"] < 60 + 15 + 1
    counted = [run for run in never_charged.runs if run["counts"]]
    assert never_charged.runs[-1]["t_end_s"] <= pause["t_s"]
    estimates = [run["estimate"] for run in never_charged.runs if "estimate" in run]
    assert estimates[-1]["area_cm2"] == pytest.approx(area_perimeter(counted)[0])


def test_a_battery_that_is_low_to_begin_with_is_refused(tmp_path):
    with pytest.raises(SessionError, match=r"below 3.5 V; charge it"):
        rolled(tmp_path, virtual__faults=[fault("low_battery", 0.0, 1e5)])
    assert not list(tmp_path.iterdir())


def test_a_link_that_breaks_while_the_battery_is_read_makes_a_new_frame(tmp_path, monkeypatch):
    """The robot then stands and faces elsewhere: a heading from the old wall would be another way in the new frame."""
    from robot.bolt import Bolt
    from robot.errors import LinkLostError

    read, reconnect = Bolt.battery_v, Bolt.reconnect
    asked, called = [], []

    async def once_lost(self):
        asked.append(self)
        if len(asked) == 1:
            raise LinkLostError(self.name, "it went away")
        return await read(self)

    async def called_back(self, give_up_s=60.0):
        called.append(give_up_s)
        return await reconnect(self, give_up_s)

    monkeypatch.setattr(Bolt, "battery_v", once_lost)
    monkeypatch.setattr(Bolt, "reconnect", called_back)
    session = rolled(tmp_path, stop__lines=8)
    assert called == [60.0]
    (lost,), (back,) = session.told("lost"), session.told("back")
    assert "it went away" in lost["reason"]
    after = next(run for run in session.runs if run["t_start_s"] >= back["t_s"])
    assert not after["counts"]


# --- every end --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["troubled", "starved", "never_charged"])
def test_the_robot_is_at_rest_after_the_session(request, name):
    assert request.getfixturevalue(name).come_to_rest()


@pytest.mark.parametrize("name", ["gone", "not_called_back"])
def test_a_robot_that_hears_nothing_stops_by_itself(request, name):
    """Two seconds after the last word."""
    session = request.getfixturevalue(name)
    (body,) = session.bodies
    body.advance(max(session.events[-1]["t_s"], body.t_s) + 2.5)
    assert body.speed_cm_s == 0
    assert not body.moving


def test_it_is_at_rest_too_after_an_error_in_the_midst_of_a_run(tmp_path):
    def fail(step):
        if step.n == 3:
            raise ChordlabError("the observer fell over")

    session = rolled(tmp_path, watch=fail)
    assert "fell over" in str(session.finished.failure)
    assert session.come_to_rest()


def test_it_is_at_rest_too_after_an_interrupt_at_full_speed(tmp_path):
    def interrupt_soon(text):
        if "firmware" in text:  # said once it is connected, on the loop
            asyncio.get_running_loop().call_later(21.3, signal.raise_signal, signal.SIGINT)

    session = rolled(tmp_path, say=interrupt_soon)
    assert session.finished.interrupted
    assert session.events[-1]["state"] == "interrupted"
    (body,) = session.bodies
    moved_cm = np.hypot(*np.diff(np.array(body.trace)[-12:, 1:], axis=0).T)
    assert moved_cm.max() > 0.5  # it was on its way
    assert session.come_to_rest()
