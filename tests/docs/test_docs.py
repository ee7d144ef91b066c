"""The documents: links that lead somewhere, commands that exist, settings that are read, messages that are said."""

import json
import re
import shlex
import tomllib
from dataclasses import fields
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from typer.main import get_command

from lab.cli.main import app
from lab.settings.load import load_settings
from lab.store.tables import CROSSING_COLUMNS, ESTIMATE_COLUMNS, LINE_COLUMNS
from robot.crossings import SEPARATION_NOISES
from robot.profile import RobotProfile, load_profile
from tests.docs.shown import FENCE, HOME, PAGES, blocks_of, name_of, shown_in_blocks, shown_in_text

# Where a page may send its readers. Whether they are there is not asked: tests know no network.
ELSEWHERE = {
    "distributed.dask.org", "docs.micropython.org", "foxglove.dev", "keepachangelog.com", "semver.org",
}  # fmt: skip
LINK = re.compile(r"(?<!\\)\]\(([^)#\s]*)(#[^)\s]+)?\)")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    for link, place in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        if "://" in link:
            address = urlsplit(link)
            assert address.scheme == "https", link
            assert address.hostname in ELSEWHERE, link
            continue
        target = page.parent / link if link else page
        assert target.exists(), link
        assert not place or place[1:] in anchors_of(target), place


def anchors_of(page: Path) -> set[str]:
    """The anchors that forges make of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_page_is_in_the_contents():
    """The index lists it, or the page of decisions does."""
    contents = (HOME / "docs/index.md").read_text(encoding="utf-8")
    for page in (HOME / "docs").rglob("*.md"):
        name = str(page.relative_to(HOME / "docs").with_suffix(""))
        if name != "index" and not name.startswith("decisions/"):
            assert f"\n{name}\n" in contents, name
            assert f"({name}.md)" in contents, name


@pytest.mark.parametrize(
    "line",
    sorted({line for page in PAGES for line in shown_in_blocks(page) + shown_in_text(page)}),
    ids=lambda line: line[:60],
)
def test_every_command_shown_exists_with_its_options(line):
    command, words = get_command(app), shlex.split(line)[1:]
    if words in (["--help"], ["--install-completion"]):
        return
    while getattr(command, "commands", None) and words and words[0] in command.commands:
        command = command.commands[words.pop(0)]
    assert not getattr(command, "commands", None), f"{line}: no such command"
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    asked = {word for word in words if word.startswith("--")}
    assert asked <= known | {"--help"}, f"{line}: {asked - known}"


def test_readme_is_not_empty_of_commands():
    assert len(shown_in_blocks(HOME / "README.md")) > 10


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_toml_shown_is_read(page, tmp_path):
    for number, block in enumerate(blocks_of(page)):
        if block.language == "toml":
            file = tmp_path / f"{number}.toml"
            file.write_text(block.text, encoding="utf-8")
            if block.text.startswith("# robot-profile.toml"):
                assert load_profile(file) != RobotProfile()
            else:
                assert load_settings(file).robot


@pytest.mark.parametrize("page", [page for page in PAGES if "howto" not in page.parts], ids=name_of)
def test_every_python_block_runs(page, tmp_path, monkeypatch):
    """Each by itself, in an empty folder; those of the how-tos run where their page's commands do."""
    monkeypatch.chdir(tmp_path)
    for block in blocks_of(page):
        if block.language == "python":
            exec(compile(block.text, name_of(page), "exec"), {})


def test_every_module_of_the_lab_is_in_its_packages_row_of_the_architecture():
    rows = {
        row.split("`")[1].strip("/"): row
        for row in (HOME / "docs/architecture.md").read_text(encoding="utf-8").splitlines()
        if row.startswith("| `")
    }
    for module in (HOME / "lab").glob("*.py"):
        assert module.stem == "__init__" or module.stem in rows, module.stem
    for package in (folder for folder in (HOME / "lab").iterdir() if (folder / "__init__.py").is_file()):
        row = rows[package.name]
        for module in package.glob("*.py") if package.name != "cli" else ():
            assert module.stem == "__init__" or f"`{module.stem}`" in row, f"{package.name}/{module.stem}"
    assert {"robot", "projector", "tracking", "analysis"} <= set(rows)


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


@pytest.fixture(scope="module")
def said() -> str:
    """All code, with … for what is filled in."""
    rooms = ("robot", "lab", "tracking", "projector")
    sources = [path.read_text(encoding="utf-8") for room in rooms for path in (HOME / room).rglob("*.py")]
    code = re.sub(r"[\"']\s*\n\s*f?[\"']", "", "\n".join(sources))
    return re.sub(r"\{[^{}]*\}", "…", code)


@pytest.mark.parametrize("page", ["docs/robots.md", "docs/tutorial/first-bench-session.md"])
def test_the_messages_that_a_guide_explains_are_said(page, said):
    text = (HOME / page).read_text(encoding="utf-8")
    table = text[text.index("## Troubleshooting") :]
    shown = [row.split("|")[1].strip() for row in table.splitlines() if row.startswith("| `")]
    assert len(shown) > 15
    for message in shown:
        assert message.split("`")[1] in said, message


def test_the_bench_of_the_tutorial_is_that_of_the_defaults():
    """Every height and width that it names is the settings'."""
    text = (HOME / "docs/tutorial/first-bench-session.md").read_text(encoding="utf-8")
    default, sensor = load_settings(None), 6
    assert (default.sensor.height_cm, default.led.height_cm) == (sensor, 7.3)
    for optics, drawn in ((default.camera_optics, "camera"), (default.projector_optics, "projector")):
        width, high = optics.image_size
        across = optics.field_width_cm
        assert f"| {drawn} | {optics.height_cm:.0f} cm | {across:.0f} × {across * high / width:.0f} cm |" in text
        assert f"{10 * across / width:.1f} mm |" in text
        assert f"image_size = {json.dumps(list(optics.image_size))}" in text
    assert f"{100 * sensor / default.projector_optics.height_cm:.1f} % smaller" in text
    assert f"at least **{SEPARATION_NOISES:.0f} noise widths**" in " ".join(text.split())
    assert f"arena {default.arena.width_cm:.0f} × {default.arena.height_cm:.0f} cm" in text
