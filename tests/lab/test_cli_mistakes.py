"""Every command, whatever is typed wrongly: one line on stderr, the right exit code, and never a traceback.

The commands and their parameters are those of the application itself, so that new ones are tried too.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from lab.base.errors import ChordlabError
from lab.cli import main as commands_of
from lab.cli.main import main
from tests.lab.test_cli import commands

CHORDLAB = f"{sys.executable} -c 'from lab.cli.main import entry; entry()'"
# What is required beside the parameter that is tried.
REQUIRED = {"SHAPE": "square", "NAME": "virtual", "WORD": "HI", "FILE": "text:HI"}
BESIDE = {"project": ["--projector", "image:pictures"], "doctor": ["--bundle"]}
FOR_A_FONT = {"shapes list": ["--collection", "letters"], "figures": ["--only", "3A"]}
WRITTEN = ("out", "preview", "make_board")


def kind(parameter) -> str:
    return str(parameter.type_descriptor.annotation)


def is_path(parameter) -> bool:
    return parameter.metavar in ("SHAPE", "[SHAPE]...", "FILE") or "Path" in kind(parameter)


def is_written(words, parameter) -> bool:
    return parameter.name in WRITTEN or (words, parameter.name) == (["doctor"], "file")


def is_number(parameter) -> bool:
    return any(number in kind(parameter) for number in ("int", "float"))


def tried(wanted):
    """The parameters of all commands that are so."""
    return [
        pytest.param(words, command, parameter, id=f"{' '.join(words)} {parameter.name}")
        for words, command in commands()
        for parameter in command.params
        if wanted(words, parameter)
    ]


READ = tried(lambda words, parameter: is_path(parameter) and not is_written(words, parameter))
NUMBERS = tried(lambda _, parameter: is_number(parameter))


def line_with(words, command, parameter, value) -> list[str]:
    """What one types to give one parameter this value, and what is required beside it."""
    line, name = [*words], " ".join(words)
    for other in command.params:
        if other is parameter and parameter.param_type_name == "argument":
            line.append(str(value))
        elif other.metavar in ("SHAPE", "[SHAPE]...") and parameter.name == "font":
            line.append("text:HI")
        elif other.param_type_name == "argument" and other.required:
            line.append(REQUIRED.get(other.metavar, "nowhere"))
    line += [] if parameter.param_type_name == "argument" else [parameter.opts[0], str(value)]
    return [*line, *BESIDE.get(name, []), *(FOR_A_FONT.get(name, []) if parameter.name == "font" else [])]


@pytest.fixture
def told(capsys, tmp_path, monkeypatch):
    """Type what cannot be done; give the one line of error."""
    monkeypatch.chdir(tmp_path)

    def type_in(line, codes=(2,)) -> str:
        code = main([str(word) for word in line])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        assert "fault of chordlab" not in err, err
        assert code in codes, (line, code, err)
        assert out == ""
        (error,) = [row for row in err.splitlines() if row.startswith("error: ")]
        return error

    return type_in


@pytest.mark.parametrize(("words", "command", "parameter"), READ)
def test_what_is_missing_is_named(words, command, parameter, told):
    assert "nowhere" in told(line_with(words, command, parameter, "nowhere.toml"))


@pytest.mark.parametrize(("words", "command", "parameter"), READ)
def test_a_strange_folder_and_a_file_of_garbage_are_refused(words, command, parameter, told, tmp_path):
    folder, garbage = tmp_path / "strange.svg", tmp_path / "garbage.svg"
    folder.mkdir()
    garbage.write_bytes(bytes(range(256)) * 8)
    for given in (folder, garbage):
        assert given.stem in told(line_with(words, command, parameter, given), codes=(1, 2))


@pytest.mark.parametrize(("words", "command", "parameter"), NUMBERS)
def test_a_number_out_of_range_is_named(words, command, parameter, told):
    option = parameter.opts[0]
    for value in ("many", "-1000000000"):
        error = told([*line_with(words, command, parameter, value), *ROLLED.get(" ".join(words), [])])
        assert option in error or option.strip("-").replace("-", "_") in error or value in error, error


ROLLED = {"run": ["--simulate", "--no-video"]}


@pytest.mark.parametrize(("words", "command"), [pytest.param(*one, id=" ".join(one[0])) for one in commands()])
def test_an_unknown_option_is_named_with_the_help_of_its_command(words, command, told):
    error = told([*words, "--frobnicate"])
    assert "--frobnicate" in error
    assert f"See chordlab {' '.join(words)} --help." in error


STORED = Path(__file__).parents[2] / "data/sessions/triangle-uniform"
SESSION = "{session}"
FILE = "{file}/under"  # no folder: a file stands where it would be
UNWRITABLE = {
    ("validate", "out"): f"validate {SESSION} --out {FILE}",
    ("run", "out"): f"run --simulate --no-video --lines 2 --out {FILE}",
    ("finalize", "out"): f"finalize {SESSION} --from-light --out {FILE}",
    ("batch", "out"): f"batch {SESSION} --out {FILE}",
    ("figures", "out"): f"figures --only 3A --out {FILE}",
    ("classes", "out"): f"classes {SESSION} --lines 10 --out {FILE}.svg",
    ("track", "out"): f"track nowhere.mkv --out {FILE}.csv",
    ("track", "preview"): f"track nowhere.mkv --preview {FILE}.mkv",
    ("export", "out"): f"export {SESSION} --to csv --out {FILE}",
    ("doctor", "file"): f"doctor --bundle {FILE}.zip",
    ("doctor", "out"): None,  # nothing is written: it is looked at
    ("shapes show", "out"): f"shapes show square --out {FILE}.png",
    ("shapes import", "out"): f"shapes import text:HI --name hi --out {FILE}.geojson",
    ("shapes separability", "out"): f"shapes separability square circle --lines 5 --out {FILE}.png",
    ("calibrate camera", "out"): f"calibrate camera --out {FILE}.json",
    ("calibrate camera", "make_board"): f"calibrate camera --make-board {FILE}.pdf",
    ("calibrate projector", "out"): f"calibrate projector --out {FILE}.json",
    ("calibrate robot", "out"): f"calibrate robot --runs 4 --out {FILE}.toml",
    ("robot characterise", "out"): f"robot characterise virtual --out {FILE}.toml",
}


def test_every_output_is_tried():
    assert set(UNWRITABLE) == {
        (" ".join(words), parameter.name)
        for words, command in commands()
        for parameter in command.params
        if is_written(words, parameter)
    }


@pytest.mark.parametrize("line", [line for line in UNWRITABLE.values() if line])
def test_what_cannot_be_written_is_named(line, told, tmp_path):
    file = tmp_path / "file"
    file.touch()
    words = [word.format(session=STORED, file=file) for word in line.split()]
    assert "file" in told(words)


def typed(line: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell")
@pytest.mark.parametrize("command", ["shapes list", "shapes list --json"])
def test_a_reader_that_leaves_ends_it_in_silence(command):
    assert typed(f"{{ {CHORDLAB} {command}; echo $? >&2; }} | true").stderr == "1\n"


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/full is Linux's")
def test_a_stdout_that_is_closed_or_full_is_told_in_one_line():
    closed = typed(f"{CHORDLAB} --help >&-")
    assert (closed.returncode, closed.stderr.count("\n")) == (2, 1)
    assert closed.stderr.startswith("error: stdout is closed")
    for command in ("shapes list", "shapes list --json"):
        full = typed(f"{CHORDLAB} {command} >/dev/full")
        assert (full.returncode, full.stderr.count("\n")) == (1, 1)
        assert full.stderr.startswith("error: No space left on device; make room")


@pytest.fixture
def with_fault(monkeypatch):
    """Give the application a command that raises what one hands it."""

    def make(error: Exception) -> None:
        app = typer.Typer()

        @app.command("one")
        def one() -> None:
            raise error

        app.callback()(lambda: None)
        monkeypatch.setattr(commands_of, "app", app)

    return make


def test_a_fault_of_ours_says_how_to_report_it(with_fault, capsys, monkeypatch):
    with_fault(ZeroDivisionError("of an area\nthat is none"))
    monkeypatch.delenv("CHORDLAB_DEBUG", raising=False)
    assert main(["one"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: a fault of chordlab itself, ZeroDivisionError at test_cli_mistakes.py:")
    assert "of an area that is none" in line
    assert "chordlab doctor --bundle" in line
    monkeypatch.setenv("CHORDLAB_DEBUG", "1")
    assert main(["one"]) == 1
    assert "Traceback (most recent call last)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (PermissionError(13, "Permission denied", "tower.svg"), 2, "error: tower.svg: Permission denied; name another"),
        (OSError(28, "No space left on device", "x.csv"), 2, "error: x.csv: No space left on device; make room"),
        (ChordlabError("the robot rolled away"), 1, "error: the robot rolled away"),
    ],
)
def test_what_the_system_will_not_do_is_one_line_with_a_cure(with_fault, capsys, error, code, says):
    with_fault(error)
    assert main(["one"]) == code
    assert capsys.readouterr().err.startswith(says)


def test_a_long_path_stays_in_one_piece(told, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    path = tmp_path / ("a_folder_of_a_long_name_" * 5)
    error = told(["moments", f"{path}.svg"])
    assert str(path) in error
    assert "\x1b" not in error


@pytest.mark.skipif(shutil.which("script") is None, reason="`script` gives a terminal")
@pytest.mark.parametrize("no_colour", [{}, {"NO_COLOR": "1"}], ids=str)
def test_errors_are_coloured_on_a_terminal_unless_one_says_no(no_colour):
    env = {name: value for name, value in os.environ.items() if name != "NO_COLOR"} | {"TERM": "xterm"} | no_colour
    line = ["script", "-qec", f"{CHORDLAB} --frob", "/dev/null"]
    shown = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False, env=env).stdout
    assert "error:" in shown
    assert ("\x1b[1;31m" in shown) == (not no_colour)
