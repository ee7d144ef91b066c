"""The paper's panels against closed forms: power laws, landscapes, ellipses, what is written."""

from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
import shapely
from matplotlib.image import imread
from scipy.stats import multivariate_normal

from analysis.figures.paper.explored import Explored, chords_panel, lines_until_calm
from analysis.figures.paper.known import Known
from analysis.figures.paper.needed import crowd_panel
from analysis.figures.paper.panel import PANELS, chosen_panels, write_panel
from analysis.figures.paper.plane import domains_panel, window_of
from analysis.landscape import domains, lines_to_be_sure, lines_to_confidence
from analysis.quadrature import exact_moments
from analysis.scaling import fit_scatter
from lab.base.errors import RequestError

SQUARE, LARGER, SLAB = shapely.box(-10, -10, 10, 10), shapely.box(-11, -11, 11, 11), shapely.box(-30, -3, 30, 3)


@pytest.fixture(scope="module")
def known():
    shapes = {"square": SQUARE, "larger": LARGER, "slab": SLAB}
    moments = {name: exact_moments(shape) for name, shape in shapes.items()}
    return Known.of({name: name.title() for name in shapes}, moments, [])


def test_panels_are_chosen_by_name_and_by_figure():
    assert len(PANELS) == 24
    assert chosen_panels(None) == list(PANELS)
    assert chosen_panels("2d, 1G") == ["1G", "2D"]
    assert chosen_panels("3") == [f"3{letter}" for letter in "ABCDEFGH"]
    for wrong in ("1A", "2Z", "4", ""):
        with pytest.raises(RequestError, match=r"1B, 1C, .*3H") as caught:
            chosen_panels(wrong)
        assert "\n" not in str(caught.value)


def test_the_scatter_of_plain_means_falls_with_the_root():
    rng = np.random.default_rng(3)
    n = np.array([5, 30, 100, 300, 1000])
    steps = rng.normal(0, 4.0, (1500, 1000)).cumsum(axis=1)
    fit = fit_scatter(n, steps[:, n - 1] / n, rng)
    assert abs(fit.slope + 0.5) < 4 * fit.slope_sigma < 0.08
    assert abs(fit.prefactor - 4.0) < 4 * fit.prefactor_sigma < 0.5
    # the bootstrap's error is the one that many experiments show
    slopes = [fit_scatter(n, part[:, n - 1] / n, rng).slope for part in np.split(steps, 15)]
    assert 0.5 < np.std(slopes) / (fit.slope_sigma * np.sqrt(15)) < 2
    with pytest.raises(RequestError, match="30 lines"):
        fit_scatter([2, 4], steps[:, :2], rng)


def test_a_law_that_is_no_root_is_seen():
    n = np.array([30, 100, 300, 1000])
    runs = np.random.default_rng(1).normal(size=(400, 1)) / n**0.4
    assert fit_scatter(n, runs, np.random.default_rng(2)).slope == pytest.approx(-0.4)


def bayes(known, area, perimeter, n):
    """Posteriors by scipy's density and the moments alone."""
    likelihood = [
        multivariate_normal(
            np.array([m.area_cm2, m.perimeter_cm]) * (1 + np.array(m.bias_rel) / n), m.covariance_at(n)
        ).pdf([area, perimeter])
        for m in known.moments.values()
    ]
    return np.array(likelihood) / sum(likelihood)


def test_domains_are_bayes_rule_at_every_point(known):
    perimeter, area = np.linspace(60, 140, 7), np.linspace(300, 560, 5)
    found = domains(known.recogniser, perimeter, area, 60)
    for row, a in enumerate(area):
        for column, p in enumerate(perimeter):
            truth = bayes(known, a, p, 60)
            assert found.posterior[row, column] == pytest.approx(truth.max(), rel=1e-6)
            assert found.leader[row, column] == truth.argmax()


def test_lines_to_confidence_is_where_bayes_rule_passes_it(known):
    perimeter, area = np.array([80.0, 84.6, 130.0]), np.array([400.0, 430.0])
    found = lines_to_confidence(known.recogniser, perimeter, area, most=1e5)
    assert found[0, 2] == 10  # at once
    for row, a in enumerate(area):
        for column, p in enumerate(perimeter):
            n = found[row, column]
            if n > 10:
                assert bayes(known, a, p, n).max() == pytest.approx(0.95, abs=0.01)
                assert bayes(known, a, p, 1.2 * n).max() > 0.95


