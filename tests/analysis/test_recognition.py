from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose
from scipy import stats
from shapely import affinity
from shapely.geometry import box

from analysis.congruence import congruence_classes
from analysis.montecarlo import simulate_lines
from analysis.perline import LineRecogniser, learn_tables, tables_of
from analysis.quadrature import exact_moments
from analysis.recognition import FIRST_POSTERIOR_N, GaussianRecogniser, Recogniser, Weights
from analysis.sensor import SensorModel
from lab.base.errors import RequestError

SIX = ("circle", "square", "triangle", "pyramid", "tower", "statue")
SENSOR = SensorModel(1.25, 0.4, margin=0.06, noise=0.01, speed_sigma=0.02)


@pytest.fixture(scope="module")
def six(shapes):
    return {name: shapes[name] for name in SIX}


@pytest.fixture(scope="module")
def moments(six):
    return {name: exact_moments(geometry) for name, geometry in six.items()}


@pytest.fixture(scope="module")
def tables(six):
    return learn_tables(six, np.random.default_rng(1))


@pytest.fixture(scope="module")
def sensed_tables(six):
    return learn_tables(six, np.random.default_rng(2), model=SENSOR)


def share_right(recogniser, six, lines, runs, rng, model=None):
    """Share of the runs that end with the right name first, for each shape."""
    right = {}
    for name, geometry in six.items():
        good = 0
        for _ in range(runs):
            recogniser.reset()
            if model is None:
                recogniser.update_many(*simulate_lines(geometry, lines, rng))
            else:
                recogniser.update_many(*model.sense(geometry, lines, rng).invariants())
            good += recogniser.ranked()[0][0] == name
        right[name] = good / runs
    return right


def test_area_and_perimeter_recognise_six_shapes_in_300_lines(six, moments, rng):
    right = share_right(GaussianRecogniser(moments), six, 300, 100, rng)
    assert np.mean(list(right.values())) >= 0.95
    assert min(right.values()) >= 0.9


def test_single_lines_recognise_six_shapes_in_100_lines(six, tables, rng):
    assert min(share_right(LineRecogniser(tables), six, 100, 100, rng).values()) >= 0.95


@pytest.mark.parametrize("speed_sigma", [0.01, 0.03])
def test_an_imperfect_sensor_is_met_by_a_matched_dictionary(six, sensed_tables, speed_sigma, rng):
    world = replace(SENSOR, speed_sigma=speed_sigma)
    right = share_right(LineRecogniser(sensed_tables), six, 60, 60, rng, world)
    assert min(right.values()) >= 0.95


def test_a_systematic_error_of_length_is_borne(six, sensed_tables, rng):
    for factor in (0.97, 1.03):
        stretched = {name: affinity.scale(geometry, factor, factor) for name, geometry in six.items()}
        right = share_right(LineRecogniser(sensed_tables), stretched, 100, 40, rng, SENSOR)
        assert min(right.values()) >= 0.92


def test_posterior_means_what_it_says(six, tables, rng):
    # Over many runs stopped after a few lines, the leader is right as often as its posterior claims.
    claimed, right = [], []
    recogniser = LineRecogniser(tables)
    for name, geometry in six.items():
        for k, l1, l3 in zip(*(c.reshape(150, 8) for c in simulate_lines(geometry, 150 * 8, rng)), strict=True):
            recogniser.reset()
            recogniser.update_many(k, l1, l3)
            leader, posterior = recogniser.ranked()[0]
            claimed.append(posterior)
            right.append(leader == name)
    assert np.mean(right) == pytest.approx(np.mean(claimed), abs=0.05)


def both(moments, tables):
    return GaussianRecogniser(moments), LineRecogniser(tables)


def test_both_have_the_same_face(moments, tables, six, rng):
    k, l1, l3 = simulate_lines(six["tower"], 40, rng)
    for recogniser in both(moments, tables):
        assert isinstance(recogniser, Recogniser)
        assert recogniser.names == SIX
        assert recogniser.n == 0
        assert_allclose(list(recogniser.posterior().values()), 1 / 6)
        for line in zip(k, l1, l3, strict=True):
            recogniser.update(*line)
        recogniser.update(0, 0.0, 0.0)
        assert recogniser.n == 40
        one_by_one = recogniser.posterior()
        assert sum(one_by_one.values()) == pytest.approx(1)
        ranked = recogniser.ranked()
        assert ranked[0] == ("tower", max(one_by_one.values()))
        assert [p for _, p in ranked] == sorted(one_by_one.values(), reverse=True)
        recogniser.reset()
        recogniser.update_many(k, l1, l3)
        assert recogniser.posterior() == pytest.approx(one_by_one)


