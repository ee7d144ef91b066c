"""The session on the virtual bench: the real bleak client, a virtual radio, a virtual BOLT, virtual time."""

import json
import math
import signal

import numpy as np
import pandas as pd
import pytest
from shapely import LineString, Point, box

from lab.base.errors import ChordlabError, RequestError
from lab.review.review import recognition_of, review
from lab.session.experiment import run_experiment
from lab.settings.load import load_settings
from lab.store.reader import SessionReader
from lab.store.tables import finalize, tables_of
from robot.crossings import Levels, LevelsError, crossings_of
from tests.lab.conftest import STARTED, roll


def test_the_estimate_is_within_three_standard_errors_of_the_square(square_session):
    last = square_session.steps[-1]
    assert last.n == 150
    assert abs(last.area_cm2 - 44**2) < 3 * last.sigma_area_cm2
    assert abs(last.perimeter_cm - 4 * 44) < 3 * last.sigma_perimeter_cm
    # and the standard errors are those of 150 lines across a square: 0.393 and 0.337 for one
    assert last.sigma_area_cm2 / last.area_cm2 == pytest.approx(0.393 / math.sqrt(150), rel=0.25)
    assert last.sigma_perimeter_cm / last.perimeter_cm == pytest.approx(0.337 / math.sqrt(150), rel=0.3)


def test_the_square_is_recognised(square_session):
    assert square_session.steps[-1].leading == "square"
    assert square_session.steps[-1].posterior > 0.99


def test_the_log_tells_the_whole_session(square_session):
    session = SessionReader(square_session.folder)
    events = list(session.events())
    assert [event["event"] for event in (events[0], events[-1])] == ["start", "end"]
    assert [event["line"] for event in events if event["event"] == "line"] == list(range(len(events) - 2))
    assert session.manifest["end"]["state"] == "complete"
    assert session.manifest["devices"]["robot"]["name"] == "SB-7E57"
    assert session.manifest["devices"]["robots"][0]["levels"]["edge"] is None
    assert session.manifest["shape"]["name"] == "square"
    assert 18 < session.manifest["levels"]["dark_lux"] < 22
    assert 118 < session.manifest["levels"]["bright_lux"] < 122


def test_the_first_run_starts_inside_the_arena_and_does_not_count(square_session):
    lines = tables_of(SessionReader(square_session.folder)).lines
    assert not lines["counts"].iloc[0]
    assert lines["counts"].iloc[1:].all()


def test_mean_run_length_is_that_of_isotropic_lines(square_session):
    """Cauchy: πA/P of the reachable rectangle, whatever the shape on the floor."""
    lines = tables_of(SessionReader(square_session.folder)).lines
    reachable = box(-56.35, -41.35, 56.35, 41.35)
    expected_cm = math.pi * reachable.area / reachable.length
    lengths = lines.loc[lines["counts"], "length_cm"]
    assert abs(lengths.mean() - expected_cm) < 4 * lengths.std() / math.sqrt(len(lengths))


def test_a_session_read_again_finds_the_posteriors_of_its_log(square_session):
    session = SessionReader(square_session.folder)
    tables = tables_of(session)
    found = recognition_of(session, tables)
    assert found.ranking[0] == (tables.estimates["leading"].iloc[-1], tables.estimates["posterior"].iloc[-1])
    assert found.posteriors.drop(columns="n").max(axis=1).tolist() == tables.estimates["posterior"].tolist()


def test_raw_light_gives_the_same_crossings_again(square_session):
    """Thresholds may be changed afterwards: what is stored is enough to recompute what was estimated."""
    session = SessionReader(square_session.folder)
    levels = Levels(**session.manifest["levels"])
    tables = tables_of(session)
    speed_cm_s = session.manifest["devices"]["cruising_cm_s"]
    for line in tables.lines.itertuples():
        light = pd.read_parquet(square_session.folder / f"lines/{line.line:06d}/light.parquet")
        s_cm = (speed_cm_s * (light["t_host_s"] - line.t_rolling_s)).clip(lower=0).fillna(0)
        again = crossings_of(light["t_host_s"], s_cm, light["light_lux"], levels)
        stored = tables.crossings[tables.crossings["line"] == line.line]
        assert [c.s_cm for c in again] == pytest.approx(stored["s_cm"].tolist())
        assert [c.entering for c in again] == stored["entering"].tolist()


