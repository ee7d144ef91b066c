"""The documents: links that lead somewhere, commands that exist, settings that are read, messages that are said."""

import re
import shlex
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
from typer.main import get_command

from lab.cli.main import app
from lab.finalize import CROSSING_COLUMNS, ESTIMATE_COLUMNS, LINE_COLUMNS
from lab.settings import load_settings
from robot.profile import RobotProfile, load_profile

HOME = Path(__file__).parents[2]
PAGES = sorted([HOME / "README.md", HOME / "CHANGELOG.md", *(HOME / "docs").rglob("*.md")])
FENCE = re.compile(r"```(\w*)\n(.*?)```", re.DOTALL)


def commands_of(page: Path) -> list[str]:
    """Every `chordlab …` that a page shows, in code blocks and in running text."""
    text = page.read_text(encoding="utf-8")
    blocks = [line.strip() for _, block in FENCE.findall(text) for line in block.splitlines()]
    inline = re.findall(r"`(chordlab [^`]+)`", FENCE.sub("", text))
    shown = [re.sub(r"^\.venv\S*[/\\]", "", line) for line in blocks] + inline
    return [line for line in shown if line.startswith("chordlab ")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_relative_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]*)(#[^)\s]+)?\)", page.read_text(encoding="utf-8"))
    for link, place in links:
        if "://" not in link:
            target = page.parent / link if link else page
            assert target.exists(), link
            assert not place or place[1:] in anchors_of(target), place


def anchors_of(page: Path) -> set[str]:
    """The anchors that forges make of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize(
    "line", sorted({line for page in PAGES for line in commands_of(page)}), ids=lambda line: line[:60]
)
def test_every_command_shown_exists_with_its_options(line):
    command, words = get_command(app), shlex.split(line)[1:]
    while getattr(command, "commands", None) and words and words[0] in command.commands:
        command = command.commands[words.pop(0)]
    assert not getattr(command, "commands", None), f"{line}: no such command"
    known = {option for parameter in command.params for option in parameter.opts}
    asked = {word for word in words if word.startswith("--")}
    assert asked <= known, f"{line}: {asked - known}"


def test_readme_is_not_empty_of_commands():
    assert len(commands_of(HOME / "README.md")) > 10


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_toml_shown_is_read(page, tmp_path):
    for number, (language, block) in enumerate(FENCE.findall(page.read_text(encoding="utf-8"))):
        if language == "toml":
            file = tmp_path / f"{number}.toml"
            file.write_text(block, encoding="utf-8")
            if block.startswith("# robot-profile.toml"):
                assert load_profile(file) != RobotProfile()
            else:
                assert load_settings(file).robot


def test_every_module_of_the_lab_is_in_the_architecture():
    text = (HOME / "docs/architecture.md").read_text(encoding="utf-8")
    for module in (HOME / "lab").glob("*.py"):
        if module.stem != "__init__":
            assert f"`{module.stem}`" in text, module.stem
    for room in ("robot", "projector", "tracking", "analysis"):
        assert f"| `{room}` |" in text


def test_every_key_of_a_robot_profile_is_in_the_guide_with_its_default():
    text = (HOME / "docs/robots.md").read_text(encoding="utf-8")
    rows = [row.split(" | ") for row in text.splitlines() if row.startswith("| `")]
    defaults = {key: row[2] for row in rows if len(row) == 5 for key in re.findall(r"`(\w+)`", row[0])}
    for field in fields(RobotProfile):
        told = defaults[field.name].strip("`")
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        assert (None if told == "–" else tomllib.loads(f"value = {told}")["value"]) == default, field.name


def test_every_column_is_in_the_session_folders_page():
    text = (HOME / "docs/session-folder.md").read_text(encoding="utf-8")
    for column in (*LINE_COLUMNS, *CROSSING_COLUMNS, *ESTIMATE_COLUMNS):
        assert f"`{column}`" in text, column


def test_the_messages_that_the_guide_explains_are_said():
    """As the code has them, with … for what is filled in."""
    text = (HOME / "docs/robots.md").read_text(encoding="utf-8")
    table = text[text.index("## Troubleshooting") :]
    shown = [row.split("|")[1].strip() for row in table.splitlines() if row.startswith("| `")]
    sources = [path.read_text(encoding="utf-8") for room in ("robot", "lab") for path in (HOME / room).rglob("*.py")]
    code = re.sub(r"[\"']\s*\n\s*f?[\"']", "", "\n".join(sources))
    said = re.sub(r"\{[^{}]*\}", "…", code)
    assert len(shown) > 20
    for message in shown:
        assert message.split("`")[1] in said, message
