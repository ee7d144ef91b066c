"""What a review finds, whole."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.bandcheck import MonteCarloCheck
from analysis.budget import Budget
from analysis.estimate import Estimate
from analysis.quadrature import Moments
from analysis.report.result import RunCheck
from lab.recognise.recognisers import Recognition
from lab.review.filmed import Filmed
from lab.settings.settings import Settings
from lab.store.reader import SessionReader
from lab.store.tables import Tables
from projector.shape import Shape


@dataclass(frozen=True, slots=True)
class Reviewed:
    """A session with everything that was found in it."""

    session: SessionReader
    settings: Settings
    shape: Shape
    tables: Tables
    moments: dict[str, Moments]
    titles: dict[str, str]
    recognition: Recognition
    robot: Estimate | None
    filmed: Filmed | None
    runs: RunCheck | None
    budget: Budget | None = None
    montecarlo: MonteCarloCheck | None = None
