"""Numbers as the reports write them."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.report.words import (
    count,
    decimals_for,
    p_is,
    p_value,
    percent,
    plus_minus,
    probability,
    signed,
    typographic,
)


def test_words():
    assert plus_minus(687.31, 38.4, "cm²") == "687 ± 38 cm²"
    assert plus_minus(10.126, 0.034, "cm") == "10.126 ± 0.034 cm"
    assert plus_minus(10.126, math.nan, "cm") == "10.1 cm (uncertainty unknown)"
    assert signed(-0.04) == "0.0"
    assert signed(-1.26) == "−1.3"
    assert signed(math.nan) == "unknown"
    assert probability(1.0) == "more than 99.9 %"
    assert probability(0.0) == "less than 0.1 %"
    assert percent(0.345, 0) == "34 %"
    assert count(1, "line") == "1 line"
    assert count(12345, "line") == "12\u202f345 lines"
    assert p_value(0.0004) == "< 0.001"
    assert p_value(math.nan) == "unknown"


@given(st.floats(1e-4, 1e4), st.floats(-1e5, 1e5))
def test_plus_minus_loses_less_than_a_tenth_of_the_uncertainty(sigma, value):
    shown = float(plus_minus(value, sigma, "cm").split(" ±")[0].replace("−", "-"))
    assert abs(shown - value) <= max(0.051 * sigma, 0.5 * 10.0 ** -decimals_for(sigma)) * (1 + 1e-6)


@given(st.floats(0, 1))
def test_a_probability_is_never_written_as_certain(value):
    assert not re.fullmatch(r"(100\.0|0\.0) %", probability(value))


@pytest.mark.parametrize(
    ("typed", "printed"),
    [
        ("(-0.30 to 1.14)", "(−0.30 to 1.14)"),
        ("found -0.1 mm later", "found −0.1 mm later"),
        ("p = 2e-05", "p = 2·10⁻⁵"),
        ("1e+07 lines", "1·10⁷ lines"),
        ("2026-11-24T0112_eiffel", "2026-11-24T0112_eiffel"),
        ("SB-7E57 and x-2", "SB-7E57 and x-2"),
        ("--lines 40", "--lines 40"),
        ("95-99", "95-99"),
    ],
)
def test_minus_signs_and_powers_are_set_as_in_print(typed, printed):
    assert typographic(typed) == printed


def test_what_a_p_value_is():
    assert p_is(0.0341) == "p = 0.034"
    assert p_is(1e-9) == "p < 0.001"
