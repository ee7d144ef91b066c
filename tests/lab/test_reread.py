"""A stored session read again from its raw light: its own tables, or those of other thresholds."""

import json
import shutil
from dataclasses import replace

import pandas as pd
import pytest
from typer.testing import CliRunner

from lab.base.errors import RequestError
from lab.bench.replayed import replay_devices
from lab.cli.main import app
from lab.reopen.reread import Thresholds, figures_of, reread
from lab.reopen.rerun import session_levels
from lab.session.experiment import run_experiment
from lab.settings.load import load_settings
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import Tables, tables_of
from robot.crossings import CrossingDetector
from tests.lab.conftest import STARTED, roll


def assert_equal(before, after):
    for name in Tables.__slots__:
        pd.testing.assert_frame_equal(getattr(before, name), getattr(after, name), check_exact=True)


def logged(folder):
    return tables_of(SessionReader(folder))


@pytest.mark.parametrize(
    "overrides",
    [
        {"robot": ["virtual"] * 3},
        {"arena__edge": "dark_ring"},
        {"arena__edge": "bright_ring", "arena__kind": "disc", "arena__radius_cm": 50.0},
        {"motion__turning": "interior"},
        {"motion__length_from": "odometry"},
        {"virtual__faults": [{"kind": "vanish", "at_s": 20.0, "for_s": 5.0}]},
    ],
    ids=["several", "dark ring", "disc", "interior", "odometry", "lost link"],
)
def test_with_its_own_levels_the_tables_are_those_of_the_log(tmp_path, overrides):
    rolled = roll(tmp_path, shape="square", seed=5, stop__lines=8, **overrides)
    assert_equal(logged(rolled.folder), reread(rolled.folder))


def test_of_a_long_session_too(square_session):
    assert_equal(logged(square_session.folder), reread(square_session.folder))


def test_other_thresholds_find_what_a_live_session_would_have_found(tmp_path):
    """Held against a replay with the raw light under the plain fields changed so that it learns those thresholds."""
    # the tower has slits, and this sensor sees little of them
    rolled = roll(tmp_path / "live", seed=5, stop__lines=12, virtual__footprint_cm=5.0)
    copy = tmp_path / "other"
    shutil.copytree(rolled.folder, copy)
    events = [json.loads(line) for line in (copy / "events.jsonl").read_text().splitlines()]
    levels = events[0]["levels"][0]["shape"]
    margin_lux = 0.149 * (levels["bright_lux"] - levels["dark_lux"])
    scatter_lux = margin_lux / 6 / 1.4826  # as the docstring of learn_levels says
    events[0]["light"] = [
        {
            "floor": [levels["dark_lux"] - scatter_lux, levels["dark_lux"] + scatter_lux] * 10,
            "lit": [levels["bright_lux"] - scatter_lux, levels["bright_lux"] + scatter_lux] * 10,
            "ring": None,
        }
    ]
    (copy / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    keys = {"out": str(tmp_path / "again"), "stop.lines": 10_000}
    live = run_experiment(load_settings(None, keys, base=replay_devices(copy)), started=STARTED)
    found, again = logged(live.folder), reread(rolled.folder, thresholds=Thresholds(0.5 - 0.149, 0.5 + 0.149))
    assert len(again.crossings) != len(logged(rolled.folder).crossings)  # or nothing was changed
    assert again.lines["k"].tolist() == found.lines["k"].tolist()
    for name in ("l1_cm", "l3_cm3"):
        assert again.lines[name].to_numpy() == pytest.approx(found.lines[name].to_numpy(), rel=1e-9, abs=1e-9)
    columns = ["n", "area_cm2", "perimeter_cm", "leading", "posterior"]
    pd.testing.assert_frame_equal(again.estimates[columns], found.estimates[columns], rtol=1e-9)


def test_a_line_has_the_levels_of_the_last_start_before_it(square_session, tmp_path):
    """A resumed session learnt its levels twice; the second ones shift where its later crossings lie."""
    folder = tmp_path / "resumed"
    shutil.copytree(square_session.folder, folder)
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    half = len(events) // 2
    start = json.loads(json.dumps(events[0])) | {"resumed": True, "part": 1, "t_s": events[half]["t_end_s"]}
    shape = start["levels"][0]["shape"]
    for name in ("low_lux", "mid_lux", "high_lux"):
        shape[name] += 10.0
    events.insert(half, start)
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    before, after = logged(square_session.folder), reread(folder)
    line = events[half + 1]["line"]
    first, later = before.crossings["line"] < line, before.crossings["line"] >= line
    pd.testing.assert_frame_equal(before.crossings[first], after.crossings[first], check_exact=True)
    assert (before.crossings.loc[later, "s_cm"] != after.crossings.loc[later, "s_cm"]).mean() > 0.9


def test_levels_can_be_given_for_each_robot(square_session):
    session = SessionReader(square_session.folder)
    name = session.manifest["devices"]["robot"]["name"]
    own = session_levels(next(session.events())["levels"][0])
    assert_equal(logged(square_session.folder), reread(square_session.folder, levels={name: own}))
    shifted = replace(own, shape=replace(own.shape, mid_lux=own.shape.mid_lux + 1.0))
    found = reread(square_session.folder, levels={name: shifted})
    assert figures_of(found)["area_cm2"] < figures_of(logged(square_session.folder))["area_cm2"]
    with pytest.raises(RequestError, match="no robot SB-0000"):
        reread(square_session.folder, levels={"SB-0000": own})


def test_the_detector_is_the_live_one(square_session, monkeypatch):
    """Were it another, breaking the live one would change nothing here."""
    monkeypatch.setattr(CrossingDetector, "feed", lambda *_: None)
    assert len(reread(square_session.folder).crossings) == 0


def test_what_cannot_be_read_again_is_refused_in_one_line(square_session, tmp_path):
    for low, high in ((0.6, 0.7), (0.0, 0.7), (0.3, 1.0), (0.3, 0.5)):
        with pytest.raises(RequestError, match="of the span"):
            Thresholds(low, high)
    folder = tmp_path / "short"
    shutil.copytree(square_session.folder, folder)
    (folder / "lines/000003/light.parquet").unlink()
    with pytest.raises(SessionFolderError, match="000003"):
        reread(folder)
    told = roll(tmp_path / "told", shape="square", stop__lines=2, robot="onboard:virtual")
    with pytest.raises(SessionFolderError, match="left no raw samples"):
        reread(told.folder)


def test_the_command_leaves_the_log_alone_and_tells_the_change(square_session, tmp_path):
    folder = square_session.folder
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    asked = ["finalize", str(folder), "--from-light", "--low", "0.2", "--high", "0.8", "--out", str(tmp_path / "x")]
    result = CliRunner().invoke(app, [*asked, "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["log"] == figures_of(logged(folder))
    assert told["light"]["crossings"] == len(pd.read_parquet(tmp_path / "x" / "crossings.parquet"))
    assert {path: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before
    shown = CliRunner().invoke(app, asked)
    assert "crossings" in shown.output


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--low", "0.3"], "give --from-light"),
        (["--from-light", "--low", "0.3"], "give both"),
        (["--from-light", "--out", "{folder}/x"], "choose another --out"),
    ],
)
def test_the_command_refuses_in_one_line(square_session, options, says):
    asked = [option.format(folder=square_session.folder) for option in options]
    result = CliRunner().invoke(app, ["finalize", str(square_session.folder), *asked])
    assert result.exit_code == 2 or isinstance(result.exception, RequestError)
    assert says in result.output or says in str(result.exception)
