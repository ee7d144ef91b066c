"""`chordlab figures`: every panel from a small simulation, and from a stored session."""

import json
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
import shapely

from analysis.figures.paper.panel import PANELS
from analysis.quadrature import exact_moments
from lab.cli.main import main
from lab.figures.draw import MAKERS, draw_figures
from lab.figures.robots import simulated_robot, stored_robots
from lab.figures.workbench import COSTS, Scale, Workbench
from lab.settings.settings import Settings
from lab.store.reader import SessionReader
from lab.store.tables import tables_of
from projector.dictionary import load_dictionary

SMALL = Scale(
    lines=300, runs=200, most_lines=3000, chords_from=20_000, table_lines=5000, read_lines=2100, grid=(80, 60)
)
FAST = [name for name in PANELS if name not in ("3C", "3D", "3F", "3H")]  # those need the moments of 130 words


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    out = tmp_path_factory.mktemp("figures")
    steps = []
    found = draw_figures(FAST, out, seed=3, scale=SMALL, progress=lambda *step: steps.append(step))
    return out, found, steps


def table(drawn, name):
    return pd.read_csv(drawn[0] / f"{name}.csv")


def test_every_panel_of_the_paper_has_a_maker_and_known_costs():
    assert list(MAKERS) == list(PANELS)
    assert {need for _, needs in MAKERS.values() for need in needs} <= set(COSTS)


def test_every_panel_is_there_as_svg_png_and_csv(drawn):
    out, found, steps = drawn
    assert [panel.name for panel in found.panels] == FAST
    page = (out / "index.html").read_text(encoding="utf-8")
    for name in FAST:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert ElementTree.parse(out / f"{name}.svg").getroot().tag.endswith("svg")
        assert len(table(drawn, name)) > 1
        assert f'id="{name}"' in page
    shares = [done / total for done, total in steps]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    assert len(shares) > len(FAST)


def test_blinks_lie_in_the_shape_and_fill_it(drawn):
    shape = load_dictionary()["triangle"].geometry
    places = table(drawn, "1C")[["x_cm", "y_cm"]].to_numpy()
    assert shapely.contains_xy(shape.buffer(1e-2), *places.T).all()
    # uniform lines light every place alike: the mean of the blinks is the centroid
    spread = places.std(axis=0) / np.sqrt(SMALL.lines)
    off = places.mean(axis=0) - np.array(shape.centroid.coords[0])
    assert (np.abs(off) < 4 * spread).all()
    assert sorted(table(drawn, "1B")["n"].unique())[-1] == SMALL.lines


def test_a_simulated_robot_sees_what_the_exact_moments_say():
    shape = load_dictionary()["chichen_itza"]
    robot = simulated_robot(shape, Settings(), lines=4000, rng=np.random.default_rng(8))
    exact = exact_moments(shape.geometry)
    area, perimeter = robot.last
    sigma = np.sqrt(np.diag(exact.covariance_at(4000)))
    assert abs(area - exact.area_cm2) < 4.5 * sigma[0]  # successive runs are not quite independent
    assert abs(perimeter - exact.perimeter_cm) < 4.5 * sigma[1]
    assert robot.lines == 4000
    assert robot.chords_cm.size / 4000 == pytest.approx(exact.chords_per_line, rel=0.1)
    # a run hits a convex hull with the ratio of the perimeters
    within = Settings().arena.lines_within
    assert 4000 / robot.runs == pytest.approx(shape.geometry.convex_hull.length / within.length, rel=0.05)


def test_slopes_and_prefactors(drawn):
    for name, column in (("2D", "area_cm2"), ("2E", "perimeter_cm")):
        fits = pd.read_csv(drawn[0] / f"{name}-fits.csv")
        assert len(fits) == 6
        assert (np.abs(fits["slope"] + 0.5) < 4 * fits["slope_sigma"] + 0.01).all()
        assert (np.abs(fits[f"sigma0_{column}"] / fits[f"sigma0_exact_{column}"] - 1) < 0.15).all()


@pytest.mark.slow
def test_slopes_of_the_full_simulation_are_a_half():
    bench = Workbench(Settings(), seed=1, scale=Scale())
    for fits in bench.fits.values():
        for name, fit in fits.items():
            assert fit.slope == pytest.approx(-0.5, abs=0.02), name
            assert fit.slope_sigma < 0.01


