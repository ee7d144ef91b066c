"""What a line costs a live session, against the time until the robot brings the next (seconds)."""

import numpy as np
import pytest

from analysis.perline import LineRecogniser, tables_of


@pytest.fixture(scope="module", params=[6, 212, 300])
def recogniser(request):
    rng = np.random.default_rng(1)
    seen = {}
    for entry in range(request.param):
        length = rng.gamma(4, rng.uniform(3, 12), 5000)
        k = rng.integers(1, 6, 5000)
        seen[f"entry {entry}"] = (k, length, np.where(k == 1, length, length * rng.uniform(1, 2, 5000)) ** 3)
    return LineRecogniser(tables_of(seen), weight=0.85)


def test_a_line(benchmark, recogniser):
    benchmark.extra_info["entries"] = len(recogniser.names)
    benchmark(recogniser.update, 2, 31.0, 50_000.0)


def test_a_line_with_all_that_is_said_of_it(benchmark, recogniser):
    benchmark.extra_info["entries"] = len(recogniser.names)

    def line():
        recogniser.update(2, 31.0, 50_000.0)
        recogniser.ranked()
        recogniser.unknown()

    benchmark(line)


def test_a_stored_session(benchmark, recogniser):
    rng = np.random.default_rng(2)
    k, length = rng.integers(1, 6, 1000), rng.gamma(4, 8, 1000)
    benchmark.extra_info["lines"] = 1000
    benchmark(recogniser.update_many, k, length, length**3)
