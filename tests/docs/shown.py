"""What the pages show: code blocks and commands, and how they are run as a reader would."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from textwrap import dedent

from lab.cli.main import main

HOME = Path(__file__).parents[2]
PAGES = sorted([HOME / "README.md", HOME / "CHANGELOG.md", *(HOME / "docs").rglob("*.md")])
FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
SHELL = ("sh", "powershell", "")


def name_of(page: Path) -> str:
    return str(page.relative_to(HOME))


@dataclass(frozen=True)
class Block:
    """A code block; ``file`` is the name that the line before it says to save it under."""

    language: str
    text: str
    file: str | None

    @property
    def commands(self) -> list[str]:
        """Its lines as one types them; of PowerShell too, where the program is called by its path."""
        if self.language not in SHELL:
            return []
        lines = self.text.replace("\\\n", " ").splitlines()
        return [re.sub(r"^\.venv\S*[/\\]", "", line.strip()) for line in lines if line.strip()]


def blocks_of(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    blocks = []
    for found in FENCE.finditer(text):
        before = text[: found.start()].rstrip().rpartition("\n\n")[2]
        named = re.search(r"[Ss]ave this as `([^`]+)`", before)
        blocks.append(Block(found[2], dedent(found[3]), named[1] if named else None))
    return blocks


def shown_in_blocks(page: Path) -> list[str]:
    """Every `chordlab …` in a page's code blocks."""
    return [line for block in blocks_of(page) for line in block.commands if line.startswith("chordlab ")]


def shown_in_text(page: Path) -> list[str]:
    """Every `chordlab …` in a page's running text and tables."""
    return re.findall(r"`(chordlab [^`]+)`", FENCE.sub("", page.read_text(encoding="utf-8")))


def type_in(line: str) -> int:
    """Run one command here and now, as a shell would start it. Returns its exit code."""
    words: list[str] = []
    for word in shlex.split(line)[1:]:
        found = sorted(map(str, Path().glob(word))) if "*" in word else [word]
        assert found, f"{line}: nothing is called {word}"
        words += found
    return main(words)


def plainly(text: str) -> set[str]:
    """Its lines with numbers, paths of sessions and the frames of tables taken out."""
    text = re.sub(r"sessions/\S*?_(\w+?)_\w{4}\b", r"sessions/\1", text)
    text = re.sub(r"[┏┓┗┛┡┩└┘├┤┬┴┼╇╈━─│┃┳┻]", " ", text)
    text = re.sub(r"[+\-−]?\d[\d.]*", "#", text)
    return {" ".join(line.split()) for line in text.splitlines()} - {""}