def test_ellipses_hold_their_share_and_trajectories_end_near_the_truth(drawn):
    ways = table(drawn, "1G")
    assert set(ways["what"]) == {"robot", "ellipse, simulated", "ellipse, exact"}
    (panel,) = (panel for panel in drawn[1].panels if panel.name == "1G")
    for name, shape in load_dictionary().items():
        found = panel.found[name]
        assert found["inside_95_percent"] == pytest.approx(0.95, abs=0.06)
        assert found["sigma_area_over_exact"] == pytest.approx(1, abs=0.2)
        own = ways[(ways["shape"] == name) & (ways["what"] == "robot")]
        assert own["n"].max() == SMALL.lines
        last = own.iloc[-1]
        assert last["area_cm2"] == pytest.approx(shape.area_cm2, rel=0.3)
        # half an ellipse's extent in P is √(−2 ln 0.05) σ_P
        ellipse = ways[(ways["shape"] == name) & (ways["what"] == "ellipse, exact") & (ways["level"] == 0.95)]
        half = np.ptp(ellipse["perimeter_cm"]) / 2
        exact = exact_moments(shape.geometry, tolerance=1e-3)
        sigma = exact.sigma_perimeter_rel * exact.perimeter_cm / np.sqrt(1000)
        assert half == pytest.approx(np.sqrt(-2 * np.log(0.05)) * sigma, rel=0.01)


def test_relative_prefactors_rise_in_the_papers_order(drawn):
    points = table(drawn, "2F")
    assert list(points["shape"]) == ["circle", "square", "triangle", "chichen_itza", "eiffel", "liberty"]
    for column in ("sigma0_area_exact_rel", "sigma0_perimeter_exact_rel"):
        assert points[column].is_monotonic_increasing
    assert points["divergence_nats"].iloc[0] < 0.01


def test_letters_sum_to_the_word(drawn):
    sums = table(drawn, "3G")
    assert list(sums["letter"]) == list("FREEDOM")
    whole = load_dictionary("words")["text:FREEDOM"]
    last = sums.iloc[-1]
    assert last["area_sum_exact_cm2"] == pytest.approx(whole.area_cm2, rel=1e-6)
    assert last["perimeter_sum_exact_cm"] == pytest.approx(whole.perimeter_cm, rel=1e-4)
    assert abs(last["area_sum_cm2"] - last["area_sum_exact_cm2"]) < 4.5 * last["sigma_area_sum_cm2"]


def test_the_same_seed_gives_the_same_bytes_whatever_else_is_drawn(drawn, tmp_path):
    draw_figures(["2B", "1F"], tmp_path, seed=3, scale=SMALL)
    for name in ("2B", "1F"):
        assert (tmp_path / f"{name}.csv").read_bytes() == (drawn[0] / f"{name}.csv").read_bytes()
    draw_figures(["1F"], tmp_path / "other", seed=4, scale=SMALL)
    assert (tmp_path / "other/1F.csv").read_bytes() != (drawn[0] / "1F.csv").read_bytes()


def test_a_session_replaces_the_simulated_robot(square_session, tmp_path, capsys):
    root = square_session.folder.parent
    argv = ["figures", "--only", "2B", "--sessions", str(root), "--lines", "60", "--runs", "20", "--json"]
    assert main([*argv, "--out", str(tmp_path)]) == 0
    said = json.loads(capsys.readouterr().out)
    assert square_session.folder.name in said["panels"]["2B"]["caption"]
    stored = tables_of(SessionReader(square_session.folder)).estimates
    own = pd.read_csv(tmp_path / "2B.csv").query("shape == 'square' and what == 'robot'")
    assert own["n"].max() == 150
    assert own["area_cm2"].iloc[-1] == pytest.approx(stored["area_cm2"].iloc[-1], rel=1e-6)


def test_sessions_of_other_shapes_are_left_out_with_a_reason(square_session):
    others = {name: shape for name, shape in load_dictionary().items() if name != "square"}
    found = stored_robots([square_session.folder, square_session.folder.parent / "none"], others, film=False)
    assert not found.by_shape
    assert len(found.left_out) == 2
    assert "none of the paper's shapes" in found.left_out[0][1]


@pytest.mark.parametrize(
    "argv", [("--only", "5Q"), ("--blinks", "ten"), ("--sessions", "/nowhere/at/all"), ("--out", "/proc/none/such")]
)
def test_a_wrong_request_is_one_line(argv, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (
        main(["figures", "--runs", "5", "--lines", "20", *(() if "--only" in argv else ("--only", "1F")), *argv]) == 2
    )
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.strip().splitlines()) == 1
