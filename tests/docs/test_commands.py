"""Every command that the pages show in a code block is run, or listed here with the reason why it is not."""

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.shown import HOME, PAGES, blocks_of, name_of, plainly, shown_in_blocks, shown_in_text, type_in
from tests.docs.test_json import RUN

# What is not run, by page. It is only parsed, by test_docs.
NOT_RUN = {
    "a robot, a radio, a camera or a projector is wanted": {
        "README.md": ["robot scan", "run bench.toml", "calibrate camera bench.toml", "calibrate projector bench.toml"],
        "docs/calibration.md": [
            "calibrate camera bench.toml", "calibrate projector bench.toml", "calibrate camera --board",
        ],
        "docs/howto/micropython-robot.md": ["run bench.toml"],
        "docs/howto/several-robots.md": ["run bench.toml"],
        "docs/robots.md": ["run bench.toml"],
        "docs/tutorial/first-bench-session.md": [
            "robot scan", "robot info", "robot characterise", "calibrate camera bench.toml", "calibrate projector",
            "run bench.toml", "project square", "validate sessions/2026",
        ],
    },
    "it takes minutes; its parts are tested beside the code": {
        "README.md": [
            "run --simulate --shape eiffel", "run --simulate --shape windmill", "figures --out figures",
            "run --robot virtual --robot virtual --robot virtual", "validate data/sessions/square-filmed",
        ],
        "docs/calibration.md": ["calibrate camera truth.toml"],
        "docs/figures.md": ["figures"],

        "docs/planning.md": ["plan --collection letters", "plan eiffel triangle", "classes"],
        "docs/recognition.md": [
            "run --simulate --shape text:FREEDOM", "recognize sessions/first",
            "recognize sessions/2026-11-23T1042_eiffel_ab12 --dict",
        ],
        "docs/robots.md": ["run --robot virtual --robot virtual --robot virtual", "run --robot onboard:virtual"],
        "docs/tracking.md": ["track video.mkv --robots", "track video.mkv --balls", "track one.mkv"],
        "docs/shapes.md": [
            "run --simulate --shape windmill",
            "shapes separability --collection letters", "shapes separability my_tower",
        ],
    },
    "it is paced to be followed, or serves until Ctrl-C; tests/lab opens it in a browser": {
        "docs/howto/live-page.md": ["run --simulate --no-video --shape square --lines 150", "watch"],
    },
    "it wants a cluster: see docs/howto/cluster.md, which is run with one": {"docs/batch.md": ["batch /shared"]},
}  # fmt: skip
# Commands that only running text and tables name, and that no page's code block and no `--json` of test_json runs.
NAMED_ONLY = {
    "robot scan": "a radio", "robot drive": "a radio; tests/lab drives a virtual robot",
    "robot virtual": "serves until Ctrl-C; tests/robot is its client", "robot characterise": "minutes; tests/lab",
    "calibrate robot": "minutes; tests/lab", "calibrate projector": "minutes; tests/lab",
    "figures": "minutes; tests/lab", "classes": "four sessions; tests/lab",
    "watch": "serves until Ctrl-C; tests/lab opens it in a browser",
    "shapes learn": "minutes; tests/lab", "shapes reading": "minutes; tests/lab",
}  # fmt: skip
MINUTES = {  # run with --full only
    "docs/howto/read-a-word.md": "the letters are learnt",
    "docs/howto/replay.md": "all collections are learnt",
    "docs/howto/cluster.md": "workers are started",
    "docs/tracking.md": "films are tracked",
    "docs/howto/several-robots.md": "two robots roll",
}
FILMED = "chordlab run --simulate --shape square"  # its block, and what it prints, with --full only
HAVE_A_SESSION = "chordlab run --simulate --no-video --shape square --lines 40 --seed 1"  # rolled once for all guides
NOT_OURS = ("make", ".", "mpremote")  # sets up the checkout, or a board
GUIDES = [page for page in PAGES if page.parent.name == "howto" or page.name == "first-session.md"]
OTHERS = [page for page in PAGES if page not in GUIDES and shown_in_blocks(page)]


