"""What can be told apart: predicted confusions against simulated ones."""

import numpy as np
import pytest
from shapely.affinity import affine_transform, scale
from shapely.geometry import Polygon, box

from analysis.confusion import LineConfusion, PlaneConfusion, fewest_lines, measure_rates
from analysis.figures.separability import separability_figure
from analysis.figures.values import Entry
from analysis.montecarlo import simulate_lines
from analysis.perline import learn_tables
from analysis.quadrature import exact_moments
from analysis.recognition import GaussianRecogniser
from analysis.sensor import SensorModel
from lab.base.errors import RequestError
from lab.recognise.separability import separability
from projector.collections import load_dictionary
from projector.outlines import installed_font
from projector.shape import Shape
from projector.text import Typeface, find_font

PAPER = load_dictionary()
GEOMETRIES = {name: shape.geometry for name, shape in PAPER.items()}
RIVALS = ~np.eye(len(PAPER), dtype=bool)


@pytest.fixture(scope="module")
def moments():
    return {name: exact_moments(geometry, tolerance=1e-5) for name, geometry in GEOMETRIES.items()}


@pytest.fixture(scope="module")
def tables():
    return learn_tables(GEOMETRIES, np.random.default_rng(1))


@pytest.fixture(scope="module")
def rates(tables):
    return measure_rates(GEOMETRIES, tables, RIVALS, np.random.default_rng(2))


@pytest.mark.parametrize(("name", "n"), [("eiffel", 12), ("liberty", 25), ("triangle", 10), ("square", 10)])
def test_confusions_in_the_plane_are_those_of_drawn_estimates(moments, name, n):
    """Normal estimates drawn about the entry, judged by the recogniser itself."""
    confusion = PlaneConfusion(list(moments.values()), RIVALS)
    row = list(moments).index(name)
    own, rng, draws = moments[name], np.random.default_rng(5), 4000
    recogniser = GaussianRecogniser(moments)
    # the recogniser expects the ratio's bias: where it finds no misfit at all is where the estimates lie
    from analysis.estimate import ratio_bias

    size = np.array([own.area_cm2, own.perimeter_cm])
    centre = size * (1 + ratio_bias(own.mean, own.covariance) / n)
    estimates = rng.multivariate_normal(centre, own.covariance_at(n), draws)
    posteriors = [recogniser.posterior_at(area, perimeter, n) for area, perimeter in estimates]
    wrong = np.mean([max(posterior, key=posterior.get) != name for posterior in posteriors])
    assert confusion.error(row, n) == pytest.approx(wrong, abs=4 * np.sqrt(wrong / draws) + 1e-3)
    for column, rival in enumerate(moments):
        beaten = np.mean([posterior[rival] > posterior[name] for posterior in posteriors])
        assert confusion.errors(row, n)[column] == pytest.approx(beaten, abs=4 * np.sqrt(beaten / draws) + 1e-3)


def test_error_of_equal_scatter_is_the_textbooks():
    """Two entries of one covariance: half the Mahalanobis distance apart lies the border."""
    from scipy.special import ndtr

    near = exact_moments(box(0, 0, 40, 30))
    far = exact_moments(box(0, 0, 40, 30))
    object.__setattr__(far, "area_cm2", near.area_cm2 * 1.03)
    object.__setattr__(far, "relative", far.relative / np.outer([1.03, 1], [1.03, 1]))
    confusion = PlaneConfusion([near, far], np.array([[False, True], [True, False]]))
    for n in (200, 1000):
        difference = np.array([0.03 * near.area_cm2, 0.0])
        distance = np.sqrt(difference @ np.linalg.solve(near.covariance_at(n), difference))
        # the ratio's bias goes with the size and moves the two apart by a little more
        assert confusion.error(0, n) == pytest.approx(ndtr(-distance / 2), rel=0.03)
        assert confusion.error(0, n) == confusion.errors(0, n)[1]


def test_fewest_lines_is_the_first_that_will_do():
    assert fewest_lines(lambda n: 100 / n, 0.05) == pytest.approx(2000, rel=0.006)
    assert 100 / fewest_lines(lambda n: 100 / n, 0.05) <= 0.05
    assert fewest_lines(lambda n: 0.0, 0.05) == 10
    assert fewest_lines(lambda n: 0.5, 0.05) is None
    assert fewest_lines(lambda n: 0.5 if n < 37 else 0.0, 0.05) == 37


def wrong_after(tables, geometry, row, n, runs, rng):
    """Share of simulated runs in which another entry is the likeliest after ``n`` lines, and by rival."""
    k, l1_cm, l3_cm3 = simulate_lines(geometry, n * runs, rng)
    total = tables.look_up(k, l1_cm, l3_cm3).reshape(runs, n, -1).sum(axis=1)
    return np.mean(total.argmax(axis=1) != row), np.mean(total > total[:, [row]], axis=0)


