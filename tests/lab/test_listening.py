"""A session with a robot that estimates by itself: what it tells is kept, a lost link is won back."""

import asyncio
import json
import math

import numpy as np
import pytest

from lab.cli.main import main
from lab.review.review import review
from lab.session.roller import SessionError
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from robot.errors import ReconnectError
from robot.virtual.selfguided import VirtualSelfGuided
from tests.lab.traces import rolled

N = 40


@pytest.fixture(scope="session")
def alone(tmp_path_factory):
    """Forty lines of a robot that nobody drives."""
    return rolled(tmp_path_factory.mktemp("alone"), robot="onboard:virtual", stop__lines=N, seed=2)


def struck(out, action, *, after=3, **overrides):
    """A session in which ``action(twin)`` happens once, after so many lines; also what was seen of the twin."""
    twins = []
    started = VirtualSelfGuided.start

    async def keep(self):
        twins.append(self)
        await started(self)

    def watch(step):
        if step.line == after:
            action(twins[0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VirtualSelfGuided, "start", keep)
        return rolled(out, robot="onboard:virtual", watch=watch, **overrides)


@pytest.fixture(scope="session")
def interrupted(tmp_path_factory):
    """The link breaks after the fourth line, and the radio is deaf for half a minute."""

    def lose(twin):
        loop = asyncio.get_running_loop()
        twin.drop_link()
        twin._peripheral.fall_silent()
        loop.call_later(30, twin._peripheral.come_back)

    return struck(tmp_path_factory.mktemp("interrupted"), lose, stop__lines=15)


def crossed(lines):
    return np.array([(line["k"], line["l1_cm"], line["l3_cm3"]) for line in lines if line["k"]])


def by_formulas(lines):
    k, l1, l3 = crossed(lines).mean(axis=0)
    area = math.pi / 3 * l3 / l1
    return area, math.pi * area * k / l1


def test_the_robots_own_estimate_is_that_of_the_lines_it_told(alone):
    told = []
    for run in alone.runs:
        told.append(run)
        if "estimate" not in run:
            continue
        area, perimeter = by_formulas(told)
        assert run["estimate"]["area_cm2"] == pytest.approx(area, rel=1e-5)  # single precision on the air
        assert run["estimate"]["perimeter_cm"] == pytest.approx(perimeter, rel=1e-5)
    assert [run["estimate"]["n"] for run in alone.runs if "estimate" in run] == list(range(1, N + 1))
    assert [run["told"] for run in alone.runs] == list(range(1, len(alone.runs) + 1))


def test_its_errors_are_added_up_here_by_the_delta_method(alone):
    area, perimeter = by_formulas(alone.runs)
    lines = crossed(alone.runs)
    means = lines.mean(axis=0)
    relative = np.cov(lines, rowvar=False) / len(lines) / np.outer(means, means)
    last = alone.runs[-1]["estimate"]
    slope_a, slope_p = np.array([0, -1, 1]), np.array([1, -2, 1])
    variance_a, variance_p = slope_a @ relative @ slope_a, slope_p @ relative @ slope_p
    assert last["sigma_area_cm2"] == pytest.approx(area * math.sqrt(variance_a), rel=1e-4)
    assert last["sigma_perimeter_cm"] == pytest.approx(perimeter * math.sqrt(variance_p), rel=1e-4)
    mixed = slope_a @ relative @ slope_p
    assert last["correlation"] == pytest.approx(mixed / math.sqrt(variance_a * variance_p), rel=1e-4)


def test_the_size_is_that_of_the_square(alone):
    last = alone.runs[-1]["estimate"]
    assert abs(last["area_cm2"] - 44**2) < 3.5 * max(last["sigma_area_cm2"], 0.393 * 44**2 / math.sqrt(N))
    assert abs(last["perimeter_cm"] - 176) < 3.5 * max(last["sigma_perimeter_cm"], 0.337 * 176 / math.sqrt(N))


def test_lines_lie_where_the_body_rolled(alone):
    """From wall to wall, by its own odometer; the host was told at the line's end."""
    diagonal_cm = math.hypot(112.7, 82.7)
    (body,) = alone.bodies
    trace = np.array(body.trace)
    right = []
    for run in alone.runs[1:]:
        assert 0 < run["length_cm"] < 1.03 * diagonal_cm
        near = np.abs(trace[:, 0] - run["t_end_s"]) < 0.3
        wall_cm = np.minimum(56.35 - np.abs(trace[near, 1]), 41.35 - np.abs(trace[near, 2])).min()
        right.append(wall_cm < 1.5)
    assert np.mean(right) > 0.95
    ends = [run["t_end_s"] for run in alone.runs]
    assert ends == sorted(ends)


def test_the_log_tables_and_review_of_it(alone):
    session = SessionReader(alone.folder)
    assert session.manifest["devices"]["robot"]["name"] == "CL-7E57"
    assert session.manifest["end"]["state"] == "complete"
    tables = tables_of(session)
    assert tables.lines["counts"].all()
    assert tables.crossings.empty
    summary = review(alone.folder, report=True)
    last = alone.runs[-1]["estimate"]
    assert summary["robot"]["area_cm2"] == pytest.approx(last["area_cm2"], rel=1e-5)
    assert summary["recognised"]["name"] == last["leading"]
    assert summary["recognised"]["posterior"] == pytest.approx(last["posterior"])
    assert summary["run_lengths"]["p_value"] > 0.001
    assert "report.html" in str(summary["report"])


def test_it_rests_when_the_session_is_over(alone, interrupted):
    assert alone.come_to_rest()
    assert interrupted.come_to_rest()
    assert interrupted.finished.outcome.n == 15


def test_a_lost_link_is_called_back_and_the_robot_has_rolled_on(interrupted):
    (lost,), (back,) = interrupted.told("lost"), interrupted.told("back")
    assert lost["robot"] == back["robot"] == "CL-7E57"
    assert "disconnected" in lost["reason"]
    assert back["attempts"] >= 2
    assert 30 <= back["t_s"] - lost["t_s"] < 45
    told = [run["told"] for run in interrupted.runs]
    missing = set(range(1, told[-1] + 1)) - set(told)
    assert len(missing) >= 2
    (end,) = interrupted.told("end")
    assert end["lost_lines"] == len(missing)
    assert any("calling it back" in text for text in interrupted.said)


def test_lost_lines_are_in_the_robots_estimate_and_not_in_the_hosts_count(interrupted):
    last = interrupted.runs[-1]["estimate"]
    assert last["n"] == sum(run["k"] > 0 for run in interrupted.runs) == 15
    area, _ = by_formulas(interrupted.runs)
    gap = next(i for i, run in enumerate(interrupted.runs) if run["told"] != i + 1)
    before, _ = by_formulas(interrupted.runs[:gap])
    stored = [run["estimate"]["area_cm2"] for run in interrupted.runs[:gap] if "estimate" in run]
    assert stored[-1] == pytest.approx(before, rel=1e-5)
    assert last["area_cm2"] != pytest.approx(area, rel=1e-4)


def test_one_that_does_not_come_back_ends_the_session_in_one_line(tmp_path):
    session = struck(tmp_path, lambda twin: twin._peripheral.fall_silent(), link__reconnect_s=20)
    assert isinstance(session.finished.failure, ReconnectError)
    assert session.finished.failure.exit_code == 1
    assert "\n" not in str(session.finished.failure)
    assert session.events[-1]["event"] == "end"
    assert session.events[-1]["state"] == "failed"
    assert len(session.runs) >= 4


def test_one_that_is_not_to_be_called_back(tmp_path):
    session = struck(tmp_path, lambda twin: twin.drop_link(), link__reconnect_s=0)
    assert isinstance(session.finished.failure, SessionError)
    assert "bring it nearer" in str(session.finished.failure)
    assert not session.told("back")


def test_one_that_tells_no_line_for_long_ends_the_session_in_one_line(tmp_path):
    """Held, it talks and tells of no line."""

    def hold(twin):
        twin.body.advance(asyncio.get_running_loop().time())
        twin.body.held = True

    session = struck(tmp_path, hold, motion__run_timeout_s=40)
    assert isinstance(session.finished.failure, SessionError)
    assert "no line for 40 s; is it stuck?" in str(session.finished.failure)
    waited_s = session.events[-1]["t_s"] - session.runs[-1]["t_end_s"]
    assert 40 <= waited_s < 50
    assert session.come_to_rest()


@pytest.mark.parametrize(
    ("flags", "code"),
    [
        (["--robot", "onboard:virtual", "--no-video"], 0),
        (["--robot", "onboard:CL-0001", "--no-video", "--simulate"], 0),
        (["--robot", "onboard:virtual", "--robot", "onboard:virtual", "--no-video"], 2),
        (["--robot", "onboard:"], 2),
    ],
    ids=["virtual", "simulated", "two", "nobody"],
)
def test_from_the_command_line(tmp_path, capsys, flags, code):
    argv = ["run", *flags, "--shape", "square", "--lines", "4", "--out", str(tmp_path), "--json"]
    assert main(argv) == code
    out, err = capsys.readouterr()
    if code:
        assert (out, err.count("\n")) == ("", 1)
        assert "robot" in err
        return
    assert err == ""
    found = json.loads(out)
    assert found["lines"] == 4
    assert SessionReader(tmp_path / found["folder"]).manifest["devices"]["robot"]["name"] == "CL-7E57"


def test_with_a_camera_each_line_is_filmed(tmp_path):
    session = rolled(tmp_path, robot="onboard:virtual", camera="virtual", stop__lines=2)
    assert session.finished.failure is None
    assert all(run["video"]["frames"] > 10 for run in session.runs)
    assert set(SessionReader(session.folder).segments()) == {run["line"] for run in session.runs}
