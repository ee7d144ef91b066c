import numpy as np
import pytest
from scipy import stats

from analysis.deviation import _BENDS, FEWEST_LINES, Deviation

BINS, ENTRIES = 400, 30


def family(rng, entries=ENTRIES):
    """Tables that differ along a few smooth directions, as shapes of one kind do."""
    place = np.linspace(0, 1, BINS)
    waves = np.array([np.sin((i + 1) * np.pi * place) for i in range(6)])
    logs = rng.normal(0, 0.35, (entries, 6)) @ waves
    tables = np.exp(logs)
    return tables / tables.sum(axis=1, keepdims=True)


def drawn(table, lines, rng):
    bins, weights = np.unique(rng.choice(BINS, lines, p=table), return_counts=True)
    return bins, weights.astype(float)


@pytest.fixture(scope="module")
def tables():
    return family(np.random.default_rng(3))


def learnt(tables, entry, rng, lines=40_000):
    counts = rng.multinomial(lines, tables[entry])
    filled = np.flatnonzero(counts)
    others = np.delete(np.arange(len(tables)), entry)
    logs = np.log(tables).astype(np.float32)
    return Deviation.of(np.log(tables[entry]), logs[others].T, filled, counts[filled].astype(float))


def test_evidence_is_the_ratio_of_two_normals(tables, rng):
    """By scipy's densities, the mean's error for want of learnt lines included."""
    deviation = learnt(tables, 4, rng)
    bins, weights = drawn(tables[9], 150, rng)
    mean = weights @ deviation.score[bins] / 150
    noise = deviation.variance * (1 / 150 + 1 / deviation.learnt)
    plain = stats.norm.logpdf(mean, scale=np.sqrt(noise)).sum()
    ratios = []
    for bend in _BENDS:
        spread = 2 * bend / deviation.variance.sum() * deviation.variance**2
        ratios.append(stats.norm.logpdf(mean, scale=np.sqrt(noise + spread)).sum() - plain)
    wanted = np.log(np.mean(np.exp(ratios)))
    assert deviation.evidence(bins, weights) == pytest.approx(wanted, rel=1e-6)


def test_axes_have_no_mean_and_are_not_correlated(tables, rng):
    deviation = learnt(tables, 0, rng, 4_000_000)
    share = tables[0]
    score = deviation.score.astype(float)
    assert np.abs(share @ score).max() < 0.01
    covariance = (score * share[:, None]).T @ score
    assert np.allclose(covariance, np.diag(deviation.variance), atol=0.02 * deviation.variance[0])


def test_an_entry_is_hardly_ever_an_outsider(tables, rng):
    deviation = learnt(tables, 0, rng)
    for lines in (FEWEST_LINES, 300, 2000):
        found = [deviation.evidence(*drawn(tables[0], lines, rng)) for _ in range(300)]
        assert np.mean(np.array(found) > np.log(19)) <= 0.02
        assert np.mean(np.exp(found)) == pytest.approx(0.5, abs=0.6)  # a Bayes factor's mean is at most 1


def test_one_of_the_same_kind_is_found_out(rng):
    """Shapes that were left out, each against the entry that is nearest."""
    tables = family(np.random.default_rng(5), ENTRIES + 20)
    known = tables[:ENTRIES]
    found = []
    for stranger in tables[ENTRIES:]:
        nearest = int(np.argmin((stranger * (np.log(stranger) - np.log(known))).sum(axis=1)))
        deviation = learnt(known, nearest, rng)
        found.append(deviation.evidence(*drawn(stranger, 300, rng)) > np.log(19))
    assert np.mean(found) >= 0.8


def test_too_few_lines_say_nothing(tables, rng):
    deviation = learnt(tables, 0, rng)
    assert deviation.evidence(*drawn(tables[9], FEWEST_LINES - 1, rng)) == 0.0
