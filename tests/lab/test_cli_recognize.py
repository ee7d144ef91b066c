import json

import numpy as np
import pytest

from lab.cli.main import main


@pytest.fixture
def told(capsys):
    def run(*argv):
        code = main([str(word) for word in argv])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def test_none_of_these_is_told_beside_the_posterior(told, square_session):
    code, out, _ = told("recognize", square_session.folder, "--json")
    found = json.loads(out)
    assert code == 0
    assert len(found["unknown"]) == len(found["n"])
    assert found["unknown"][-1] < 0.5
    assert found["answer"] == ["square"]
    assert found["classes"] == []
    assert np.sum(list(found["posterior"].values()), axis=0) == pytest.approx(np.ones(len(found["n"])))


def test_in_a_collection_without_it_a_square_is_unknown(told, square_session):
    code, out, _ = told("recognize", square_session.folder, "--dictionary", "letters")
    assert code == 0
    assert "none of these" in out.splitlines()[-1]


def test_two_sessions_are_read_as_letters(told, square_session):
    code, out, _ = told("recognize", square_session.folder, square_session.folder, "--word", "NO", "--json")
    found = json.loads(out)
    assert code == 0
    assert len(found["text"]) == len(found["letters"]) == 2
    assert all(letter["answer"] == [] for letter in found["letters"])


@pytest.mark.parametrize(
    ("options", "said"), [(["--dictionary", "runes"], "no collection"), (["--word", "NO"], "several sessions")]
)
def test_requests_that_cannot_be(told, square_session, options, said):
    code, _, err = told("recognize", square_session.folder, *options)
    assert code == 2
    assert said in err


@pytest.mark.slow
def test_a_word_letter_by_letter_from_one_command(told, tmp_path):
    code, out, err = told(
        *("run", "--simulate", "--shape", "text:IO", "--letters", "--no-video"),
        *("--lines", "25", "--seed", "3", "--out", tmp_path, "--json"),
    )
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert found["text"] == "IO"
    assert [letter["answer"] for letter in found["letters"]] == [["text:I"], ["text:O"]]
    assert found["lines"] == [25, 25]
    assert len(list((tmp_path / "IO").iterdir())) == 2


def test_letters_are_for_words(told):
    code, _, err = told("run", "--simulate", "--shape", "eiffel", "--letters", "--no-video")
    assert code == 2
    assert "for a word" in err


@pytest.mark.slow
def test_both_ways_to_read_a_word(told, full):
    if not full:
        pytest.skip("run with --full")
    code, out, _ = told("shapes", "reading", "NO", "--lines", "100", "--json")
    found = json.loads(out)
    assert code == 0
    assert [letter["lines"] for letter in found["letters"]] == [50, 50]
    as_word = found["strategies"]["as_word"]
    assert as_word == sorted(as_word)
    assert found["strategies"]["by_letters"] > 10
    code, _, err = told("shapes", "reading", "no")
    assert code == 2
    assert "none of the letters" in err