def test_no_gaussian_posterior_from_a_handful_of_lines(moments, six, rng):
    recogniser = GaussianRecogniser(moments)
    k, l1, l3 = simulate_lines(six["circle"], FIRST_POSTERIOR_N, rng)
    recogniser.update_many(k[:-1], l1[:-1], l3[:-1])
    assert_allclose(list(recogniser.posterior().values()), 1 / 6)
    recogniser.update(k[-1], l1[-1], l3[-1])
    assert max(recogniser.posterior().values()) > 0.5


def test_gaussian_likelihood_is_the_normal_density(moments):
    recogniser = GaussianRecogniser(moments)
    area, perimeter, n = 420.0, 100.0, 40
    density = {}
    for name, m in moments.items():
        c = m.covariance / np.outer(m.mean, m.mean) / n
        bias = np.array([c[1, 1] - c[1, 2], 3 * c[1, 1] + c[0, 2] - 2 * c[1, 2] - 2 * c[0, 1]])
        mean = np.array([m.area_cm2, m.perimeter_cm]) * (1 + bias)
        density[name] = stats.multivariate_normal(mean, m.covariance_at(n)).pdf([area, perimeter])
    total = sum(density.values())
    assert recogniser.posterior_at(area, perimeter, n) == pytest.approx({k: v / total for k, v in density.items()})


def test_nothing_over_or_underflows(moments, tables):
    far = GaussianRecogniser(moments).posterior_at(1e6, 1e5, 1e9)
    assert sum(far.values()) == pytest.approx(1)
    recogniser = LineRecogniser(tables)
    recogniser.update_many(np.full(10_000, 40), np.full(10_000, 1e4), np.full(10_000, 1e14))
    recogniser.update(1, 1e-12, 0.0)
    assert all(np.isfinite(p) for p in recogniser.posterior().values())
    assert np.isfinite(tables.log_probability).all()


def test_misfit_tells_a_shape_that_is_in_no_entry(moments):
    recogniser = GaussianRecogniser(moments)
    m = moments["square"]
    known = recogniser.misfit(m.area_cm2, m.perimeter_cm, 500)
    assert known["square"] < 1 < known["circle"]
    assert min(recogniser.misfit(2000.0, 100.0, 500).values()) > 14


def test_a_line_that_no_entry_explains_moves_nobody_far(tables):
    recogniser = LineRecogniser(tables)
    recogniser.update(8, 1.0, 900.0)
    assert max(recogniser.posterior().values()) < 0.9
    # No single line, however foreign to an entry, rules it out: 0.98/(0.02/2/6) to one at the very most.
    assert np.ptp(tables.log_probability, axis=0).max() < np.log(600)


def test_priors_and_weights(moments, tables, six, rng):
    prior = dict.fromkeys(SIX, 1.0) | {"statue": 5.0}
    for recogniser in (GaussianRecogniser(moments, prior=prior), LineRecogniser(tables, prior=prior)):
        assert recogniser.posterior()["statue"] == pytest.approx(0.5)
    lines = simulate_lines(six["square"], 10, rng)
    full, half = LineRecogniser(tables), LineRecogniser(tables, weight=0.5)
    full.update_many(*lines)
    half.update_many(*lines)
    ratio = [np.log(r.posterior()["square"] / r.posterior()["pyramid"]) for r in (full, half)]
    assert ratio[1] == pytest.approx(ratio[0] / 2)
    with pytest.raises(RequestError, match="weight"):
        LineRecogniser(tables, weight=0)
    with pytest.raises(RequestError, match="prior"):
        GaussianRecogniser(moments, prior={"circle": 1.0})
    with pytest.raises(RequestError, match="empty"):
        learn_tables({}, rng)


