"""Plans against virtual sessions, against the separability of shapes; sessions sorted into classes; the commands."""

import json

import numpy as np
import pytest

from lab.cli.main import main
from lab.plan import charge_s, plan
from lab.recognise.recognisers import sensor_model
from lab.recognise.separability import separability
from lab.review.simulated import check_against_simulation
from lab.settings.load import load_settings
from lab.settings.settings import Settings
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from projector.collections import load_dictionary
from tests.lab.conftest import roll

PAPER = load_dictionary()
THREE = {name: PAPER[name] for name in ("square", "circle", "triangle")}


@pytest.fixture(scope="module")
def planned():
    return plan([PAPER["square"]], THREE, Settings(), np.random.default_rng(1), table_lines=20_000)


def goal(planned, name):
    return next(goal for goal in planned.entries[0].goals if goal.name == name)


def test_a_virtual_session_takes_as_long_as_planned(planned, square_session):
    """150 lines over the square: runs and seconds within what chance allows."""
    outcome = square_session.finished.outcome
    share = planned.entries[0].share
    assert outcome.runs == pytest.approx(150 / share, rel=0.15)
    assert outcome.rolling_s / outcome.runs == pytest.approx(planned.pace.run_s, rel=0.06)


def test_it_agrees_with_separability(planned):
    found = separability(
        THREE, np.random.default_rng(1), model=sensor_model(Settings()), table_lines=20_000, confidence=0.95
    )
    square = next(entry for entry in found.entries if entry.name == "square")
    assert goal(planned, "by (P, A)").need.lines == square.plane.lines
    assert goal(planned, "line by line").need.lines == square.line.lines


def test_a_session_never_stops_before_it_may(planned):
    need = goal(planned, "--until").need
    assert need.lines >= Settings().stop.at_least
    assert need.lines_likely >= need.lines
    assert need.seconds_likely >= need.seconds


def test_a_charge_is_the_time_in_which_the_virtual_battery_reaches_its_limit():
    # 4.1 V to 3.5 V of 4.1 to 3.4, of 9000 s
    assert charge_s(Settings()) == pytest.approx(9000 * 6 / 7)
    assert charge_s(load_settings(None, {"link.battery_low_v": 3.4})) == pytest.approx(9000)


def test_a_session_stays_inside_the_simulated_band(square_session):
    tables = tables_of(SessionReader(square_session.folder))
    found = check_against_simulation(tables, PAPER["square"].geometry, Settings(), np.random.default_rng(1))
    assert found.rolled.p_value > 0.01
    assert found.sensed.p_value > 0.01
    assert found.chords.test.p_value > 0.01
    assert "inside the band" in found.sentence
    figures = found.to_dict()
    assert figures["inside"] == (figures["band_p_value"] > 0.05)
    other = check_against_simulation(tables, PAPER["eiffel"].geometry, Settings(), np.random.default_rng(1))
    assert not other.rolled.inside
    assert not other.sensed.inside
    assert other.chords.test.p_value < 0.01
    assert "does not explain it" in other.sentence


def test_too_few_lines_are_not_compared(tmp_path):
    tables = tables_of(SessionReader(roll(tmp_path, shape="square", stop__lines=5).folder))
    assert check_against_simulation(tables, PAPER["square"].geometry, Settings(), np.random.default_rng(1)) is None


def test_plan_by_command(capsys):
    assert main(["plan", "circle", "--speed", "30", "--arena", "disc:60", "--robots", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["robots"] == 2
    assert found["arena"]["radius_cm"] == 60
    assert [entry["name"] for entry in found["shapes"]] == ["circle"]
    assert main(["plan", "circle"]) == 0
    assert "A to 5 %" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--arena", "big"], "150x100"),
        (["--arena", "1.2.3x4"], "150x100"),
        (["--arena", "30x30"], "larger --arena"),
        (["--precision", "2"], "precision"),
        (["--confidence", "1.5"], "confidence"),
    ],
)
def test_plans_that_cannot_be_made(capsys, words, said):
    assert main(["plan", "circle", *words]) == 2
    assert said in capsys.readouterr().err


def test_stored_sessions_are_sorted(tmp_path, square_session, uniform_session, capsys):
    roots = [str(square_session.folder), str(uniform_session.folder)]
    assert main(["classes", *roots, "--lines", "25", "--json", "--out", str(tmp_path / "classes.png")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["classes"] == 2
    assert len(found["runs"]) == 10
    assert found["truth"]["adjusted_rand"] == 1
    assert (tmp_path / "classes.png").stat().st_size > 10_000
    assert main(["classes", *roots, "--lines", "25", "--classes", "3", "--method", "kmeans"]) == 0
    assert "3 classes of 10 runs" in capsys.readouterr().out
    assert main(["classes", *roots]) == 2
    assert "too few to sort" in capsys.readouterr().err
    assert main(["classes", *roots, "--method", "tea"]) == 2
    assert "methods: errors" in capsys.readouterr().err
