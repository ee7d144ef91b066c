"""Several robots in one arena: they cut each other's lines short, and the merged sums make it good."""

import itertools
import json
import math

import numpy as np
import pytest

from lab.base.errors import RequestError
from lab.cli.main import main
from lab.review.review import review
from lab.session.tally import stored_estimate
from lab.settings.load import load_settings
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from robot.virtual.faults import Fault
from tests.lab.traces import area_perimeter, rolled

SMALL = {"arena__width_cm": 90, "arena__height_cm": 70}
AREA, PERIMETER, N = 44.0**2, 4 * 44.0, 130


@pytest.fixture(scope="session")
def crowd(tmp_path_factory):
    """Three robots on a small floor: a line in four is cut short."""
    return rolled(tmp_path_factory.mktemp("crowd"), robot=["virtual"] * 3, stop__lines=N, seed=4, **SMALL)


@pytest.fixture(scope="session")
def bereft(tmp_path_factory):
    """Two robots, one of which falls silent for good after half a minute."""
    silent = {"kind": "vanish", "at_s": 30, "for_s": 1e5, "robot": 1}
    return rolled(
        tmp_path_factory.mktemp("bereft"),
        robot=["virtual"] * 2,
        stop__lines=15,
        link__reconnect_s=15,
        virtual__faults=[silent],
    )


def test_each_robot_rolls_its_own_runs(crowd):
    names = {run["robot"] for run in crowd.runs}
    assert names == {"SB-7E57", "SB-7E58", "SB-7E59"}
    devices = SessionReader(crowd.folder).manifest["devices"]["robots"]
    assert [robot["name"] for robot in devices] == sorted(names)
    for name in names:
        own = [run for run in crowd.runs if run["robot"] == name]
        assert len(own) > len(crowd.runs) / 5
        assert all(one["t_end_s"] <= two["t_start_s"] for one, two in itertools.pairwise(own))
    lines = [run["line"] for run in crowd.runs]
    assert len(set(lines)) == len(lines)
    assert crowd.finished.outcome.n == N


def test_merged_sums_give_the_size_where_the_lines_taken_as_they_come_give_too_little(crowd):
    last = [run["estimate"] for run in crowd.runs if "estimate" in run][-1]
    assert abs(last["area_cm2"] - AREA) < 3.5 * last["sigma_area_cm2"]
    assert abs(last["perimeter_cm"] - PERIMETER) < 3.5 * last["sigma_perimeter_cm"]
    assert last["sigma_area_cm2"] < 0.09 * AREA
    naive, _ = area_perimeter([run for run in crowd.runs if run["ended"] != "link"])
    assert naive < AREA * (1 - 3.5 * 0.393 / math.sqrt(N))
    assert naive < last["area_cm2"] - 1.5 * last["sigma_area_cm2"]


def test_a_contact_is_in_the_log_of_both_at_the_same_time(crowd):
    contacts = [run for run in crowd.runs if run["ended"] == "contact"]
    assert len(contacts) > 20
    alone = 0
    for run in contacts:
        others = [other for other in crowd.runs if other["robot"] != run["robot"]]
        met = [other["ended"] for other in others if abs(other["t_end_s"] - run["t_end_s"]) < 0.2]
        if "contact" not in met:  # it ran into one that stood between two of its runs
            rolling = {other["robot"] for other in others if other["t_start_s"] <= run["t_end_s"] <= other["t_end_s"]}
            assert len(rolling) < 2
            alone += 1
    assert alone <= 0.1 * len(contacts)


def test_contacts_are_where_the_balls_touched_and_walls_where_they_did_not(crowd):
    """By the bodies' own paths: at a contact two centres are a ball's width apart, at a bump one is at the wall."""
    traces = {f"SB-{0x7E57 + i:04X}": np.array(body.trace) for i, body in enumerate(crowd.bodies)}
    right = []
    for run in crowd.runs:
        if run["ended"] not in ("contact", "bump") or run["length_cm"] < 1:
            continue
        at = {name: trace[np.argmin(np.abs(trace[:, 0] - run["t_end_s"])), 1:] for name, trace in traces.items()}
        own = at.pop(run["robot"])
        gap_cm = min(math.dist(own, other) for other in at.values()) - 2 * 3.65
        wall_cm = min(45 - 3.65 - abs(own[0]), 35 - 3.65 - abs(own[1]))
        right.append((gap_cm < 1.5) if run["ended"] == "contact" else (wall_cm < 1.0))
    assert len(right) > 150
    assert np.mean(right) > 0.97  # two may reach their walls at one time


def test_a_line_cut_by_another_robot_counts_and_is_not_whole(crowd):
    for run in crowd.runs:
        if run["ended"] == "contact":
            assert not run["whole"]
            assert run["counts"] == (run["length_cm"] > 0.5)
            assert run["weight"] == 1


