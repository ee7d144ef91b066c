"""A session that was cut goes on as if it had not been: same sums, same folder, higher numbers, new lines."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest

from analysis.estimate import estimate
from lab.reopen.parts import LearntLevels, parts_of
from lab.reopen.resume import pick_up, take_up
from lab.reopen.stored import stored_settings
from lab.review.review import recognition_of, review
from lab.session.ledger import Ledger
from lab.session.tally import SharedTally, SoloTally, stored_estimate
from lab.settings.load import load_settings
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from robot.cutlines import CutLine, estimate_interrupted
from tests.lab.conftest import roll
from tests.lab.cutting import Log, cut_after, estimates_of_one_robot, estimates_told, go_on

SQUARE_CM2, SQUARE_CM = 44.0**2, 4 * 44.0


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Eight lines over the square."""
    return roll(tmp_path_factory.mktemp("short"), shape="square", stop__lines=8, seed=11).folder


@pytest.fixture(scope="module")
def resumed(short, tmp_path_factory):
    """The same, cut after its tenth run and gone on with to 16 lines."""
    folder = cut_after(short, 10, tmp_path_factory.mktemp("resumed") / "session")
    go_on(folder, 16)
    return Log(folder)


# --- sums ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_cut_after_any_run_the_estimates_are_those_of_one_estimator_without_a_break(short, tmp_path, full):
    whole = Log(short)
    step = 1 if full else 5
    for runs in range(0, len(whole.runs) + 1, step):
        folder = cut_after(short, runs, tmp_path / str(runs))
        finished = pick_up(folder)
        if finished.complete:
            assert runs == len(whole.runs)
            continue
        go_on(folder)
        log = Log(folder)
        assert log.runs[:runs] == whole.runs[:runs]
        assert estimates_told(log.runs) == estimates_of_one_robot(log.runs)
        assert log.manifest["end"]["n"] == 8 == sum("estimate" in run for run in log.runs)


def test_a_resumed_session_tells_what_one_estimator_tells_of_all_its_lines(short, resumed):
    assert resumed.runs[:10] == Log(short).runs[:10]
    told = estimates_told(resumed.runs)
    assert told == estimates_of_one_robot(resumed.runs)
    assert [row[0] for row in told] == list(range(1, 17))
    lines = tables_of(SessionReader(resumed.folder)).lines
    crossed = lines[lines["counts"] & (lines["k"] > 0)]
    found = estimate(crossed["k"], crossed["l1_cm"], crossed["l3_cm3"])
    assert told[-1][1:] == pytest.approx(
        (found.area_cm2, found.perimeter_cm, found.sigma_area_cm2, found.sigma_perimeter_cm), rel=1e-12
    )


def test_the_names_posterior_is_that_of_all_lines_without_a_break(resumed):
    session = SessionReader(resumed.folder)
    tables = tables_of(session)
    posteriors = recognition_of(session, tables).posteriors
    assert posteriors.drop(columns="n").max(axis=1).tolist() == tables.estimates["posterior"].tolist()