@pytest.mark.parametrize("name", ["square", "triangle", "circle"])
def test_lines_needed_are_those_of_simulated_runs(tables, rates, name):
    """At the n that the random walk asks for, simulated recognition is right as often as asked, and not at a third."""
    row = list(PAPER).index(name)
    n = fewest_lines(lambda count: rates.error(row, count), 0.05)
    wrong, _ = wrong_after(tables, GEOMETRIES[name], row, n, 3000, np.random.default_rng(7))
    assert wrong < 0.065
    wrong, _ = wrong_after(tables, GEOMETRIES[name], row, max(2, n // 3), 3000, np.random.default_rng(8))
    assert wrong > 0.05


@pytest.mark.parametrize("pair", [("square", "triangle"), ("triangle", "square"), ("circle", "triangle")])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
def test_a_pairs_random_walk_is_that_of_simulated_runs(tables, rates, pair, confidence):
    row, rival = (list(PAPER).index(name) for name in pair)
    n = rates.pair_lines(row, rival, confidence)
    # the steps are skewed, and n is a whole number: a few lines are not yet quite normal
    _, beaten = wrong_after(tables, GEOMETRIES[pair[0]], row, n, 4000, np.random.default_rng(9))
    assert beaten[rival] < 1.5 * (1 - confidence)
    _, beaten = wrong_after(tables, GEOMETRIES[pair[0]], row, int(0.7 * n), 4000, np.random.default_rng(9))
    assert beaten[rival] > 1 - confidence


def test_rates_are_the_mean_and_variance_of_looked_up_lines(tables, rates):
    """The histogram's sums against each line looked up by itself."""
    k, l1_cm, l3_cm3 = simulate_lines(GEOMETRIES["eiffel"], 100_000, np.random.default_rng(11))
    found = tables.look_up(k, l1_cm, l3_cm3)
    row = list(PAPER).index("eiffel")
    ratio = found[:, [row]] - found
    assert rates.rate[row] == pytest.approx(ratio.mean(axis=0), abs=5 * (ratio.std(axis=0) / 250).max())
    assert rates.variance[row] == pytest.approx(ratio.var(axis=0), rel=0.05, abs=1e-9)
    assert rates.rate[row, row] == pytest.approx(0)


def test_what_only_noise_tells_apart_is_never_told_apart():
    geometries = {"one": box(0, 0, 40, 30), "same": box(0, 0, 30, 40), "other": box(0, 0, 60, 20)}
    rng = np.random.default_rng(3)
    tables = learn_tables(geometries, rng, lines=30_000)
    found = measure_rates(geometries, tables, ~np.eye(3, dtype=bool), rng, lines=30_000)
    assert found.pair_lines(0, 1, 0.95) is None
    assert found.errors(0, 10_000)[1] == 0.5
    assert found.pair_lines(0, 2, 0.95) < 100


def test_a_random_walk_by_hand():
    rate = np.array([[0.0, 0.1], [0.2, 0.0]])
    variance = np.array([[0.0, 0.2], [0.4, 0.0]])
    walk = LineConfusion(rate, variance, 100_000, ~np.eye(2, dtype=bool))
    # z(0.95)² = 2.7055
    assert walk.pair_lines(0, 1, 0.95) == np.ceil(2.7055 * 0.2 / 0.01)
    assert walk.pair_lines(1, 0, 0.95) == np.ceil(2.7055 * 0.4 / 0.04)
    assert walk.error(0, 55) == pytest.approx(0.0486, abs=2e-3)
    assert walk.pair_lines(0, 1, 0.95, most=50) is None


def twins():
    """A shape, its mirror image turned, and one that is a little taller."""
    pear = Polygon([(0, 0), (30, 0), (30, 10), (12, 14), (12, 40), (0, 40)])
    mirrored = affine_transform(pear, [0, -1, -1, 0, 5, 8])
    shapes = {"pear": pear, "raep": mirrored, "tall": scale(pear, 1.0, 1.3)}
    return {name: Shape(name, name.title(), geometry, "by hand") for name, geometry in shapes.items()}


def test_mirror_twins_are_one_class_and_no_rivals():
    calls = []
    found = separability(
        twins(), np.random.default_rng(1), n=200, table_lines=50_000, progress=lambda *done: calls.append(done)
    )
    assert found.classes == (("pear", "raep"),)
    by_name = {entry.name: entry for entry in found.entries}
    assert by_name["pear"].twins == ("raep",)
    assert by_name["raep"].twins == ("pear",)
    assert by_name["tall"].twins == ()
    assert by_name["pear"].plane.rival == by_name["pear"].line.rival == "tall"
    assert all(entry.line.lines is not None and entry.plane.lines is not None for entry in found.entries)
    # one pair is left, the class against the other
    assert [pair.names for pair in found.line_pairs] == [("pear", "tall")]
    assert calls[-1] == (12, 12)
    assert calls == sorted(calls)


def test_twins_alone_have_no_rival():
    pair = {name: shape for name, shape in twins().items() if name != "tall"}
    found = separability(pair, np.random.default_rng(1), table_lines=20_000)
    assert [(entry.plane.rival, entry.line.rival, entry.line.right) for entry in found.entries] == [
        (None, None, 1.0)
    ] * 2
    assert found.line_pairs == ()


def test_anagrams_coincide_in_the_plane_and_not_line_by_line():
    typeface = Typeface(find_font(installed_font("DejaVu Sans")))
    words = {f"text:{word}": typeface.shape(word, height_cm=16) for word in ("LISTEN", "SILENT", "WAR")}
    found = separability(words, np.random.default_rng(1), n=2000)
    listen, silent, war = found.entries
    assert listen.plane.confusable == ("text:SILENT",)
    assert listen.plane.lines is None or listen.plane.lines > 100_000
    assert listen.line.lines < 1000
    assert silent.line.confusable == war.plane.confusable == war.line.confusable == ()
    assert found.plane_pairs[0].names == found.line_pairs[0].names == ("text:LISTEN", "text:SILENT")


def test_the_papers_six_need_some_tens_of_lines():
    found = separability(PAPER, np.random.default_rng(1), n=100)
    plane = {entry.name: entry.plane.lines for entry in found.entries}
    line = {entry.name: entry.line.lines for entry in found.entries}
    assert all(10 <= lines <= 60 for lines in plane.values())
    assert all(10 <= lines <= 25 for lines in line.values())
    assert all(line[name] <= plane[name] for name in PAPER)
    assert all(entry.plane.right > 0.95 and not entry.plane.confusable for entry in found.entries)


def test_through_a_sensor_it_takes_more_lines():
    two = {name: PAPER[name] for name in ("square", "triangle")}
    blurred = SensorModel(step_cm=6.0, footprint_cm=2.0, speed_sigma=0.3, jitter_cm=3.0)
    sharp = separability(two, np.random.default_rng(1), table_lines=50_000)
    found = separability(two, np.random.default_rng(1), model=blurred, table_lines=50_000)
    for ideal, real in zip(sharp.entries, found.entries, strict=True):
        assert real.line.lines > ideal.line.lines


@pytest.mark.parametrize(
    ("names", "kwargs", "words"),
    [
        (["square"], {}, "at least two"),
        (["square", "circle"], {"n": 0}, "at least 1"),
        (["square", "circle"], {"confidence": 1.0}, "between 0.5 and 1"),
        (["square", "circle"], {"confidence": 0.3}, "between 0.5 and 1"),
    ],
)
def test_requests_that_cannot_be(names, kwargs, words):
    with pytest.raises(RequestError, match=words):
        separability({name: PAPER[name] for name in names}, np.random.default_rng(1), **kwargs)


def test_the_plot_names_what_finds_room():
    rng = np.random.default_rng(1)
    covariance = np.array([[4e5, 4e4], [4e4, 8e3]])
    entries = {f"entry {n}": Entry(f"entry {n}", *rng.uniform([400, 100], [4000, 900]), covariance) for n in range(40)}
    figure = separability_figure(entries, n=300, apart=["entry 3"])
    axes = figure.axes[0]
    assert {patch.get_gid() for patch in axes.patches} >= set(entries)
    notes = [text for text in axes.texts if text.get_text()]
    assert len(notes) > 25
    boxes = [text.get_window_extent() for text in notes]
    for index, one in enumerate(boxes):
        for other in boxes[index + 1 :]:
            assert not (one.x0 < other.x1 and other.x0 < one.x1 and one.y0 < other.y1 and other.y0 < one.y1)
    figure = separability_figure({name: entries[name] for name in list(entries)[:2]}, n=10**6)
    assert len(figure.axes[0].xaxis.get_ticklocs()) >= 2


@pytest.mark.slow
def test_every_word_gets_its_figures(full):
    """Twenty words, or eighty with --full."""
    typeface = Typeface(find_font(installed_font("DejaVu Sans")))
    from projector.collections import charter_words

    words = {f"text:{word}": typeface.shape(word) for word in charter_words()[: 80 if full else 20]}
    found = separability(words, np.random.default_rng(1), n=1000)
    assert all(entry.line.lines is not None and entry.line.lines < 200 for entry in found.entries)
    assert all(entry.plane.lines is None or entry.plane.lines > entry.line.lines for entry in found.entries)