def test_the_stored_tables_make_the_sessions_estimate_again(crowd):
    """The session counts under a path per cut that may be 2 % old, and the area follows it by less than that."""
    last = [run["estimate"] for run in crowd.runs if "estimate" in run][-1]
    tables = tables_of(SessionReader(crowd.folder))
    found = stored_estimate(tables.lines, tables.crossings)
    assert found.area_cm2 == pytest.approx(last["area_cm2"], rel=0.02)
    assert found.perimeter_cm == pytest.approx(last["perimeter_cm"], rel=0.02)
    # their ratio owes nothing to the path per cut
    assert found.area_cm2 / found.perimeter_cm == pytest.approx(last["area_cm2"] / last["perimeter_cm"], rel=1e-9)
    assert found.n == last["n"] == N
    assert found.sigma_area_cm2 == pytest.approx(last["sigma_area_cm2"], rel=0.05)


def test_the_review_of_a_crowd(crowd):
    summary = review(crowd.folder, report=True)
    last = [run["estimate"] for run in crowd.runs if "estimate" in run][-1]
    assert summary["robot"]["area_cm2"] == pytest.approx(last["area_cm2"], rel=0.02)
    assert summary["lines"] == N
    assert summary["run_lengths"] is None  # cut lines say nothing of the turning
    assert summary["recognised"]["name"] == last["leading"] == "square"
    text = summary["report"].read_text(encoding="utf-8")
    assert "did not end at the wall" not in text  # contacts are made good, and are no fault


def test_the_same_seed_gives_the_same_crowd(tmp_path):
    logs = [
        (rolled(tmp_path / name, robot=["virtual"] * 2, stop__lines=4, seed=seed).folder / "events.jsonl").read_bytes()
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
    ]
    assert logs[0] == logs[1] != logs[2]


def test_when_one_is_lost_for_good_the_others_finish(bereft):
    assert bereft.finished.failure is None
    assert bereft.finished.outcome.state == "complete"
    assert bereft.finished.outcome.n == 15
    (gone,) = bereft.told("gone")
    assert gone["robot"] == "SB-7E58"
    assert 30 + 15 < gone["t_s"] < 30 + 15 + 12
    (said,) = [text for text in bereft.said if "the others go on" in text]
    assert "SB-7E58 did not come back in 15 s" in said
    assert "\n" not in said
    after = [run["robot"] for run in bereft.runs if run["t_start_s"] > gone["t_s"]]
    assert set(after) == {"SB-7E57"}
    dropped = [run for run in bereft.runs if run["ended"] == "link"]
    assert [run["robot"] for run in dropped] == ["SB-7E58"]
    assert not dropped[0]["counts"]


def test_all_are_at_rest_afterwards(crowd, bereft):
    assert crowd.come_to_rest()
    for body in bereft.bodies:
        body.advance(body.t_s + 2.5)
        assert body.speed_cm_s == 0


def test_when_all_are_lost_the_session_ends_in_one_line(tmp_path):
    silent = [{"kind": "vanish", "at_s": 20 + 3 * i, "for_s": 1e5, "robot": i} for i in (0, 1)]
    session = rolled(tmp_path, robot=["virtual"] * 2, link__reconnect_s=10, virtual__faults=silent)
    assert "did not come back in 10 s" in str(session.finished.failure)
    assert "\n" not in str(session.finished.failure)
    assert session.events[-1]["state"] == "failed"
    assert len(session.told("gone")) == 1


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"camera": "virtual", "led.colours": ["red"]}, "as many colours"),
        ({"led.colours": ["red", "red"]}, "once"),
        ({"led.colours": ["red", "mauve"]}, "no LED colour"),
        ({"motion.turning": "uniform"}, "lambert"),
        ({"motion.turning": "interior"}, "lambert"),
        ({"robot": ["virtual"] * 9}, "1 to 8"),
        ({"robot": []}, "1 to 8"),
        ({"robot": ["virtual", "onboard:virtual"]}, "rolls alone"),
        ({"robot": ["ble:SB-0001", "ble:SB-0001"], "projector": "display:1"}, "listed twice"),
        ({"robot": ["virtual", "ble:SB-0001"]}, "virtual"),
    ],
)
def test_what_several_robots_cannot_do_is_refused_in_one_line(keys, says):
    with pytest.raises(RequestError, match=says) as caught:
        load_settings(None, {"robot": ["virtual", "virtual"], "camera": "none", **keys})
    assert "\n" not in str(caught.value)


def test_a_crowd_from_the_command_line(tmp_path, capsys):
    command = ["run", "--robot", "virtual", "--robot", "virtual", "--shape", "square", "--lines", "5"]
    assert main([*command, "--no-video", "--out", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["lines"] == 5
    (folder,) = tmp_path.iterdir()
    runs = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()[1:-1]]
    assert {run["robot"] for run in runs} == {"SB-7E57", "SB-7E58"}


def test_faults_reach_the_robot_that_they_name(bereft):
    """The settings' faults are counted robot by robot."""
    from lab.bench.world import _faults

    settings = load_settings(None, {"virtual.faults": [{"kind": "vanish", "at_s": 3, "for_s": 4, "robot": 1}]})
    assert _faults(settings, 0) == []
    assert _faults(settings, 1) == [Fault("vanish", 3, 4, 0.5)]
    assert {event["robot"] for event in bereft.told("lost")} == {"SB-7E58"}
