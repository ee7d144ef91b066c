"""What a report concludes, as plain data: findings, problems with their cures, and the verdict they make."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Tone = Literal["good", "fair", "poor"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing the session shows: ``topic`` in a word or two, ``text`` in whole sentences."""

    topic: str
    text: str


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that spoils the session, and what to do next."""

    what: str
    next_step: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The conclusion: ``tone`` good (nothing to do), fair (usable, see the problems) or poor."""

    tone: Tone
    headline: str
    findings: tuple[Finding, ...]
    problems: tuple[Problem, ...]

    @property
    def standing(self) -> str:
        """What the tone means, in words, for whom its colour says nothing."""
        said = {"good": "Nothing to mend", "fair": "To be read with care", "poor": "Not to be relied on"}[self.tone]
        if not self.problems:
            return f"{said}."
        points = "one point" if len(self.problems) == 1 else f"{len(self.problems)} points"
        return f"{said}: {points} below, each with what to do."