def test_equal_weights_are_no_weights(moments, tables, six, rng):
    k, l1, l3 = simulate_lines(six["tower"], 30, rng)
    for c in (1e-3, 7.0):
        for plain, weighted in zip(both(moments, tables), both(moments, tables), strict=True):
            plain.update_many(k, l1, l3)
            weighted.update_many(k, l1, l3, c)
            assert weighted.posterior() == pytest.approx(plain.posterior())
            one_by_one = type(plain)(moments if isinstance(plain, GaussianRecogniser) else tables)
            for line in zip(k, l1, l3, strict=True):
                one_by_one.update(*line, weight=c)
            assert one_by_one.posterior() == pytest.approx(plain.posterior())
            assert one_by_one.n == weighted.n == plain.n == 30


def test_unequal_weights_count_as_kishs_number_of_lines(moments, tables, six, rng):
    """(Σw)²/Σw² lines of the weighted mean, in both recognisers; by their formulas, from the lines."""
    k, l1, l3 = simulate_lines(six["tower"], 40, rng)
    w = rng.uniform(0.1, 3.0, 40)
    kish = w.sum() ** 2 / (w**2).sum()
    assert kish < 35
    gaussian, lines = both(moments, tables)
    for recogniser in (gaussian, lines):
        recogniser.update_many(k, l1, l3, w)
        recogniser.update(0, 0.0, 0.0, 50.0)  # one that met nothing is nothing, whatever it weighs
        assert recogniser.n == 40
    mean_k, mean_1, mean_3 = np.average(np.column_stack([k, l1, l3]), axis=0, weights=w)
    area = np.pi / 3 * mean_3 / mean_1
    at = gaussian.posterior_at(area, np.pi * area * mean_k / mean_1, kish)
    assert gaussian.posterior() == pytest.approx(at)
    log = kish * np.average(tables.look_up(k, l1, l3), axis=0, weights=w)
    wanted = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    assert list(lines.posterior().values()) == pytest.approx(wanted.tolist())
    # and they tell less than as many lines of one weight
    plain = LineRecogniser(tables)
    plain.update_many(k, l1, l3)
    assert Weights().effective_lines == 0
    weights = Weights()
    weights.take(w[:15])
    for one in w[15:]:
        weights.take(one)
    assert weights.effective_lines == pytest.approx(kish)


def test_a_reset_forgets_the_weights_too(moments, tables, six, rng):
    k, l1, l3 = simulate_lines(six["tower"], 20, rng)
    for recogniser in both(moments, tables):
        recogniser.update_many(k, l1, l3, rng.uniform(1, 9, 20))
        recogniser.reset()
        recogniser.update_many(k, l1, l3)
        fresh = type(recogniser)(moments if isinstance(recogniser, GaussianRecogniser) else tables)
        fresh.update_many(k, l1, l3)
        assert recogniser.posterior() == pytest.approx(fresh.posterior())


def test_lines_drawn_by_their_length_are_put_right_by_their_weights(six, tables, moments):
    """Lines through random points of the shape come with a density proportional to 𝓛_1, and weigh 1/𝓛_1."""
    rng = np.random.default_rng(77)
    right, claimed, size = {}, {}, {}
    for how in ("weighted", "not"):
        right[how], claimed[how], size[how] = 0, [], []
    for name, geometry in six.items():
        k, l1, l3 = lines_through(geometry, *random_lines(rng, 6000))
        chance = np.maximum(l1, 1.0)  # so that no weight is beyond all measure
        for _ in range(20):
            drawn = rng.choice(len(k), 60, p=chance / chance.sum())
            for how, weight in (("weighted", 1 / chance[drawn]), ("not", np.ones(60))):
                recogniser = LineRecogniser(tables)
                recogniser.update_many(k[drawn], l1[drawn], l3[drawn], weight)
                right[how] += recogniser.ranked()[0][0] == name
                claimed[how].append(recogniser.posterior()[name])
                size[how].append(np.average(l3[drawn], weights=weight) / np.average(l1[drawn], weights=weight))
                size[how][-1] *= np.pi / 3 / moments[name].area_cm2
    assert right["weighted"] >= 0.95 * 120
    assert right["not"] <= right["weighted"]
    assert np.mean(claimed["not"]) < np.mean(claimed["weighted"])
    assert np.mean(size["weighted"]) == pytest.approx(1, abs=0.05)
    assert np.mean(size["not"]) > 1.2


