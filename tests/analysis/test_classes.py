"""Classes of unnamed runs: the paper's six and letters against the truth; how many; hand-made clusters."""

import numpy as np
import pytest

from analysis.classes import Features, TooFewRunsError, describe, features_of, score_labels, sort_runs
from analysis.figures.classes import ClassPoint, classes_figure
from analysis.montecarlo import simulate, simulate_lines
from lab.base.errors import RequestError
from projector.collections import load_dictionary

PAPER = {name: shape.geometry for name, shape in load_dictionary().items()}


def runs_of(geometries, lines, each, rng):
    runs, truth = [], []
    for name, geometry in geometries.items():
        columns = [column.reshape(each, lines) for column in simulate_lines(geometry, lines * each, rng)]
        runs += list(zip(*columns, strict=True))
        truth += [name] * each
    return runs, truth


def blobs(rng, centres, each, sigma=1.0):
    values = np.concatenate([centre + sigma * rng.normal(size=(each, 2)) for centre in centres]) / 50
    errors = np.broadcast_to(np.eye(2) * (sigma / 50) ** 2, (len(values), 2, 2))
    return Features(("x", "y"), values, errors), np.repeat(np.arange(len(centres)), each)


@pytest.mark.parametrize("kind", ["size", "lines"])
def test_the_stated_errors_are_those_of_repeated_runs(shapes, rng, kind):
    runs, _ = runs_of({"tower": shapes["tower"]}, 400, 400, rng)
    found = features_of(runs, kind)
    scatter, stated = np.cov(found.values, rowvar=False), found.covariance.mean(axis=0)
    assert np.sqrt(np.diag(stated)) == pytest.approx(np.sqrt(np.diag(scatter)), rel=0.12)
    # the whole matrix: distances in it are χ² of as many degrees of freedom as there are features
    gap = found.values - found.values.mean(axis=0)
    distance = np.einsum("ra,ab,rb->r", gap, np.linalg.inv(stated), gap)
    assert distance.mean() == pytest.approx(len(found.names), rel=0.2)


def test_size_is_that_of_eq_1(shapes, rng):
    values, _ = describe(*simulate_lines(shapes["ell"], 200_000, rng))
    assert np.exp(values) == pytest.approx([shapes["ell"].area, shapes["ell"].length], rel=0.01)
    assert simulate(shapes["ell"], lines=2, runs=2, rng=rng).lines == 2


@pytest.mark.parametrize("lines", [100, 300, 1000])
@pytest.mark.parametrize("kind", ["size", "lines"])
def test_the_six_shapes_are_sorted_without_a_mistake(rng, lines, kind):
    runs, truth = runs_of(PAPER, lines, 8, rng)
    found = sort_runs(features_of(runs, kind), rng)
    assert found.number == 6
    assert score_labels(found.labels, truth).rand > 0.97
    assert found.criterion == "BIC"
    assert min(found.scores, key=found.scores.get) == 6


@pytest.mark.parametrize(("method", "choose"), [("mixture", "silhouette"), ("kmeans", "silhouette")])
def test_scikit_learns_methods_sort_the_six_at_300_lines(rng, method, choose):
    runs, truth = runs_of(PAPER, 300, 10, rng)
    found = sort_runs(features_of(runs), rng, method=method, choose=choose)
    score = score_labels(found.labels, truth)
    assert found.number == 6
    assert score.v_measure > 0.97
    given = sort_runs(features_of(runs), rng, method=method, number=6)
    assert given.criterion == "asked for"
    assert score_labels(given.labels, truth).rand > 0.97


def test_two_runs_of_each_shape_are_enough(rng):
    runs, truth = runs_of(PAPER, 300, 2, rng)
    found = sort_runs(features_of(runs), rng)
    assert score_labels(found.labels, truth).rand > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("lines", "rand", "v_measure"), [(300, 0.45, 0.8), (1000, 0.7, 0.92)])
