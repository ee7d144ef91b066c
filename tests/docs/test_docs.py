"""The documents: links that lead somewhere, commands that exist, settings that are read."""

import re
import shlex
from pathlib import Path

import pytest
from typer.main import get_command

from lab.cli.main import app
from lab.settings import load_settings

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
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    for link in links:
        if "://" not in link:
            assert (page.parent / link).exists(), link


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
            assert load_settings(file).robot


def test_every_module_of_the_lab_is_in_the_architecture():
    text = (HOME / "docs/architecture.md").read_text(encoding="utf-8")
    for module in (HOME / "lab").glob("*.py"):
        if module.stem != "__init__":
            assert f"`{module.stem}`" in text, module.stem
    for room in ("robot", "projector", "tracking", "analysis"):
        assert f"| `{room}` |" in text