def why_not(page: Path, line: str) -> str | None:
    for reason, pages in NOT_RUN.items():
        if any(line.startswith(f"chordlab {start}") for start in pages.get(name_of(page), [])):
            return reason
    return None


def test_what_is_not_run_is_shown():
    """The list holds nothing that no page shows any more."""
    for pages in NOT_RUN.values():
        for name, starts in pages.items():
            for start in starts:
                assert any(line.startswith(f"chordlab {start}") for line in shown_in_blocks(HOME / name)), (name, start)


def test_every_command_named_in_text_is_run_somewhere():
    """With the options of a block or of test_json; what is named only stands in a list."""
    blocks = {path_of(line) for page in PAGES for line in shown_in_blocks(page) if why_not(page, line) is None}
    run = blocks | {path_of(f"chordlab {line}") for line in RUN.values()}
    named = {path_of(line) for page in PAGES for line in shown_in_text(page)} - {"--help", "--install-completion"}
    assert named - run == set(NAMED_ONLY)


def path_of(line: str) -> str:
    """The command's own words, as `shapes list`."""
    words = line.split()[1:]
    return " ".join(words[:2] if words[0] in ("shapes", "robot", "calibrate") else words[:1])


@pytest.fixture(scope="module")
def rolled(tmp_path_factory) -> Path:
    """Where the guides' common session is kept once one of them has rolled it."""
    return tmp_path_factory.mktemp("rolled") / "sessions"


@pytest.mark.parametrize("page", GUIDES, ids=name_of)
def test_a_guide_works_word_for_word(page, tmp_path, rolled, monkeypatch, capfd, full):
    """Its blocks in their order, in an empty folder: files are saved, commands typed, and what it shows is printed."""
    if name_of(page) in MINUTES and not full:
        pytest.skip(f"{MINUTES[name_of(page)]}: with --full")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    printed = ""
    with contextlib.ExitStack() as servers:
        for block in blocks_of(page):
            if block.file:
                Path(block.file).write_text(block.text, encoding="utf-8")
            elif block.language == "python":
                exec(compile(block.text, name_of(page), "exec"), {})
            elif block.language == "text":
                assert printed is None or not plainly(block.text) - plainly(printed)
            elif not full and any(line.startswith(FILMED) for line in block.commands):
                printed = None
            elif block.language == "sh":
                capfd.readouterr()
                for line in block.commands:
                    do(line, page, servers, rolled)
                printed = "".join(capfd.readouterr())


def do(line: str, page: Path, servers: contextlib.ExitStack, rolled: Path) -> None:
    """Type one line of a guide."""
    program, *words = line.split()
    if program == "mkdir":
        Path(words[0]).mkdir()
    elif program == "cd":
        os.chdir(words[0])
    elif program == "dask":
        servers.enter_context(served([sys.executable, "-m", "dask", *words]))
    elif line == HAVE_A_SESSION:
        if not rolled.exists():
            assert type_in(line) == 0
            shutil.copytree("sessions", rolled)
        elif not Path("sessions").exists():
            shutil.copytree(rolled, "sessions")
    elif program == "chordlab":
        if why_not(page, line) is None:
            assert type_in(line) == 0, line
    else:
        assert program in NOT_OURS, line


@contextlib.contextmanager
def served(command: list[str]):
    """A server while the page lasts."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(30)


@pytest.mark.parametrize("page", OTHERS, ids=name_of)
def test_the_commands_of_a_page_do_something(page, workshop, monkeypatch, full):
    if name_of(page) in MINUTES and not full:
        pytest.skip(f"{MINUTES[name_of(page)]}: with --full")
    monkeypatch.chdir(workshop)
    Path("my_tower.geojson").unlink(missing_ok=True)  # another page's
    for line in shown_in_blocks(page):
        if why_not(page, line) is None:
            assert type_in(line) == 0, line