def test_estimates_follow_from_the_lines_by_the_formulas(square_session):
    tables = finalize(square_session.folder)
    counted = tables.lines[tables.lines["counts"] & (tables.lines["k"] > 0)]
    mean_k, mean_1, mean_3 = counted[["k", "l1_cm", "l3_cm3"]].mean()
    last = tables.estimates.iloc[-1]
    assert last["area_cm2"] == pytest.approx(math.pi / 3 * mean_3 / mean_1)
    assert last["perimeter_cm"] == pytest.approx(math.pi * last["area_cm2"] * mean_k / mean_1)
    assert tables.estimates["n"].tolist() == list(range(1, 151))


def test_the_same_seed_gives_the_same_session_byte_for_byte(tmp_path):
    first, again, other = (
        roll(tmp_path / name, stop__lines=8, seed=seed) for name, seed in (("a", 4), ("b", 4), ("c", 5))
    )
    logs = [(rolled.folder / "events.jsonl").read_bytes() for rolled in (first, again, other)]
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]
    assert first.folder.name == again.folder.name != other.folder.name
    estimates = [finalize(rolled.folder).estimates for rolled in (first, again)]
    pd.testing.assert_frame_equal(*estimates, check_exact=True)


def test_the_same_seed_gives_the_same_filmed_session(tmp_path):
    first, again = (roll(tmp_path / name, camera="virtual", stop__lines=2, seed=4) for name in ("a", "b"))
    logs = [(rolled.folder / "events.jsonl").read_bytes() for rolled in (first, again)]
    assert logs[0] == logs[1]
    tables = [
        pd.concat(pd.read_parquet(table) for table in sorted(rolled.folder.glob("lines/*/video.frames.parquet")))
        for rolled in (first, again)
    ]
    pd.testing.assert_frame_equal(*tables, check_exact=True)


def test_it_stops_on_the_posterior(tmp_path):
    rolled = roll(tmp_path, shape="circle", stop__until=0.95, stop__at_least=15, stop__lines=500)
    assert rolled.finished.outcome.state == "recognised"
    assert 15 <= rolled.finished.outcome.n < 500
    assert rolled.steps[-1].leading == "circle"
    assert rolled.steps[-1].posterior >= 0.95


def test_a_disc_arena_and_odometry(tmp_path):
    rolled = roll(
        tmp_path, shape="circle", arena__kind="disc", arena__radius_cm=55, motion__length_from="odometry",
        stop__lines=60, virtual__speed_error_sigma=0.2,
    )  # fmt: skip
    last = rolled.steps[-1]
    assert abs(last.area_cm2 - math.pi * 32**2) < 4 * last.sigma_area_cm2
    lines = tables_of(SessionReader(rolled.folder)).lines
    assert lines["length_cm"].max() < 2 * (55 - 3.65) + 1
    # odometry sees what each run's speed really was; by time the lit lengths would carry its 20 % scatter
    crossings = tables_of(SessionReader(rolled.folder)).crossings
    assert crossings["s_cm"].max() < 2 * (55 - 3.65)


def test_a_robot_that_sets_off_into_the_wall_draws_again(tmp_path, monkeypatch):
    """With a bump felt 0.5 rad off, many headings point into the wall: those runs stall, and are not lines."""
    import lab.bench.world
    from robot.virtual.body import BodySettings

    monkeypatch.setattr(
        lab.bench.world, "BodySettings", lambda **kwargs: BodySettings(**{**kwargs, "bump_angle_rad": 0.5})
    )
    lines = tables_of(SessionReader(roll(tmp_path, stop__lines=15).folder)).lines
    stalled = lines[lines["ended"] == "stall"]
    assert len(stalled) >= 2
    assert (stalled["length_cm"] < 1).all()
    assert not stalled["counts"].any()
    assert (stalled["t_end_s"] - stalled["t_start_s"]).max() < 4


def test_the_uniform_turn_is_the_biased_one(square_session, uniform_session):
    lambert, uniform = (tables_of(SessionReader(session.folder)).lines for session in (square_session, uniform_session))
    assert uniform["length_cm"].iloc[1:].mean() < lambert["length_cm"].iloc[1:].mean() - 5


def test_an_interrupt_leaves_a_session_that_reads(tmp_path):
    settings = load_settings(None, {"out": str(tmp_path), "camera": "none", "stop.lines": 1000})

    def interrupt(step):
        if step.n == 5:
            signal.raise_signal(signal.SIGINT)

    finished = run_experiment(settings, started=STARTED, watch=interrupt)
    assert finished.interrupted
    session = SessionReader(finished.folder)
    assert session.manifest["end"]["state"] == "interrupted"
    assert session.manifest["end"]["n"] == 5
    assert len(tables_of(session).estimates) == 5
    assert not (finished.folder / "writer.lock").exists()
    last = json.loads((finished.folder / "events.jsonl").read_text().splitlines()[-1])
    assert last["event"] == "end"
    summary = review(finished.folder, report=True)
    assert summary["lines"] == 5
    assert "ended early (interrupted)" in summary["report"].read_text(encoding="utf-8")


