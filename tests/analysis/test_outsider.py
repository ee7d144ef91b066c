import numpy as np
import pytest
from scipy.special import betaln
from shapely import affinity
from shapely.geometry import box

from analysis.montecarlo import simulate_lines
from analysis.outsider import OUTSIDER_PRIOR, evidence, grow, grow_by_level
from analysis.perline import LineRecogniser, tables_of
from analysis.quadrature import exact_moments
from analysis.recognition import GaussianRecogniser
from analysis.sensor import SensorModel

SENSOR = SensorModel(1.0, 0.3, margin=0.06, noise=0.01, speed_sigma=0.02)
LINES = 300


def sensed(geometry, lines, seed):
    return SENSOR.sense(geometry, lines, np.random.default_rng(seed)).invariants()


@pytest.fixture(scope="module")
def learnt(shapes):
    """Every shape's lines, as learnt."""
    return {name: sensed(geometry, 30_000, 10 + i) for i, (name, geometry) in enumerate(shapes.items())}


def sessions(recogniser, kinds, runs, lines=LINES):
    """What the recogniser says of "none of these" at the end of each of many sessions."""
    found = []
    for run in range(runs):
        recogniser.reset()
        recogniser.update_many(*(column[run * lines : (run + 1) * lines] for column in kinds))
        found.append(recogniser.unknown())
    return np.array(found)


def test_known_shapes_are_hardly_ever_refused(shapes, learnt):
    recogniser = LineRecogniser(tables_of(learnt), weight=0.85)
    refused = [
        sessions(recogniser, sensed(geometry, 40 * LINES + 2000, 100 + i), 40) > 0.5
        for i, geometry in enumerate(shapes.values())
    ]
    assert np.mean(refused) <= 0.02


def test_looking_after_every_line_refuses_no_more(shapes, learnt):
    recogniser = LineRecogniser(tables_of(learnt), weight=0.85)
    k, l1, l3 = sensed(shapes["ell"], 60 * 200, 7)
    ever = 0
    for run in range(50):
        recogniser.reset()
        worst = 0.0
        for i in range(run * 200, (run + 1) * 200, 5):
            recogniser.update_many(k[i : i + 5], l1[i : i + 5], l3[i : i + 5])
            worst = max(worst, recogniser.unknown())
        ever += worst > 0.5
    # 1 in 20 is what the odds of 19 to 1 against an outsider allow, by Ville's inequality
    assert ever <= 4


def test_a_shape_that_is_left_out_is_unknown(shapes, learnt):
    unknown = []
    for i, name in enumerate(shapes):
        recogniser = LineRecogniser(tables_of({other: kinds for other, kinds in learnt.items() if other != name}))
        unknown.append(np.mean(sessions(recogniser, sensed(shapes[name], 10 * LINES + 1000, 200 + i), 10) > 0.5))
    assert np.mean(unknown) >= 0.9


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_another_size_is_another_shape(shapes, learnt, factor):
    recogniser = LineRecogniser(tables_of(learnt))
    unknown = [
        np.mean(
            sessions(recogniser, sensed(affinity.scale(geometry, factor, factor), 5 * LINES + 800, 300 + i), 5) > 0.5
        )
        for i, geometry in enumerate(shapes.values())
    ]
    assert np.mean(unknown) >= 0.9


def test_in_the_plane_too(shapes, rng):
    moments = {name: exact_moments(shapes[name]) for name in ("square", "circle", "tower")}
    recogniser = GaussianRecogniser(moments)
    assert recogniser.unknown() == OUTSIDER_PRIOR
    recogniser.update_many(*simulate_lines(shapes["square"], 300, rng))
    assert recogniser.unknown() < 0.3
    recogniser.reset()
    recogniser.update_many(*simulate_lines(box(0, 0, 60, 60), 300, rng))
    assert recogniser.unknown() > 0.99


def test_before_any_line_the_prior(learnt):
    recogniser = LineRecogniser(tables_of(learnt))
    assert recogniser.unknown() == OUTSIDER_PRIOR
    recogniser.update(0, 0.0, 0.0)
    assert recogniser.unknown() == OUTSIDER_PRIOR


def test_one_halving_by_hand():
    """Two bins: beta-binomials, mixed with the chance that nothing deviates."""
    counts = np.zeros((1, 2, 1))
    counts[0, :, 0] = 300, 100
    tree = grow(counts)
    assert tree.leaf.tolist() == [2, 3]
    assert tree.learnt[[1, 2, 3]].tolist() == [400, 300, 100]
    seen = np.array([2.0, 9.0])
    a, b = 300.5, 100.5
    entry = betaln(a + seen[0], b + seen[1]) - betaln(a, b)
    factors = []
    for c in (4.0, 16.0, 64.0, 256.0):
        left, right = c * a / (a + b), c * b / (a + b)
        factors.append(np.exp(betaln(left + seen[0], right + seen[1]) - betaln(left, right) - entry))
    wanted = np.log(0.2 + 0.8 * np.mean(factors))
    assert evidence(tree, np.array([0, 1]), seen) == pytest.approx(wanted)


def test_trees_hold_every_learnt_line_once(rng):
    counts = rng.poisson(3.0, (2, 4, 16, 8)).astype(float)
    for tree, total in (
        (grow(counts.sum(axis=0), 0), counts.sum()),
        (grow(counts.sum(axis=0), 1), counts.sum()),
        (grow_by_level(counts, np.full(512, 1 / 512)), counts[1].sum()),
    ):
        leaves = np.unique(tree.leaf)
        assert tree.learnt[leaves].sum() == pytest.approx(total)
        for node in range(1, tree.learnt.size // 2):
            halves = tree.learnt[2 * node] + tree.learnt[2 * node + 1]
            assert halves == 0 or halves == tree.learnt[node]


def test_levels_put_what_the_entry_never_does_together(rng):
    """Cells go from what is far likelier elsewhere to what only the entry does."""
    halves = np.zeros((2, 1, 64, 1))
    halves[:, 0, 20:40, 0] = 500.0
    tree = grow_by_level(halves, np.full(64, 1 / 64))
    assert tree.leaf[:10].max() < tree.leaf[25:35].min()


def test_evidence_is_a_bayes_factor_whose_mean_is_one(rng):
    """Under the entry the factor averages to 1: over every possible record of a few lines."""
    counts = np.zeros((1, 4, 1))
    counts[0, :, 0] = 4e6, 3e6, 2e6, 1e6  # so many that the entry is known exactly
    tree, share = grow(counts), counts.ravel() / counts.sum()
    total = 0.0
    for record in np.ndindex(4, 4, 4, 4):
        bins = np.array(record)
        total += share[bins].prod() * np.exp(evidence(tree, bins, np.ones(4)))
    assert total == pytest.approx(1, rel=1e-4)
