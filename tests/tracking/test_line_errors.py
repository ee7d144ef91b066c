"""Errors of lines, bows and crossings against simulated runs; chords along an edge; delays and agreement."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from shapely import Point, Polygon, box

from tracking.chords import chord_table
from tracking.clusters import clustered_mean
from tracking.kalman import smooth_track
from tracking.matching import latency, match_crossings
from tracking.runs import fit_lines
from tracking.straightness import straightness
from tracking.truth import near_chords, true_crossings

FPS, SPEED = 25.0, 20.0
SQUARE = box(-15, -10, 15, 10)
DISC = Point(0, 0).buffer(16, quad_segs=90)


def filmed(rng, start, heading, length, *, curvature=0.0, sigma=0.06, line=0, t0=0.0, smooth=True):
    """A run on an arc as a camera with white errors sees it, and its true places at ``t``."""
    t = np.arange(0.0, length / SPEED, 1 / FPS)
    s = SPEED * t
    turned = heading + curvature * s / 2
    chord = s * np.sinc(curvature * s / 2 / np.pi)
    true = np.asarray(start) + chord[:, None] * np.column_stack([np.cos(turned), np.sin(turned)])
    seen = true + rng.normal(0, sigma, true.shape)
    track = {"line": line, "t_s": t0 + t, "x_cm": seen[:, 0], "y_cm": seen[:, 1]}
    if smooth:
        got = smooth_track(t, *seen.T, np.full(len(t), sigma**2), np.full(len(t), sigma**2))
        track |= {"x_smooth_cm": got.x_cm, "y_smooth_cm": got.y_cm}
        track |= {"sigma_x_cm": got.sigma_x_cm, "sigma_y_cm": got.sigma_y_cm}
    return pd.DataFrame(track), true


def session(rng, n, **kind):
    tracks, truths = [], []
    bent = kind.pop("curvature_sd", 0.0)
    shared = kind.pop("curvature", 0.0)
    for line in range(n):
        heading = rng.uniform(0, 2 * np.pi)
        aim, length = rng.uniform(-12, 12, 2), rng.uniform(60, 90)
        start = aim - length / 2 * np.array([np.cos(heading), np.sin(heading)])
        track, true = filmed(
            rng,
            start,
            heading,
            length,
            line=line,
            t0=20.0 * line,
            curvature=shared + bent * rng.standard_normal(),
            **kind,
        )
        tracks.append(track)
        truths.append(true)
    return pd.concat(tracks, ignore_index=True), truths


def exact_places(row, true, geometry):
    """Crossings of the true path with the shape, by bisection along it, as places along the fitted run."""
    from scipy.optimize import brentq

    s = np.linspace(0, len(true) - 1, 40 * len(true))
    frame = np.arange(len(true))

    def place(u):
        return np.array([np.interp(u, frame, true[:, 0]), np.interp(u, frame, true[:, 1])])

    signed = [_signed(place(u), geometry) for u in s[::20]]
    coarse = s[::20]
    start = np.array([row.x_start_cm, row.y_start_cm])
    along = (np.array([row.x_end_cm, row.y_end_cm]) - start) / row.length_cm
    return np.array(
        [
            (place(brentq(lambda u: _signed(place(u), geometry), coarse[k], coarse[k + 1])) - start) @ along
            for k in np.flatnonzero(np.diff(np.sign(signed)))
        ]
    )


def _signed(point, geometry):
    there = Point(point)
    return geometry.boundary.distance(there) * (-1 if geometry.contains(there) else 1)


@pytest.mark.parametrize(("curvature_sd", "geometry"), [(0.0, SQUARE), (3e-4, DISC)])
def test_errors_of_crossings_are_honest(curvature_sd, geometry):
    rng = np.random.default_rng(1)
    track, truths = session(rng, 90, curvature_sd=curvature_sd)
    lines = fit_lines(track)
    found = true_crossings(lines, geometry, track=track)
    place, length = [], []
    for row in lines.itertuples():
        mine = found[found["line"] == row.line]
        exact = exact_places(row, truths[row.line], geometry)
        if len(exact) != len(mine):
            assert not mine["sure"].all() or len(mine) == 0
            continue
        off = mine["s_cm"].to_numpy() - exact
        place += list(off / mine["sigma_s_cm"])
        length += list((off[1::2] - off[::2]) / mine["sigma_length_cm"].to_numpy()[::2])
    assert len(place) > 120
    for pulls in (place, length):
        assert 0.8 < np.sqrt(np.mean(np.square(pulls))) < 1.25
        assert abs(np.mean(pulls)) < 0.3


def test_times_of_crossings_are_honest():
    rng = np.random.default_rng(2)
    track, truths = session(rng, 60)
    lines = fit_lines(track)
    found = true_crossings(lines, SQUARE, track=track)
    pulls = []
    for row in lines.itertuples():
        mine = found[found["line"] == row.line]
        start = np.array([row.x_start_cm, row.y_start_cm])
        along = (np.array([row.x_end_cm, row.y_end_cm]) - start) / row.length_cm
        exact = exact_places(row, truths[row.line], SQUARE)
        if len(exact) == len(mine):
            t = np.interp(exact, (truths[row.line] - start) @ along, track["t_s"][track["line"] == row.line])
            pulls += list((mine["t_s"] - t) / mine["sigma_t_s"])
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


@pytest.mark.parametrize("smooth", [True, False])
def test_errors_of_line_and_bow_are_honest(smooth):
    rng = np.random.default_rng(3)
    pulls = []
    for _ in range(150):
        track, _ = filmed(rng, (-40, 3), 0.0, 85, curvature=2e-4, smooth=smooth)
        row = fit_lines(track).iloc[0]
        sagitta = -2e-4 * row["length_cm"] ** 2 / 8  # turning left bows out to the right
        tilt = row["theta_rad"] - np.pi / 2 - 2e-4 * 85 / 2
        slope = np.tan(row["theta_rad"] - np.pi / 2)
        middle = row["x_start_cm"] + row["pivot_cm"]
        arc_y = 3 + 2e-4 * (middle + 40) ** 2 / 2
        line_y = row["y_start_cm"] + slope * row["pivot_cm"]
        pulls.append(
            (
                (row["bend_cm"] - sagitta) / row["sigma_bend_cm"],
                tilt / row["sigma_theta_rad"],
                (line_y - (arc_y - sagitta / 3)) / row["sigma_pivot_cm"],
            )
        )
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert ((rms > 0.8) & (rms < 1.25)).all(), rms


def test_one_bad_frame_moves_no_crossing():
    rng = np.random.default_rng(4)
    track, _ = filmed(rng, (-40, 3), 0.05, 85)
    before = true_crossings(fit_lines(track), SQUARE, track=track)
    edge = int(np.argmin(np.abs(track["t_s"] - before["t_s"].iloc[0])))
    for name in ("x_cm", "y_cm", "x_smooth_cm", "y_smooth_cm"):
        track.loc[edge, name] += 7.0
    after = true_crossings(fit_lines(track), SQUARE, track=track)
    assert np.abs(after["s_cm"] - before["s_cm"]).max() < 0.3 * before["sigma_s_cm"].max() + 0.02
    assert np.abs(after["t_s"] - before["t_s"]).max() < 0.01


# --- straightness of a session


def test_a_steady_turn_is_found_and_chance_is_not():
    rng = np.random.default_rng(5)
    steady = straightness(fit_lines(session(rng, 60, curvature=1e-4, curvature_sd=2e-4, smooth=False)[0]))
    assert steady.curvature_rad_cm == pytest.approx(1e-4, abs=3.5 * steady.curvature_sigma_rad_cm)
    assert steady.curvature_sigma_rad_cm == pytest.approx(2e-4 / np.sqrt(60), rel=0.3)
    assert steady.own_rad_cm == pytest.approx(2e-4, rel=0.3)
    assert steady.significant
    assert steady.bend_cm < 0  # a turn to the left bows to the right
    assert steady.bend_interval_cm[0] < steady.bend_cm < steady.bend_interval_cm[1] < 0
    assert "to the right" in steady.verdict
    json.dumps(steady.to_dict())
    assert straightness(fit_lines(session(rng, 4, smooth=False)[0])) is None


def test_false_alarms_of_straightness():
    rng = np.random.default_rng(6)
    n, p, own = 30, [], []
    for _ in range(600):
        length = rng.uniform(30, 110, n)
        sigma = rng.uniform(0.01, 0.05, n)
        found = straightness(
            pd.DataFrame({"bend_cm": sigma * rng.standard_normal(n), "sigma_bend_cm": sigma, "length_cm": length})
        )
        p.append(found.p_value)
        own.append(found.own_p_value)
    assert np.mean(np.array(p) < 0.05) < 0.08
    assert stats.kstest(own, "uniform").pvalue > 1e-3


# --- grazing, edges


def certain_line(y, slope=0.0, sigma=0.05, number=0):
    return {
        "line": number, "x_start_cm": -40.0, "y_start_cm": y - 40 * slope, "x_end_cm": 40.0, "y_end_cm": y + 40 * slope,
        "t_start_s": 0.0, "t_end_s": 4.0, "length_cm": float(np.hypot(80, 80 * slope)), "rms_cm": sigma,
        "pivot_cm": 40.0, "sigma_pivot_cm": sigma, "sigma_theta_rad": 1e-4, "bend_cm": 0.0, "sigma_bend_cm": 0.0,
    }  # fmt: skip


def test_a_grazing_crossing_errs_by_the_cotangent():
    wedge = Polygon([(-20, 0), (20, 0), (20, 4)])  # rises by one in ten
    found = true_crossings(pd.DataFrame([certain_line(2.0)]), wedge)
    assert found["s_cm"].tolist() == pytest.approx([40, 60])
    assert found["sigma_s_cm"].iloc[0] == pytest.approx(10 * 0.05, rel=1e-6)
    assert found["sigma_s_cm"].iloc[1] == pytest.approx(0.0, abs=1e-6)
    assert found["sigma_length_cm"].tolist() == pytest.approx([0.5, 0.5], rel=1e-3)
    assert found["sigma_t_s"].iloc[0] == pytest.approx(0.5 / 20, rel=1e-3)


def test_parallel_edges_take_no_length_from_a_shifted_line():
    slanted = Polygon([(-10, -10), (10, -10), (20, 10), (0, 10)])
    found = true_crossings(pd.DataFrame([certain_line(0.0)]), slanted)
    assert (found["sigma_s_cm"] > 0.02).all()
    # what remains is the error of the direction: 20 cm apart, at cot = 1/2
    assert found["sigma_length_cm"].iloc[0] == pytest.approx(20 * 1e-4 * 0.5, rel=1e-6)


def test_a_line_along_an_edge_is_neither_hit_nor_fault():
    lines = pd.DataFrame([certain_line(y, number=n) for n, y in enumerate((9.98, 10.0, 10.03, 9.5, 10.5))])
    true = true_crossings(lines, SQUARE)
    assert true.groupby("line")["sure"].all().to_dict() == {0: False, 3: True}
    near = near_chords(lines, SQUARE)
    assert sorted(near["line"]) == [1, 2]
    # the robot saw nothing where the camera says a sliver, and something where it says none
    s_in, s_out = true["s_cm"].iloc[:2]
    robot = pd.concat(
        [
            pd.DataFrame(
                {"line": n, "order": [0, 1], "s_cm": [s_in, s_out], "entering": [True, False], "t_s": [1.0, 2.0]}
            )
            for n in (1, 2, 3)
        ]
    )
    match = match_crossings(robot, true, lines=range(5), near=near)
    assert (match.matched, match.missed, match.extra) == (1, 1, 2)
    assert (match.missed_unsure, match.extra_unsure) == (1, 2)
    assert match_crossings(robot, true, lines=range(5)).extra_unsure == 0


def test_unsure_chords_are_not_compared():
    rng = np.random.default_rng(8)
    lines = pd.DataFrame(
        [certain_line(rng.uniform(-9, 9), number=n) for n in range(30)]
        + [certain_line(9.97, number=n) for n in (30, 31)]
    )
    true = true_crossings(lines, SQUARE)
    cut = true["s_cm"].where((true["line"] < 30) | true["entering"], true["s_cm"] - 12.0)
    match = match_crossings(true.assign(s_cm=cut), true)
    assert match.matched == 32
    assert match.sd_cm == pytest.approx(0.0, abs=1e-9)
    assert match.agreement.n == 30
    assert match.pairs["sure"].sum() == 30


# --- delays


def test_entering_and_leaving_have_their_own_delays():
    rng = np.random.default_rng(9)
    pulls = []
    for _ in range(60):
        lines = pd.DataFrame([certain_line(rng.uniform(-9, 9), number=n) for n in range(40)])
        true = true_crossings(lines, box(-15, -10, 0, 10).union(box(5, -10, 15, 10)))
        late = np.where(true["entering"], 0.08, 0.11)
        of_line = rng.normal(0, 0.01, 40)[true["line"]]
        late = late + of_line + rng.normal(0, 0.004, len(true))
        late[rng.random(len(true)) < 0.02] += 2.0  # edges mistaken for others
        match = match_crossings(true.assign(t_s=true["t_s"] + late), true)
        pulls.append(
            (
                (match.entering.mean_s - 0.08) / match.entering.sigma_s,
                (match.leaving.mean_s - 0.11) / match.leaving.sigma_s,
            )
        )
        assert match.offset_s == pytest.approx(0.095, abs=0.01)
        assert match.entering.sigma_s == pytest.approx(0.01 / np.sqrt(40), rel=0.5)
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert ((rms > 0.75) & (rms < 1.3)).all(), rms
    fields = json.loads(json.dumps(match.to_dict()))
    assert fields["entering"]["crossings"] > 70
    assert {"bias", "limits", "trend", "lower_limit_interval"} <= set(fields["agreement"])
    assert latency(np.array([np.nan]), np.array([0.0])).crossings == 0


def test_clusters_widen_the_error_of_a_mean():
    rng = np.random.default_rng(10)
    label = np.repeat(np.arange(40), 10)
    hits = 0
    for _ in range(400):
        found = clustered_mean(rng.standard_normal(40)[label] + 0.3 * rng.standard_normal(400), label)
        low, high = found.interval()
        hits += low < 0 < high
    assert hits / 400 == pytest.approx(0.95, abs=0.03)
    assert clustered_mean([1.0, 2.0], [0, 0]).p_value(0.0) == 1.0
    assert np.isnan(clustered_mean([np.nan], [0]).value)


def test_chords_carry_their_error():
    found = true_crossings(pd.DataFrame([certain_line(0.0)]), Polygon([(-10, -10), (10, -10), (2, 10), (-10, 10)]))
    chords = chord_table(found)
    assert chords["sigma_length_cm"].iloc[0] == pytest.approx(0.05 * 8 / 20, rel=1e-2)
    assert chords["sure"].all()
