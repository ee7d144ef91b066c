"""What is shown of a session at any time, against its tables and against closed forms."""

import json
import math
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.live.folder import StoryFolder
from lab.live.story import Story, lit_stretches
from lab.store.layout import SessionFolderError
from lab.store.reader import SessionReader
from lab.store.tables import tables_of


@pytest.fixture(scope="module")
def told(square_session):
    folder = StoryFolder(square_session.folder)
    folder.read()
    return folder


def test_the_story_at_a_time_is_the_table_up_to_it(told, square_session):
    table = tables_of(SessionReader(square_session.folder)).estimates
    for t_s in np.linspace(-1, table["t_s"].max() + 5, 23):
        rows = table[table["t_s"] <= t_s]
        moment = told.story.at(float(t_s))
        assert [standing.n for standing in moment.standings] == rows["n"].tolist()
        assert [standing.area_cm2 for standing in moment.standings] == rows["area_cm2"].tolist()
        assert [standing.perimeter_cm for standing in moment.standings] == rows["perimeter_cm"].tolist()
        if len(rows):
            assert moment.last.leading == rows["leading"].iloc[-1]


def test_posteriors_worked_out_again_are_those_of_the_log(told):
    assert told.learn_names()
    for standing in told.story.standings:
        assert standing.names[0] == (standing.leading, standing.posterior)
        assert sum(share for _, share in standing.names) <= 1 + 1e-9
        assert 0 <= standing.unknown <= 1


def test_a_story_read_piece_by_piece_is_the_whole_one(told, square_session):
    events = list(SessionReader(square_session.folder).events())
    piecewise = Story(150)
    recogniser = told._recogniser
    for begin in range(0, len(events), 17):
        piecewise.take(events[begin : begin + 17])
    piecewise.name_with(recogniser)
    whole, again = told.story.at(math.inf), piecewise.at(math.inf)
    assert again.standings == whole.standings
    assert again.runs == whole.runs
    assert again.state == whole.state == "complete"


def test_time_left_is_the_rest_at_this_rate(told):
    moment = told.story.at(told.story.standings[49].t_s)
    assert moment.left_s == pytest.approx(100 / 50 * moment.rolling_s)
    assert told.story.at(math.inf).left_s == 0
    assert math.isnan(told.story.at(-1.0).left_s)
    assert told.story.at(-1.0).state == "preparing"


def test_bands_are_95_percent_and_never_below_nothing(told):
    last = told.story.standings[-1]
    low, high = last.band("area_cm2")
    assert (low + high) / 2 == pytest.approx(last.area_cm2)
    assert (high - low) / 2 == pytest.approx(1.96 * last.sigma_area_cm2)
    assert all(standing.band("area_cm2")[0] >= 0 for standing in told.story.standings[1:])


def test_link_quality_counts_the_stored_samples(told, square_session):
    import pandas as pd

    runs = told.story.at(math.inf).runs
    came = due = 0.0
    for run in runs[-3:]:
        came += len(pd.read_parquet(square_session.folder / f"lines/{run.line:06d}/light.parquet"))
        due += (run.t_end_s - run.t_start_s) / 0.05
    assert told.link_quality(runs) == pytest.approx(min(1, came / due))
    assert told.link_quality(runs) > 0.9
    assert math.isnan(told.link_quality([]))


@given(st.lists(st.floats(0.1, 50), min_size=0, max_size=9), st.booleans())
def test_lit_and_dark_stretches_make_up_the_run(steps, lit_first):
    """Truth: walk along the run and flip at each crossing."""
    places = np.cumsum(steps)
    end_cm = float(places[-1] + 1) if len(places) else 1.0
    state, lit_cm, at = lit_first, 0.0, 0.0
    crossings = []
    for place in places:
        lit_cm += (place - at) * state
        at, state = float(place), not state
        crossings.append([0.0, at, state])
    lit_cm += (end_cm - at) * state
    if not crossings and lit_first:
        return  # a run that saw no crossing tells nothing of light
    found = lit_stretches(crossings, end_cm)
    assert sum(end - begin for begin, end in found) == pytest.approx(lit_cm)


def test_notes_and_pauses_are_remarks_in_their_time():
    story = Story(10)
    story.take(
        [
            {"event": "start", "t_s": 1.0},
            {"event": "note", "t_s": 2.0, "text": "hello"},
            {"event": "pause", "t_s": 3.0, "robot": "", "by": "page"},
            {"event": "resume", "t_s": 4.0, "robot": "", "by": "page"},
            {"event": "pause", "t_s": 5.0, "robot": "SB-1", "battery_v": 3.4},
            {"event": "resume", "t_s": 6.0, "robot": "SB-1"},
            {"event": "end", "t_s": 7.0, "state": "stopped"},
        ]
    )
    assert [story.at(t_s).state for t_s in (0, 1, 3, 4, 5, 7)] == [
        "preparing", "rolling", "paused", "rolling", "rolling", "stopped",
    ]  # fmt: skip
    assert [remark.text for remark in story.at(3).remarks] == ["Note: hello", "Paused"]
    assert story.at(5).battery_v == {"SB-1": 3.4}
    assert story.has_ended


def test_a_stored_frame_is_that_of_its_time_and_shows_the_led(alone_on_film):
    """Truth: the film's own frames, read one after the other, and their table."""
    import cv2
    import pandas as pd

    from lab.live.page.pictures import Film
    from tracking.video import read_frames

    folder = StoryFolder(alone_on_film)
    folder.read()
    run = folder.story.runs[-1]
    table = pd.read_parquet(folder.session.line_path(run.line, "video.frames.parquet"))
    film = Film(folder)
    film._track = None  # nothing drawn over it
    with read_frames(folder.session.segments()[run.line], threads=1, quiet=True) as reader:
        frames = [cv2.resize(frame.luma, (480, 270), interpolation=cv2.INTER_AREA).astype(float) for frame in reader]
    for row in (len(table) // 3, 2 * len(table) // 3):  # it rolls there; at either end it stands
        jpeg = film.at(float(table["t_host_s"].iloc[row]) + 1e-4)
        luma = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_GRAYSCALE).astype(float)
        off = [float(((luma - frame) ** 2).sum()) for frame in frames]
        assert abs(int(np.argmin(off)) - row) <= 1


