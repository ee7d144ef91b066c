"""Completion, asked of the shells themselves, and how little of chordlab it loads."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = ("numpy", "scipy", "pandas", "cv2", "matplotlib", "numba", "shapely", "pydantic", "av", "bumble", "rich")
PROGRAM = f'#!/bin/sh\nexec {sys.executable} -c "from lab.cli.main import entry; entry()" "$@"\n'


@pytest.fixture
def bench(tmp_path, monkeypatch) -> Path:
    """A folder with sessions, settings and a drawing, and `chordlab` on the path."""
    for name in (
        "sessions/2026-11-23T1042_eiffel_ab12",
        "sessions/2026-11-24T0900_square_cd34",
        "sessions/none",
        "own",
    ):
        (tmp_path / name).mkdir(parents=True)
        if not name.endswith("none"):
            (tmp_path / name / "manifest.json").write_text("{}")
    for name in ("bench.toml", "elk.svg", "elk.txt"):
        (tmp_path / name).touch()
    program = tmp_path / "bin" / "chordlab"
    program.parent.mkdir()
    program.write_text(PROGRAM)
    program.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    return tmp_path


def asked(shell: str, script: str) -> list[str]:
    done = subprocess.run([shell, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.split("\n")[:-1]


def offered(line: str) -> list[str]:
    """What bash offers where the line ends, through what `--show-completion bash` tells it to do."""
    words = line.split(" ")
    return asked(
        "bash",
        f"""
        source <(_CHORDLAB_COMPLETE=source_bash chordlab)
        COMP_WORDS=({" ".join(f"'{word}'" for word in words)}); COMP_CWORD={len(words) - 1}
        [[ $(complete -p chordlab) == *"-F _chordlab_completion chordlab" ]] || exit 1
        _chordlab_completion chordlab
        printf '%s\\n' "${{COMPREPLY[@]}}"
        """,
    )


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is asked")
@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("chordlab re", ["recognize", "recover"]),
        ("chordlab shapes li", ["list"]),
        ("chordlab batch --qu", ["--quiet"]),
        ("chordlab moments eif", ["eiffel"]),
        ("chordlab moments elk", ["elk.svg"]),
        ("chordlab plan circle sq", ["square"]),
        ("chordlab run --shape chi", ["chichen_itza"]),
        ("chordlab run --robot o", ["onboard:virtual"]),
        ("chordlab run b", ["bench.toml"]),
        ("chordlab shapes list --collection mon", ["monuments"]),
        ("chordlab simulate square --turning uni", ["uniform", "uniform-weighted"]),
        ("chordlab validate ", ["sessions/2026-11-24T0900_square_cd34", "sessions/2026-11-23T1042_eiffel_ab12", "own"]),
        ("chordlab recover sessions/2026-11-23", ["sessions/2026-11-23T1042_eiffel_ab12"]),
        ("chordlab validate nothing", [""]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_bash_is_offered_what_could_stand_there(bench, line, values):
    assert offered(line) == values


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_other_shells_are_told_what_to_do(bench, shell):
    """They are on few machines: what they would source, and what it then asks of us."""
    program = str(bench / "bin/chordlab")
    script = subprocess.check_output([program], env={**os.environ, "_CHORDLAB_COMPLETE": f"source_{shell}"}, text=True)
    assert f"_CHORDLAB_COMPLETE=complete_{shell}" in script
    env = {"_CHORDLAB_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_ARGS": "chordlab shapes li"}
    env["_TYPER_COMPLETE_FISH_ACTION"] = "get-args"
    assert "list" in subprocess.check_output([program], env={**os.environ, **env}, text=True)
    if shutil.which(shell):
        path = bench / "completion"
        path.write_text(script)
        asked(shell, f"source {path}" if shell == "fish" else f"autoload -U compinit; compinit -u; source {path}")


def test_help_and_completion_load_nothing_heavy():
    """So they answer within half a second; every command loads what it works with when it runs."""
    code = f"import sys, lab.cli.main; print(*(name for name in {HEAVY} if name in sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == ""
