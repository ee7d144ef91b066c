"""The median by a sorting network is the median."""

import numpy as np
import pytest

from tracking.median import median_network, median_of


@pytest.mark.parametrize("count", [*range(1, 18), 31, 40])
def test_it_is_the_middle_of_the_sorted_values(count):
    rng = np.random.default_rng(count)
    # Few levels make ties; odd sizes do not fill a band.
    planes = [rng.integers(0, 256 if count % 2 else 4, (301, 257), dtype=np.uint8) for _ in range(count)]
    before = [plane.copy() for plane in planes]
    assert np.array_equal(median_of(planes), np.sort(np.stack(planes), axis=0)[count // 2])
    assert all(np.array_equal(plane, old) for plane, old in zip(planes, before, strict=True))


@pytest.mark.parametrize("count", range(1, 12))
def test_the_network_finds_the_middle_of_every_pattern_of_zeros_and_ones(count):
    """By the 0-1 principle it then does so of any values."""
    patterns = (np.arange(2**count)[:, None] >> np.arange(count)) & 1
    values = patterns.copy()
    for i, j, low, high in median_network(count):
        least, most = np.minimum(values[:, i], values[:, j]), np.maximum(values[:, i], values[:, j])
        values[:, i], values[:, j] = (least if low else -1), (most if high else -1)
    assert np.array_equal(values[:, count // 2], np.sort(patterns, axis=1)[:, count // 2])


def test_views_with_padded_lines_do_as_well():
    padded = np.random.default_rng(1).integers(0, 256, (5, 40, 64), dtype=np.uint8)
    planes = [plane[:, :50] for plane in padded]
    assert np.array_equal(median_of(planes), np.median(np.stack(planes), axis=0))
