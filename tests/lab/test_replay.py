"""A stored session played back through the whole pipeline: the same lines, the same estimates, the same film."""

import json
import shutil

import av
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from lab.base.errors import RequestError
from lab.bench.replayed import replay_devices
from lab.cli.main import app
from lab.reopen.resume import pick_up, resume
from lab.review.review import examine
from lab.session.experiment import run_experiment
from lab.settings.load import load_settings
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from tests.lab.conftest import STARTED, roll

WORDS = ["robot", "ended", "counts", "whole", "k", "weight", "starts_lit", "ends_lit"]
FIGURES = ["length_cm", "end_cm", "l1_cm", "l3_cm3"]


def replay(folder, out, **overrides):
    """Play a session back; ``stop__lines=5`` and the like change its settings."""
    keys = {"out": str(out)} | {name.replace("__", "."): value for name, value in overrides.items()}
    return run_experiment(load_settings(None, keys, base=replay_devices(folder)), started=STARTED)


def assert_same(folder, again, *, start_s=1e-9):
    """All that the log of one says, the other's says too, a constant time later."""
    before, after = (tables_of(SessionReader(path)) for path in (folder, again))
    old, new = before.lines, after.lines
    pd.testing.assert_frame_equal(old[WORDS], new[WORDS])
    for name in FIGURES:
        assert new[name].to_numpy() == pytest.approx(old[name].to_numpy(), rel=1e-12, abs=1e-12), name
    assert np.ptp(new["t_start_s"] - old["t_start_s"]) < start_s
    shift_s = new["t_start_s"].iloc[0] - old["t_start_s"].iloc[0]
    assert new["t_end_s"].to_numpy() == pytest.approx(old["t_end_s"].to_numpy() + shift_s, abs=1e-9)
    assert len(before.crossings) == len(after.crossings) > 0
    assert after.crossings["t_s"].to_numpy() == pytest.approx(before.crossings["t_s"].to_numpy() + shift_s, abs=1e-9)
    assert after.crossings["s_cm"].to_numpy() == pytest.approx(before.crossings["s_cm"].to_numpy(), abs=1e-9)
    assert after.crossings["entering"].tolist() == before.crossings["entering"].tolist()
    columns = before.estimates.columns.difference(["line", "t_s"])
    pd.testing.assert_frame_equal(before.estimates[columns], after.estimates[columns], rtol=1e-12, atol=0)


def packets(path):
    with av.open(str(path)) as container:
        return [(packet.pts, bytes(packet)) for packet in container.demux(video=0) if packet.size]


def test_a_session_without_video_is_the_same_again(square_session, tmp_path):
    again = replay(square_session.folder, tmp_path)
    assert again.outcome.state == "complete"
    assert_same(square_session.folder, again.folder)
    levels = [SessionReader(folder).manifest["devices"]["robots"] for folder in (square_session.folder, again.folder)]
    assert levels[0] == levels[1]


@pytest.mark.parametrize(
    "overrides",
    [
        {"arena__edge": "dark_ring"},
        {"arena__edge": "bright_ring", "arena__kind": "disc", "arena__radius_cm": 50.0},
        {"motion__turning": "interior"},
        {"motion__length_from": "odometry"},
    ],
    ids=["dark ring", "bright ring in a disc", "interior stops", "odometry"],
)
def test_other_ways_to_roll_are_the_same_again(tmp_path, overrides):
    rolled = roll(tmp_path / "live", shape="square", seed=5, stop__lines=8, **overrides)
    assert_same(rolled.folder, replay(rolled.folder, tmp_path / "again").folder)


def test_robots_that_meet_meet_again(tmp_path):
    rolled = roll(tmp_path / "live", shape="square", seed=5, stop__lines=12, robot=["virtual"] * 3)
    again = replay(rolled.folder, tmp_path / "again")
    assert (tables_of(SessionReader(rolled.folder)).lines["ended"] == "contact").sum() >= 4
    assert_same(rolled.folder, again.folder, start_s=1e-7)


def test_a_link_that_broke_breaks_again(tmp_path):
    faults = [{"kind": "vanish", "at_s": 30.0, "for_s": 5.0}]
    rolled = roll(tmp_path / "live", shape="square", seed=5, stop__lines=8, virtual__faults=faults)
    again = replay(rolled.folder, tmp_path / "again")
    kinds = [[event["event"] for event in SessionReader(path).events()] for path in (rolled.folder, again.folder)]
    assert "lost" in kinds[0]
    assert kinds[0] == kinds[1]
    assert_same(rolled.folder, again.folder)


def test_a_filmed_session_has_the_same_film_and_track_again(tmp_path):
    filmed_session = roll(tmp_path / "live", shape="square", camera="virtual", stop__lines=2, seed=4)
    again = replay(filmed_session.folder, tmp_path / "again")
    assert_same(filmed_session.folder, again.folder)
    old, new = (SessionReader(folder).segments() for folder in (filmed_session.folder, again.folder))
    assert list(old) == list(new)
    for line, path in old.items():
        assert packets(path) == packets(new[line])
    before, after = (examine(folder).filmed.track for folder in (filmed_session.folder, again.folder))
    shift_s = (after["t_s"] - before["t_s"]).to_numpy()
    assert np.ptp(shift_s) < 1e-9
    pd.testing.assert_frame_equal(before.drop(columns="t_s"), after.drop(columns="t_s"), rtol=1e-9, atol=1e-9)