def test_half_way_between_two_like_entries_no_number_of_lines_does(known):
    size = [np.array([m.area_cm2, m.perimeter_cm]) for m in list(known.moments.values())[:2]]
    share = np.linspace(0.4, 0.6, 400)
    ways = (1 - share)[:, None] * size[0] + share[:, None] * size[1]
    lines = np.array(
        [lines_to_confidence(known.recogniser, np.array([p]), np.array([a]), most=3e4)[0, 0] for a, p in ways[::8]]
    )
    assert np.isnan(lines).any() or lines.max() > 5e3
    assert lines[0] < 2e3
    assert lines[-1] < 2e3


def test_sure_lines_hold_for_normal_draws(known):
    m = known.moments["square"]
    lines = lines_to_be_sure(known.recogniser, 0, m.covariance_at(1), (m.area_cm2, m.perimeter_cm))
    draws = np.random.default_rng(5).multivariate_normal([m.area_cm2, m.perimeter_cm], m.covariance_at(lines), 4000)
    sure = np.mean(known.recogniser.landscape(draws[:, 0], draws[:, 1], lines)[:, 0] >= 0.95)
    assert sure == pytest.approx(0.95, abs=0.02)
    assert lines > known.lines_needed()["square"]
    assert known.nearest("square")[0] == "larger"


def test_a_panel_is_written_whole(known, tmp_path):
    panel = domains_panel("2G", known, window_of(known, 100, points=(90, 60)), n=100)
    files = write_panel(panel, tmp_path)
    assert {path.name for path in files} == {"2G.svg", "2G.png", "2G.csv", "2G-entries.csv"}
    assert ElementTree.parse(tmp_path / "2G.svg").getroot().tag.endswith("svg")
    assert imread(tmp_path / "2G.png").std() > 0.01
    entries = pd.read_csv(tmp_path / "2G-entries.csv").set_index("entry")
    square = known.moments["square"]
    assert entries.loc["square", "area_cm2"] == pytest.approx(400)
    assert entries.loc["square", "sigma_perimeter_cm"] == pytest.approx(80 * square.sigma_perimeter_rel / 10)
    grid = pd.read_csv(tmp_path / "2G.csv")
    assert grid["posterior"].between(1 / 3, 1).all()


def test_the_crowd_panel_says_why(known):
    panel = crowd_panel("2J", known, window_of(known, 300, points=(90, 60)), n=300)
    entries = panel.tables["entries"].set_index("entry")
    for name, lines in entries["lines_likeliest_in_95_percent"].items():
        error = known.confusion.error(known.names.index(name), int(lines))
        assert error <= 0.05
    assert str(entries["lines_posterior_95_in_95_percent"].max()) in panel.caption


def test_until_calm():
    n = np.arange(1, 7)
    assert lines_until_calm(n, [5, 1.2, 0.95, 1.3, 1.05, 1.0], 1.0) == 5
    assert lines_until_calm(n, [1.0] * 6, 1.0) == 1
    assert lines_until_calm(n, [1, 1, 1, 1, 1, 2], 1.0) == 7


def test_chords_of_a_disc_have_the_mean_and_root_that_cauchy_says():
    moments = exact_moments(shapely.Point(0, 0).buffer(10, quad_segs=256))
    lengths = 20 * np.sqrt(1 - np.random.default_rng(1).uniform(-1, 1, 20_000) ** 2)
    estimates = pd.DataFrame({"n": [1], "line": [0], "area_cm2": [314.0], "perimeter_cm": [62.8]})
    disc = shapely.Point(0, 0).buffer(10)
    robot = Explored("circle", "Circle", disc, shapely.box(-60, -45, 60, 45), "a test", estimates, lengths, 1)
    panel = chords_panel("1F", [robot], {"circle": moments})
    table = panel.tables[""]
    assert table["length_cm"].mean() == pytest.approx(5 * np.pi, rel=0.01)  # πA/P = πr/2
    assert table["length_over_longest"].max() == 1
    assert panel.found["circle"]["mean_exact_cm"] == pytest.approx(5 * np.pi, rel=1e-4)
    assert "prefactor π/3" in panel.caption