def test_letters_by_their_lines(rng, lines, rand, v_measure, full):
    """By (P, A) letters are not to be told apart; five means of the lines sort most of them."""
    if lines > 300 and not full:
        pytest.skip("run with --full")
    letters = {
        name: shape.geometry
        for name, shape in load_dictionary("letters").items()
        if name.removeprefix("text:").isalpha()
    }
    runs, truth = runs_of(letters, lines, 5, rng)
    by_lines = score_labels(sort_runs(features_of(runs, "lines"), rng).labels, truth)
    by_size = score_labels(sort_runs(features_of(runs), rng).labels, truth)
    assert by_lines.rand > rand
    assert by_lines.v_measure > v_measure
    assert by_lines.rand > by_size.rand + 0.2


@pytest.mark.parametrize("method", ["errors", "mixture", "kmeans"])
def test_plain_clusters(rng, method):
    features, truth = blobs(rng, np.array([[0, 0], [12, 0], [0, 12], [15, 15]]), 12)
    found = sort_runs(features, rng, method=method, systematic=0.0)
    assert found.number == 4
    assert score_labels(found.labels, list(truth)).rand == 1
    assert found.labels.tolist() == truth.tolist()  # numbered as they first appear
    assert (found.probability > 0.99).all()


@pytest.mark.parametrize(("method", "choose"), [("errors", "silhouette"), ("mixture", "silhouette"), ("kmeans", "gap")])
def test_one_class_is_an_answer(rng, method, choose):
    features, _ = blobs(rng, np.zeros((1, 2)), 16)
    assert sort_runs(features, rng, method=method, choose=choose, systematic=0.0).number == 1


def test_the_gap_finds_plain_clusters(rng):
    features, _ = blobs(rng, np.array([[0, 0], [20, 0], [10, 17]]), 15)
    assert sort_runs(features, rng, method="kmeans", choose="gap", systematic=0.0).number == 3


def test_long_runs_with_a_common_error_of_their_own_stay_together(rng):
    """Robots whose speeds differ by half a per cent: else a long run would be a class by itself."""
    runs, truth = runs_of({name: PAPER[name] for name in ("circle", "square")}, 50_000, 5, rng)
    scales = 1 + 0.005 * rng.normal(size=len(runs))
    runs = [(k, s * l1, s**3 * l3) for s, (k, l1, l3) in zip(scales, runs, strict=True)]
    kept = sort_runs(features_of(runs), rng)
    assert score_labels(kept.labels, truth).rand == 1
    assert sort_runs(features_of(runs), rng, systematic=0.0).number > 2


def test_the_nearest_are_of_the_same_shape(rng):
    runs, truth = runs_of(PAPER, 300, 4, rng)
    found = features_of(runs)
    near = [found.nearest(run, 2) for run in range(len(runs))]
    assert np.mean([truth[other] == truth[run] for run, pair in enumerate(near) for other, _ in pair]) > 0.9
    assert all(run not in {other for other, _ in pair} for run, pair in enumerate(near))
    assert all(first[1] <= second[1] for first, second in near)


def test_scores_by_hand():
    assert score_labels([0, 0, 1, 1], ["a", "a", "b", "b"]).rand == 1
    split = score_labels([0, 1, 2, 3], ["a", "a", "b", "b"])
    assert (split.homogeneity, split.rand) == (pytest.approx(1), 0)
    assert split.completeness == pytest.approx(0.5)


def test_too_little_to_sort(rng):
    runs, _ = runs_of({"square": PAPER["square"]}, 20, 3, rng)
    with pytest.raises(TooFewRunsError, match="too few to sort") as raised:
        features_of(runs)
    assert raised.value.runs == 3
    with pytest.raises(TooFewRunsError):
        features_of([])
    with pytest.raises(RequestError, match="describe no shape"):
        describe([1] * 9, [1.0] * 9, [1.0] * 9)
    features, _ = blobs(rng, np.zeros((1, 2)), 6)
    with pytest.raises(RequestError, match="1 to 6 classes"):
        sort_runs(features, rng, number=7)


def test_the_picture_shows_each_run_once(rng):
    points = [
        ClassPoint(f"run {index}", index // 3, 100, 900 + 40 * index, 120 + 5 * index, np.diag([0.01, 0.005]))
        for index in range(6)
    ]
    figure = classes_figure(points)
    axes = figure.axes[0]
    assert {patch.get_gid() for patch in axes.patches} >= {point.name for point in points}
    assert sum(len(part.get_offsets()) for part in axes.collections if (part.get_gid() or "").startswith("class")) == 6