@pytest.mark.slow
def test_over_seeds_and_cuts_area_and_perimeter_are_right_within_their_errors(tmp_path, full):
    """z of the whole, with as many cuts as there are; their mean is 0 and their spread 1."""
    sessions, lines = (24, 60) if full else (3, 20)
    rng = np.random.default_rng(3)
    z = []
    for seed in range(sessions):
        begun = roll(tmp_path / f"b{seed}", shape="square", stop__lines=lines // 2, seed=200 + seed).folder
        cut = cut_after(begun, int(rng.integers(4, lines // 2)), tmp_path / f"c{seed}")
        go_on(cut, lines)
        last = Log(cut).runs[-1]["estimate"]
        z.append(
            (
                (last["area_cm2"] - SQUARE_CM2) / last["sigma_area_cm2"],
                (last["perimeter_cm"] - SQUARE_CM) / last["sigma_perimeter_cm"],
            )
        )
    z = np.array(z)
    assert (np.abs(z.mean(axis=0)) < 3.5 / math.sqrt(sessions) + 0.3).all(), z  # a ratio of means is biased a little
    # chi² of few degrees of freedom, in generous bounds; lines that share a wall scatter a tenth more
    assert ((z**2).mean(axis=0) < 1.4 + 3.5 * math.sqrt(2 / sessions)).all(), z
    assert ((z**2).mean(axis=0) > 0.15).all(), z


@pytest.mark.parametrize("turning", ["lambert", "interior"])
def test_sums_of_weighted_lines_are_taken_up_bit_by_bit(tmp_path, turning):
    begun = roll(tmp_path / "a", motion__turning=turning, stop__lines=6, seed=3).folder
    cut = cut_after(begun, 9, tmp_path / "b")
    go_on(cut, 9)
    assert estimates_told(Log(cut).runs) == estimates_of_one_robot(Log(cut).runs)


# --- the lines of the new part ------------------------------------------------------------------------------------


def test_the_new_part_goes_on_in_time_and_in_numbers(resumed):
    runs = resumed.runs
    # the tenth run was half written: its number is not given again
    assert [run["line"] for run in runs] == [*range(10), *range(11, len(runs) + 1)]
    assert {f"{run['line']:06d}" for run in runs} <= {path.name for path in (resumed.folder / "lines").iterdir()}
    times = [event.get("t_s", event.get("t_end_s")) for event in resumed.events]
    assert times == sorted(times)
    first, second = resumed.told("start")
    assert runs[9]["t_end_s"] + 1 < second["t_s"] <= runs[10]["t_start_s"]
    assert (second["resumed"], second["part"]) == (True, 1)
    assert "resumed" not in first


def test_the_first_run_of_a_part_starts_inside_the_arena_and_does_not_count(resumed):
    counts = [run["counts"] for run in resumed.runs]
    assert [place for place, counted in enumerate(counts) if not counted] == [0, 10]


def test_the_new_part_rolls_other_lines(resumed, short):
    before = {run["heading_rad"] for run in Log(short).runs}
    assert not before & {run["heading_rad"] for run in resumed.runs[10:]}


def test_the_same_cut_gives_the_same_resumed_session_byte_for_byte(short, resumed, tmp_path):
    again = cut_after(short, 10, tmp_path / "again")
    go_on(again, 16)
    assert (again / "events.jsonl").read_bytes() == (resumed.folder / "events.jsonl").read_bytes()


def test_seeds_of_parts_have_nothing_in_common():
    settings = load_settings(None, {"seed": 5})
    made = [seed for part in range(4) for seed in settings.seeds(part)]
    children = [child for seed in made for child in seed.spawn(3)]
    assert len({tuple(seed.generate_state(4)) for seed in [*made, *children]}) == 32


def test_each_start_keeps_the_light_that_its_levels_were_learnt_from(resumed):
    from robot.crossings import learn_levels

    starts = resumed.told("start")
    for start in starts:
        (light,), (levels,) = start["light"], start["levels"]
        found = learn_levels(light["floor"], light["lit"])
        assert {name: getattr(found, name) for name in levels["shape"]} == levels["shape"]
        assert light["ring"] is None
    assert starts[0]["levels"] != starts[1]["levels"]


def test_a_runs_levels_are_those_of_its_part(resumed):
    learnt = LearntLevels.of(SessionReader(resumed.folder))
    first, second = (start["levels"][0]["shape"] for start in resumed.told("start"))
    assert [learnt.get(line, robot) for line, robot in ((9, "SB-7E57"), (9, ""), (11, "SB-7E57"), (11, ""))] == [
        first, first, second, second
    ]  # fmt: skip


def test_the_manifest_tells_of_the_part_and_of_the_whole(resumed):
    (part,) = resumed.manifest["parts"]
    assert part["started"] == "2026-11-24T09:00:00"
    assert part["lines"] == 16
    assert part["devices"]["robot"]["name"] == "SB-7E57"
    assert part["versions"] == resumed.manifest["versions"]
    end, starts = resumed.manifest["end"], resumed.told("start")
    assert end["state"] == "complete"
    assert end["runs"] == len(resumed.runs)
    last_of_first = resumed.runs[9]["t_end_s"]
    rolled_s = last_of_first - starts[0]["t_s"] + resumed.told("end")[-1]["t_s"] - starts[1]["t_s"]
    assert end["rolling_s"] == pytest.approx(rolled_s)


def test_a_session_is_resumed_again_and_again(short, tmp_path):
    folder = cut_after(short, 3, tmp_path / "session")
    for lines in (4, 6, 9):
        go_on(folder, lines)
    again = cut_after(folder, len(Log(folder).runs) - 2, tmp_path / "again")
    go_on(again, 11)
    log = Log(again)
    assert [start.get("part", 0) for start in log.told("start")] == [0, 1, 2, 3, 4]
    assert [part.number for part in parts_of(SessionReader(again))] == [0, 1, 2, 3, 4]
    assert [part["lines"] for part in log.manifest["parts"]] == [4, 6, 9, 11]
    assert estimates_told(log.runs) == estimates_of_one_robot(log.runs)


def test_mishaps_of_the_first_part_do_not_befall_the_second(tmp_path):
    """The link is lost for good at 40 s, and the session fails; whoever resumes it has mended the robot."""
    faults = [
        {"kind": "disconnect", "at_s": 40.0, "for_s": 1e5},
        {"kind": "stall", "at_s": 110.0, "for_s": 5.0},
    ]
    begun = roll(tmp_path, shape="square", link__reconnect_s=0, virtual__faults=faults, stop__lines=12, seed=2)
    assert begun.finished.failure is not None
    finished = go_on(begun.folder)
    assert finished.failure is None
    log = Log(begun.folder)
    assert log.manifest["end"]["state"] == "complete"
    stalled = [run["t_end_s"] for run in log.runs if run["ended"] == "stall"]
    assert stalled
    assert all(110 < t_s < 121 for t_s in stalled)
    assert estimates_told(log.runs) == estimates_of_one_robot(log.runs)


# --- several robots -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    root = tmp_path_factory.mktemp("crowd")
    begun = roll(root, robot=["virtual"] * 3, shape="square", stop__lines=12, seed=7).folder
    folder = cut_after(begun, 12, root / "session")
    go_on(folder, 20)
    return Log(begun), Log(folder)


def test_the_sums_of_several_robots_are_those_of_all_runs_without_a_break(crowd):
    begun, log = crowd
    assert log.runs[:12] == begun.runs[:12]
    tally, lines = SharedTally(), []
    for run in log.runs:
        tally.take(run)
        if run["counts"]:
            points = run["crossings"][int(run["starts_lit"]) : len(run["crossings"]) - int(run["ends_lit"])]
            s_cm, entering = [point[1] for point in points], [point[2] for point in points]
            cut = run["ended"] not in ("bump", "edge")
            lines.append(CutLine(s_cm, entering, run["starts_lit"], run["end_cm"], cut=cut))
        if "estimate" in run:
            told = run["estimate"]
            assert told["n"] == tally.n
            # one merge of all lines, with the weights that the sums have come to
            found = estimate_interrupted(lines, tally.estimates.path_per_cut_cm)
            assert told["area_cm2"] == tally.estimates.area() == pytest.approx(found.area())
            assert told["perimeter_cm"] == tally.estimates.perimeter() == pytest.approx(found.perimeter())
    tables = tables_of(SessionReader(log.folder))
    found = stored_estimate(tables.lines, tables.crossings)
    assert found.area_cm2 == pytest.approx(told["area_cm2"], rel=0.02)
    assert abs(found.area_cm2 - SQUARE_CM2) < 3.5 * found.sigma_area_cm2


def test_several_robots_go_on_with_numbers_above_all_that_were_begun(crowd):
    _, log = crowd
    numbers = [run["line"] for run in log.runs]
    assert len(set(numbers)) == len(numbers)
    assert min(numbers[12:]) > max(numbers[:12])
    assert {run["robot"] for run in log.runs[12:]} == {"SB-7E57", "SB-7E58", "SB-7E59"}


# --- filmed -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_filmed_session_goes_on_with_its_film(tmp_path):
    """Segments are numbered on, and each is put on the host's clock by itself: chords match in both parts."""
    begun = roll(tmp_path, shape="square", camera="virtual", stop__lines=2, seed=2).folder
    go_on(begun, 4)
    log = Log(begun)
    assert sorted(SessionReader(begun).segments()) == [run["line"] for run in log.runs]
    summary = review(begun, report=False, workers=1)
    assert summary["chords"]["missed"] == summary["chords"]["extra"] == 0
    assert summary["chords"]["matched"] == sum(run["k"] for run in log.runs if run["counts"])
    assert summary["chords"]["rms_cm"] < 1.0
    track = pd.read_parquet(begun / "track.parquet")
    for run in log.runs:
        mine = track[track["line"] == run["line"]]
        assert mine["t_s"].between(run["t_start_s"] - 0.2, run["t_end_s"] + 1.5).all()


@pytest.mark.slow
def test_several_filmed_robots_go_on_with_their_film(tmp_path):
    small = {"arena__width_cm": 90, "arena__height_cm": 70, "shape": "square", "seed": 6}
    begun = roll(tmp_path / "a", robot=["virtual"] * 2, camera="virtual", stop__lines=4, **small).folder
    first = len(Log(begun).runs)
    go_on(begun, 7)
    log = Log(begun)
    stamps = [pd.read_parquet(begun / f"lines/{run['line']:06d}/video.frames.parquet") for run in log.runs]
    film = pd.concat(stamps[first:], ignore_index=True)
    assert (film["index"].diff().iloc[1:] == film["dropped_before"].iloc[1:] + 1).all()
    assert pd.concat(stamps)["t_host_s"].is_monotonic_increasing
    assert not list((begun / "lines").glob("*.part"))
    review(begun, report=False, workers=1)
    track = pd.read_parquet(begun / "track.parquet")
    assert set(track["segment"]) == {run["line"] for run in log.runs if run["video"]["frames"]}
    for run in log.runs:
        mine = track[track["line"] == run["line"]]
        assert set(mine["robot"]) == {run["robot"]}
        assert (mine["identity"] > 0.9).mean() > 0.95
    assert len(track) == 2 * sum(len(table) for table in stamps)


def test_taking_up_is_the_code_that_rolled(short):
    """Fed with its own log, a tally stands where the live one stood; and itertools finds no line twice."""
    settings = stored_settings(SessionReader(short))
    runs = Log(short).runs

    class Silent:
        def update(self, *_): ...
        def ranked(self):
            return [("square", 1.0)]

    tally = SoloTally(settings)
    take_up(short, runs, Ledger(settings.stop, Silent()), tally)
    assert (tally.n, tally.estimates.area()) == (8, runs[-1]["estimate"]["area_cm2"])
    with pytest.raises(SessionFolderError, match="does not add up"):
        take_up(short, list(itertools.chain(runs, runs)), Ledger(settings.stop, Silent()), SoloTally(settings))