def test_the_led_is_found_in_the_small_pictures_of_a_running_session(alone_on_film):
    """Truth: the track of the whole film."""
    from lab.live.channel import make_channel, read_news
    from lab.live.feed import Feed
    from lab.live.page.pictures import Newest
    from tracking.cameras import Frame, pack_i420
    from tracking.video import read_frames

    folder = StoryFolder(alone_on_film)
    folder.read()
    track = tracked(folder)
    here, there = make_channel()
    there.news.settimeout(5)
    now_s = [0.0]
    feed, newest = Feed(here, now=lambda: now_s[0]), Newest(folder)
    errors, states, missed = [], [], 0
    for line, path in list(folder.session.segments().items())[:8]:
        rows = track[track["line"] == line].set_index("frame")
        with read_frames(path, threads=1, quiet=True) as reader:
            for frame in reader:
                if frame.index % 2:
                    continue
                now_s[0] += 1
                feed.look()
                feed.frame(Frame(frame.index, 0.0, 0.0, pack_i420(frame.luma, frame.chroma())))
                _, places = newest.mark(read_news(there.news.recv(1 << 16))[1], lit=False)
                x_cm, y_cm, lit = rows.loc[frame.index, ["x_cm", "y_cm", "led_on"]]
                if not places or not math.isfinite(x_cm):
                    missed += 1
                else:
                    errors.append(math.dist(places[0][:2], (x_cm, y_cm)))
                    states.append(places[0][2] == lit)
    here.close()
    there.close()
    assert len(errors) > 3 * missed  # the first pictures only show what the floor is
    assert np.percentile(errors, 95) < 3
    assert np.mean(states) > 0.9


@pytest.mark.parametrize("film", ["alone_on_film", "pair_on_film"])
def test_the_trail_is_that_of_the_track(film, request):
    """Truth: the track of the whole film, of which it sees every few centimetres of every robot."""
    from lab.live.page.trail import Trail

    folder = StoryFolder(request.getfixturevalue(film))
    folder.read()
    robots = len(folder.settings.robots)
    trail = Trail(folder)
    while trail.read_next():
        pass
    seen, track = trail.sightings(), tracked(folder)
    frames_s = np.concatenate([np.asarray(times_of(folder, line)) for line in folder.session.segments()])
    assert len(seen.t_s) > 0.8 * robots * np.ptp(frames_s) / 0.25
    assert (np.diff(seen.t_s) >= 0).all()
    hits = [0, 0]
    track = track.dropna(subset=["x_cm"])
    for t_s, x_cm, y_cm, lit in zip(seen.t_s, seen.x_cm, seen.y_cm, seen.lit, strict=True):
        now = track[np.abs(track["t_host_s"] - t_s) < 1e-6]
        off_cm = np.hypot(now["x_cm"] - x_cm, now["y_cm"] - y_cm).to_numpy()
        if len(off_cm):
            hits[0] += off_cm.min() < 3
            hits[1] += now["led_on"].iloc[int(off_cm.argmin())] == lit
    assert hits[0] > 0.95 * len(seen.t_s)
    assert hits[1] > 0.9 * len(seen.t_s)


def times_of(folder, line):
    import pandas as pd

    return pd.read_parquet(folder.session.line_path(line, "video.frames.parquet"))["t_host_s"].to_numpy()


def tracked(folder):
    """The whole film's track, with each frame's time on the session's clock."""
    from tracking.track import track_segments

    calibration = folder.settings.camera_calibration()
    segments = folder.session.segments()
    track = track_segments(segments, calibration, workers=1, robots=len(folder.settings.robots))
    times = {line: times_of(folder, line) for line in segments}
    track["t_host_s"] = [times[line][frame] for line, frame in zip(track["line"], track["frame"], strict=True)]
    return track


def test_of_a_growing_log_only_what_is_new_is_read(square_session, tmp_path, monkeypatch):
    """Byte by byte about the ends of records, as a writer that is cut off leaves it; truth: the whole log."""
    shutil.copytree(square_session.folder, copy := tmp_path / "copy")
    log = copy / "events.jsonl"
    whole = log.read_bytes()
    ends = [place + 1 for place, byte in enumerate(whole) if byte == 10]
    log.write_bytes(whole[: ends[9]])
    folder = StoryFolder(copy)
    assert folder.read()
    parsed = []
    monkeypatch.setattr("lab.store.reader.json_of", lambda record: parsed.append(record) or json.loads(record))
    assert not folder.read()
    for cut, events in ((ends[10] - 1, 10), (ends[10], 11), (ends[11] + 5, 12), (ends[40] - 40, 40), (ends[40], 41)):
        before = folder.story.events
        log.write_bytes(whole[:cut])
        assert folder.read() == (events > before)
        assert folder.story.events == events
    log.write_bytes(whole)
    folder.read()
    assert parsed == whole.splitlines()[10:]  # each once
    afresh = StoryFolder(copy)
    afresh.read()
    assert folder.story.at(math.inf) == afresh.story.at(math.inf)
    log.write_bytes(whole + b'{"event": "note", "t_s"')
    assert not folder.read()
    log.write_bytes(whole + b"no json\n")
    with pytest.raises(SessionFolderError, match=f"line {len(ends) + 1} is no JSON"):
        folder.read()