def test_light_that_does_not_separate_is_refused_before_a_folder_is_made(tmp_path):
    with pytest.raises(LevelsError, match="darken the room"):
        roll(tmp_path, virtual__white_lux=8.0, virtual__light_noise_lux=2.0)
    assert not list(tmp_path.iterdir())


def test_a_shape_too_large_for_the_arena_is_refused(tmp_path):
    with pytest.raises(RequestError, match="does not fit"):
        roll(tmp_path, arena__width_cm=60, arena__height_cm=60)


def test_a_full_disk_stops_the_session_and_what_was_written_reads(tmp_path, monkeypatch):
    from lab.store import writer as store

    committed = store.SessionWriter.commit_line

    def full(self, line, light):
        if line == 4:
            raise OSError(28, "No space left on device")
        committed(self, line, light)

    monkeypatch.setattr(store.SessionWriter, "commit_line", full)
    with pytest.raises(ChordlabError, match="No space left"):
        roll(tmp_path)
    (folder,) = tmp_path.iterdir()
    assert tables_of(SessionReader(folder)).lines["line"].tolist() == [0, 1, 2, 3]


def test_a_link_that_breaks_costs_the_line_in_progress_alone(tmp_path, monkeypatch):
    from robot.virtual.bolt import VirtualBolt

    started = VirtualBolt.start
    twins: list[VirtualBolt] = []

    async def note(self):
        twins.append(self)
        await started(self)

    monkeypatch.setattr(VirtualBolt, "start", note)
    settings = load_settings(None, {"out": str(tmp_path), "camera": "none", "shape": "square", "stop.lines": 8})
    finished = run_experiment(
        settings, started=STARTED, watch=lambda step: twins[0].drop_link() if step.line == 3 else None
    )
    assert finished.failure is None
    session = SessionReader(finished.folder)
    assert session.manifest["end"]["state"] == "complete"
    tables = tables_of(session)
    assert tables.lines["line"].tolist() == list(range(len(tables.lines)))
    # it broke between two runs or at the next one's first command: whatever had ended before is whole
    assert tables.lines["ended"].iloc[:4].tolist() == ["bump"] * 4
    assert (tables.lines["ended"] == "link").sum() <= 1
    assert not tables.lines.loc[tables.lines["ended"] == "link", "counts"].any()
    assert [event["event"] for event in session.events() if event["event"] in ("lost", "back")] == ["lost", "back"]
    assert tables.estimates["n"].tolist() == list(range(1, 9))


def test_the_robot_stands_still_after_every_way_out(tmp_path, monkeypatch):
    """The last that the body hears is to stop, however the session ends."""
    from robot.virtual.body import Body

    bodies: list[Body] = []
    made = Body.__init__

    def note(self, *args, **kwargs):
        made(self, *args, **kwargs)
        bodies.append(self)

    monkeypatch.setattr(Body, "__init__", note)

    def fail(step):
        if step.n == 3:
            raise ChordlabError("the observer fell over")

    settings = load_settings(None, {"out": str(tmp_path), "camera": "none"})
    run_experiment(settings, started=STARTED, watch=fail)
    assert bodies[0]._wanted_speed_cm_s == 0


def test_lines_are_where_the_light_says(filmed_session):
    """Ground truth by the camera's own track: lit stretches lie inside the square, by shapely."""
    from tracking.calibration import Calibration
    from tracking.runs import fit_lines
    from tracking.track import track_segments

    session = SessionReader(filmed_session.folder)
    calibration = Calibration.from_dict(session.manifest["calibration"]["camera"])
    lines = fit_lines(track_segments(session.segments(), calibration, workers=1))
    tables = tables_of(session)
    square = box(-22, -22, 22, 22)
    compared = 0
    for line in lines[(lines["reason"] == "") & (lines["line"] > 0)].itertuples():
        path = LineString([Point(line.x_start_cm, line.y_start_cm), Point(line.x_end_cm, line.y_end_cm)])
        robot_cm = float(tables.lines.loc[tables.lines["line"] == line.line, "l1_cm"].iloc[0])
        assert robot_cm == pytest.approx(path.intersection(square).length, abs=0.06 * 60 + 1.0)
        compared += 1
    assert compared >= 12
    assert np.isfinite(tables.lines["l1_cm"]).all()
