import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.confusion import LineConfusion
from analysis.quadrature import exact_moments
from analysis.reading import (
    SLIP,
    STRANGE_WORD,
    compare_strategies,
    lines_in_a_dictionary_of,
    measured_both_ways,
    read_word,
)
from lab.base.errors import RequestError

ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def sure_of(letter, share=0.97):
    rest = (1 - share) / (len(ALPHABET) - 1)
    return {other: share if other == letter else rest for other in ALPHABET}


def test_a_word_is_read_from_its_letters():
    found = read_word([sure_of(letter) for letter in "FREEDOM"], ["FREEDOM", "NATIONS", "PEACE"])
    assert (found.text, found.word) == ("FREEDOM", "FREEDOM")
    assert found.probability > 0.999
    assert [word for word, _ in found.words] == ["FREEDOM", "NATIONS"]  # one of another length is no candidate


def test_the_list_makes_good_a_letter_misread():
    letters = [sure_of(letter) for letter in "FREEDQM"]
    found = read_word(letters, ["FREEDOM", "NATIONS"])
    assert (found.text, found.word) == ("FREEDQM", "FREEDOM")
    # three more, and the letters themselves are believed
    found = read_word([sure_of(letter, 0.999) for letter in "FRXXXQM"], ["FREEDOM", "NATIONS"])
    assert found.word is None
    assert found.probability > 0.9


def test_posterior_over_words_is_the_product_over_letters():
    """By hand, with two letters and two words."""
    letters = [{"A": 0.8, "B": 0.2}, {"A": 0.4, "B": 0.6}]
    found = read_word(letters, ["AB", "BA"], {"AB": 3.0, "BA": 1.0})

    def place(p):
        return (1 - SLIP) * 2 * p + SLIP

    ab = (1 - STRANGE_WORD) * 0.75 * place(0.8) * place(0.6)
    ba = (1 - STRANGE_WORD) * 0.25 * place(0.2) * place(0.4)
    assert dict(found.words) == pytest.approx(
        {"AB": ab / (ab + ba + STRANGE_WORD), "BA": ba / (ab + ba + STRANGE_WORD)}
    )
    assert found.probability == dict(found.words)["AB"]


@given(st.lists(st.sampled_from(ALPHABET), min_size=1, max_size=6), st.floats(0.05, 0.999))
def test_probabilities_stay_probabilities(word, share):
    text = "".join(word)
    found = read_word([sure_of(letter, share) for letter in text], [text, text[::-1] + "X"])
    assert 0 <= sum(probability for _, probability in found.words) <= 1 + 1e-9
    assert 0 < found.probability <= 1


def test_no_word_of_that_length():
    found = read_word([sure_of("A")], ["PEACE"])
    assert (found.text, found.word, found.words) == ("A", None, ())


@pytest.mark.parametrize(
    ("letters", "words", "said"),
    [([], {"A": 1.0}, "one session"), ([{}], {"A": 1.0}, "one session"), ([{"A": 1.0}], {"A": 0.0}, "above 0")],
)
def test_what_cannot_be_read_is_refused(letters, words, said):
    with pytest.raises(RequestError, match=said):
        read_word(letters, words, words)


def test_a_word_and_its_letters_measured(shapes):
    word, *letters = (exact_moments(shapes[name]) for name in ("two discs", "circle", "square"))
    whole, apart = measured_both_ways(word, [("C", letters[0]), ("S", letters[1])], 100, name="CS")
    assert (whole.name, whole.lines, [one.lines for one in apart]) == ("CS", 100, [50, 50])
    assert whole.area_cm2 == pytest.approx(shapes["two discs"].area, rel=1e-4)
    assert apart[1].perimeter_cm == pytest.approx(96, rel=1e-4)
    # the square's known scatter for one line
    assert apart[1].sigma_area_cm2 == pytest.approx(576 * 0.39278 / np.sqrt(50), rel=1e-3)
    assert apart[1].sigma_perimeter_cm == pytest.approx(96 * 0.33730 / np.sqrt(50), rel=1e-3)
    with pytest.raises(RequestError, match="too few"):
        measured_both_ways(word, [("C", letters[0]), ("S", letters[1])], 1, name="CS")


def alike(rate, entries=5):
    """Entries that are all equally far from each other."""
    off = 1 - np.eye(entries)
    return LineConfusion(rate * off, 2 * rate * off, 100_000, off.astype(bool))


def test_more_words_take_more_lines_as_an_extreme_of_normals_does():
    from scipy.stats import norm

    confusion = alike(0.02)
    lines = [lines_in_a_dictionary_of(confusion, 0, size) for size in (2, 10, 1000)]
    wanted = [(norm.isf(0.05 / (size - 1))) ** 2 * 2 / 0.02 for size in (2, 10, 1000)]
    assert lines == pytest.approx(wanted, rel=0.01)
    assert lines_in_a_dictionary_of(confusion, 0, 1) == 10
    assert lines_in_a_dictionary_of(alike(0.0), 0, 5) is None
    with pytest.raises(RequestError, match="two words"):
        lines_in_a_dictionary_of(alike(0.1, 1), 0, 3)


def test_where_the_two_ways_meet():
    confusion = alike(0.02)
    found = compare_strategies(
        [200, 300, 400], lambda size: lines_in_a_dictionary_of(confusion, 0, size), (2, 10, 100, 1000, 10**6)
    )
    assert found.by_letters == 900
    assert found.crossover == 100
    assert list(found.as_word) == sorted(found.as_word)
    assert compare_strategies([20, None], lambda size: size, (2, 3)).crossover is None
    assert compare_strategies([5, 5], lambda size: None, (2, 3)).crossover == 2