def random_lines(rng, n):
    """Normal angle and distance of n lines over a disc that holds every shape of these tests."""
    return rng.uniform(0, np.pi, n), rng.uniform(-60, 60, n)


def lines_through(geometry, theta, p):
    """(k, 𝓛_1, 𝓛_3) of those of given lines that cross, by shapely and by the definition: no code of the subject."""
    along = np.stack([-np.sin(theta), np.cos(theta)], axis=1)
    foot = p[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=1)
    cuts = shapely.intersection(shapely.linestrings(np.stack([foot - 90 * along, foot + 90 * along], axis=1)), geometry)
    found = []
    for cut, step in zip(cuts, along, strict=True):
        parts = [part for part in shapely.get_parts(cut) if part.length > 0]
        s_cm = np.sort([shapely.get_coordinates(part) @ step for part in parts], axis=None)
        sign = np.where(np.arange(s_cm.size) % 2 == 0, 1, -1)
        apart = np.abs(s_cm[:, None] - s_cm)
        unlike = -np.outer(sign, sign)
        if parts:
            found.append((len(parts), (unlike * apart).sum() / 2, (unlike * apart**3).sum() / 2))
    k, l1, l3 = np.array(found).T
    return k.astype(int), l1, l3


def test_shapes_of_one_area_and_perimeter_differ_line_by_line(rng):
    # The same pieces set apart differently: (A, P) are equal, the lines are not.
    ell = box(0, 0, 20, 6).union(box(0, 0, 6, 20))
    tee = box(0, 0, 20, 6).union(box(7, 0, 13, 20))
    assert ell.area == tee.area
    assert ell.length == tee.length
    entries = {"ell": ell, "tee": tee}
    recogniser = LineRecogniser(learn_tables(entries, rng))
    assert min(share_right(recogniser, entries, 300, 40, rng).values()) >= 0.9


def test_twins_are_one_class(six, rng):
    """A mirrored tower and the tower share one table, are as probable as each other and lead together."""
    entries = {"rewot": affinity.scale(affinity.skew(six["tower"], 10), -1, 1), "square": six["square"]}
    entries["tower"] = affinity.skew(six["tower"], 10)
    classes = congruence_classes(entries)
    assert classes == [("rewot", "tower"), ("square",)]
    seen = {name: simulate_lines(geometry, 20_000, rng) for name, geometry in entries.items()}
    moments = {name: exact_moments(geometry) for name, geometry in entries.items()}
    for recogniser in (LineRecogniser(tables_of(seen, classes)), GaussianRecogniser(moments, classes=classes)):
        assert recogniser.classes == (("rewot", "tower"), ("square",))
        recogniser.update_many(*simulate_lines(entries["tower"], 150, rng))
        posterior = recogniser.posterior()
        assert posterior["tower"] == pytest.approx(posterior["rewot"], rel=1e-6) == pytest.approx(0.5, abs=0.02)
        assert recogniser.ranked()[0] == ("rewot", pytest.approx(1, abs=0.02))
        assert len(recogniser.ranked()) == 2
        assert recogniser.unknown() < 0.5
    with pytest.raises(RequestError, match="stranger"):
        tables_of(seen, [("tower", "stranger")])


def test_twins_are_found_among_many():
    """Each of forty polygons has one copy, turned and mirrored, among near copies that are none."""
    rng = np.random.default_rng(8)
    entries = {}
    for number in range(40):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 7))
        polygon = shapely.convex_hull(shapely.MultiPoint(20 * np.column_stack([np.cos(angle), np.sin(angle)])))
        entries[f"one {number}"] = polygon
        entries[f"near {number}"] = affinity.scale(polygon, 1.02, 1.02)
        entries[f"other {number}"] = affinity.rotate(affinity.scale(polygon, -1, 1), rng.uniform(0, 360))
    found = [members for members in congruence_classes(entries) if len(members) > 1]
    assert found == [(f"one {number}", f"other {number}") for number in range(40)]
    assert congruence_classes({}) == []


@pytest.mark.slow
def test_half_as_many_lines_with_every_sensor(six, sensed_tables, rng):
    assert min(share_right(LineRecogniser(sensed_tables), six, 40, 1000, rng, SENSOR).values()) >= 0.95