def test_the_film_of_several_robots_is_cut_as_it_was(tmp_path):
    rolled = roll(tmp_path / "live", shape="square", seed=2, stop__lines=3, camera="virtual", robot=["virtual"] * 2)
    again = replay(rolled.folder, tmp_path / "again")
    old, new = (SessionReader(folder).segments() for folder in (rolled.folder, again.folder))
    assert list(old) == list(new)
    for line, path in old.items():
        assert packets(path) == packets(new[line])


def test_other_settings_are_what_a_replay_is_for(square_session, tmp_path):
    again = replay(square_session.folder, tmp_path, stop__lines=20, dictionary="letters", seed=77)
    old, new = (tables_of(SessionReader(folder)) for folder in (square_session.folder, again.folder))
    assert again.outcome.n == 20
    assert "a" in json.dumps(SessionReader(again.folder).manifest["dictionary"]).lower()
    count = len(new.lines)
    assert new.lines["k"].tolist() == old.lines["k"].tolist()[:count]
    assert new.estimates["area_cm2"].tolist() == pytest.approx(old.estimates["area_cm2"].tolist()[:20], rel=1e-12)


def test_once_its_runs_are_used_up_it_ends_cleanly(square_session, tmp_path):
    again = replay(square_session.folder, tmp_path, stop__lines=1000)
    assert again.failure is None
    assert (again.outcome.state, again.outcome.n) == ("replayed", 150)
    assert not list((again.folder / "lines").glob("*.part"))


def test_an_older_folder_without_raw_levels_learns_the_same_ones(square_session, tmp_path):
    old = tmp_path / "old"
    shutil.copytree(square_session.folder, old)
    lines = [json.loads(line) for line in (old / "events.jsonl").read_text().splitlines()]
    del lines[0]["light"]
    manifest = json.loads((old / "manifest.json").read_text()) | {"schema_version": 2}
    (old / "manifest.json").write_text(json.dumps(manifest))
    (old / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    again = replay(old, tmp_path / "again", stop__lines=10)
    levels = [SessionReader(folder).manifest["levels"] for folder in (old, again.folder)]
    assert levels[0] == pytest.approx(levels[1], rel=1e-12)
    assert again.outcome.n == 10


def test_the_parts_of_a_resumed_session_follow_each_other(tmp_path):
    rolled = roll(tmp_path / "live", shape="square", seed=5, stop__lines=4)
    resumed = resume(pick_up(rolled.folder, lines=8), started=STARTED)
    again = replay(resumed.folder, tmp_path / "again", stop__lines=8)
    assert again.outcome.n == 8
    old, new = (tables_of(SessionReader(folder)).lines for folder in (resumed.folder, again.folder))
    # the second part began in mid-arena, as after a lost link
    for name in ("k", "ended", "whole", "counts"):
        assert new[name].tolist() == old[name].tolist()
    lost = [event for event in SessionReader(again.folder).events() if event["event"] == "lost"]
    assert ["resumed" in event["reason"] for event in lost] == [True]


def test_a_replay_can_be_replayed(tmp_path):
    rolled = roll(tmp_path / "live", shape="square", seed=5, stop__lines=4)
    once = replay(rolled.folder, tmp_path / "once")
    assert_same(rolled.folder, replay(once.folder, tmp_path / "twice").folder)


def test_what_cannot_be_replayed_is_refused_in_one_line(square_session, tmp_path):
    folder = square_session.folder
    spec = f"replay:{folder}"
    alone = {"robot": spec, "shape": "square"}
    for bad in (alone, alone | {"projector": "virtual"}, alone | {"projector": spec, "camera": "virtual"}):
        with pytest.raises(RequestError, match="replayed as a whole"):
            load_settings(None, bad)
    with pytest.raises(RequestError, match="once for each"):
        run_experiment(
            load_settings(None, alone | {"robot": [spec, spec], "projector": spec, "camera": "none"}), started=STARTED
        )
    with pytest.raises(RequestError, match="was not filmed"):
        replay(folder, tmp_path, camera=spec)
    told = roll(tmp_path / "told", shape="square", stop__lines=2, robot="onboard:virtual")
    with pytest.raises(SessionFolderError, match="estimated by itself"):
        replay_devices(told.folder)


def test_the_command_needs_the_folder_alone(square_session, tmp_path):
    result = CliRunner().invoke(
        app, ["run", "--replay", str(square_session.folder), "--lines", "15", "--out", str(tmp_path), "--json"]
    )
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert (told["lines"], told["shape"]) == (15, "square")
    assert told["truth"]["area_cm2"] == pytest.approx(44**2)
