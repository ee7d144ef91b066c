import numpy as np
import pytest

from analysis.smoothing import smooth_alike, smooth_table


def ridges(rng, entries):
    """Tables of one pattern of teeth, each tilted a little its own way."""
    teeth = np.tile(np.where(np.arange(96) % 5 == 0, 8.0, 1.0)[:, None], (1, 48))
    place = np.linspace(-1, 1, 96)[:, None]
    tables = np.zeros((entries, 2, 96, 48))
    for table, tilt in zip(tables, np.linspace(-0.15, 0.15, entries), strict=True):
        table[1] = teeth * np.exp(tilt * place)
        table[0, :, :1] = 20 * np.exp(tilt * place)
    return tables / tables.sum(axis=(1, 2, 3), keepdims=True)


def test_a_table_is_a_probability(rng):
    counts = rng.poisson(2.0, (3, 96, 48)).astype(float)
    counts[0, :, 1:] = 0
    assert smooth_table(counts).sum() == pytest.approx(1)
    assert smooth_table(np.zeros((3, 96, 48))).sum() == pytest.approx(1)
    for table in smooth_alike([counts, counts[:, ::-1]]):
        assert table.sum() == pytest.approx(1)
        assert (table >= 0).all()


def test_near_twins_differ_by_no_more_than_they_do(rng):
    """Smoothed together, the log-ratio that tells them apart is three times nearer to the truth."""
    truth = ridges(rng, 2)
    counts = [rng.multinomial(40_000, table.ravel()).reshape(table.shape).astype(float) for table in truth]
    inside = truth[0] > 0
    wanted = np.log(truth[0][inside] / truth[1][inside])

    def error(tables):
        ratio = np.log(np.maximum(tables[0][inside], 1e-9) / np.maximum(tables[1][inside], 1e-9))
        return np.sqrt(np.average((ratio - wanted) ** 2, weights=truth[0][inside]))

    alone, together = error([smooth_table(one) for one in counts]), error(smooth_alike(counts))
    assert together < alone / 3


def test_what_one_of_them_never_does_stays_unlikely():
    one, other = np.zeros((2, 96, 48)), np.zeros((2, 96, 48))
    one[0, 10:60, 0], other[0, 10:60, 0] = 400.0, 400.0
    other[1, 30:60, 10:30] = 20.0
    first, second = smooth_alike([one, other])
    assert first[1].sum() < 0.35 * second[1].sum()
