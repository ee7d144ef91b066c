"""The laws by which a simulated robot may turn."""

from __future__ import annotations

from enum import StrEnum


class Turning(StrEnum):
    """How a simulated robot draws its next line."""

    LAMBERT = "lambert"
    """Cosine law at the edge: uniform isotropic lines."""
    UNIFORM = "uniform"
    """Any inward angle alike: biased."""
    UNIFORM_WEIGHTED = "uniform-weighted"
    """Any inward angle alike, each line weighted by its length: right in a disc alone."""
    INTERIOR = "interior"
    """Random interior stops, a fresh heading at each, lines weighted by 1/length."""
