"""Which entry of a dictionary is it: the common face of the recognisers, and the paper's own (A, P) one.

The per-line recogniser, which needs some ten times fewer lines, is `analysis.perline`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.estimate import ratio_bias
from analysis.invariants import area_cm2, perimeter_cm
from analysis.outsider import OUTSIDER_PRIOR
from analysis.quadrature import Moments
from lab.base.errors import RequestError

Floats = NDArray[np.float64]

FIRST_POSTERIOR_N = 10


@runtime_checkable
class Recogniser(Protocol):
    """Takes crossing lines one by one and says how probable each entry of its dictionary has become."""

    @property
    def names(self) -> tuple[str, ...]:
        """The entries, in the dictionary's order."""
        ...

    @property
    def classes(self) -> tuple[tuple[str, ...], ...]:
        """The entries sorted into classes that no lines tell apart; most have one member."""
        ...

    @property
    def n(self) -> int:
        """Crossing lines taken in so far."""
        ...

    def update(self, k: int, l1_cm: float, l3_cm3: float, weight: float = 1.0) -> None:
        """Take in one line. A line with k = 0 did not cross the shape and changes nothing.

        ``weight`` undoes an unequal chance of being drawn. Lines of unequal weights count as (Σw)²/Σw² equal
        ones (Kish's effective sample size).
        """
        ...

    def update_many(self, k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, weight: ArrayLike = 1.0) -> None:
        """Take in many lines, arrays of shape (lines,); ``weight`` is one number or (lines,)."""
        ...

    def posterior(self) -> dict[str, float]:
        """Probability of each entry, given that the shape is one of them; they sum to 1, and twins share evenly."""
        ...

    def ranked(self) -> list[tuple[str, float]]:
        """(name, probability) of each class, the most probable first, under its first member's name."""
        ...

    def unknown(self) -> float:
        """Probability that the shape is none of the dictionary's."""
        ...

    def reset(self) -> None:
        """Forget every line."""
        ...


class Weights:
    """Running sums of the lines' weights."""

    __slots__ = ("squares", "total")

    def __init__(self) -> None:
        self.total = 0.0
        self.squares = 0.0

    def take(self, weight: ArrayLike) -> None:
        """Take in the weight of one line, or of many."""
        values = np.asarray(weight, dtype=float)
        self.total += float(values.sum())
        self.squares += float((values * values).sum())

    @property
    def effective_lines(self) -> float:
        """Number of lines of equal weight that would tell as much, (Σw)²/Σw²; 0 before the first."""
        return self.total * self.total / self.squares if self.squares else 0.0


def crossing_lines(k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, weight: ArrayLike) -> Floats:
    """The lines with k ≥ 1 as rows (k, 𝓛_1, 𝓛_3, weight)."""
    columns = [np.asarray(column, dtype=float).ravel() for column in (k, l1_cm, l3_cm3)]
    weights = np.broadcast_to(np.asarray(weight, dtype=float), columns[0].shape)
    values = np.column_stack([*columns, weights])
    return values[values[:, 0] >= 1]


class GaussianRecogniser:
    """The paper's recogniser: area and perimeter against each entry, by Bayes' rule.

    The estimate (Â, P̂) after N lines is taken as normal about the entry's own area and perimeter with the
    entry's own full 2x2 covariance/N: A and P are correlated (up to 0.98 for a tower), so that axis-aligned
    ellipses would mislead. The ratio bias of order 1/N is included.

    Before `FIRST_POSTERIOR_N` lines the posterior is the prior: Â and P̂ are ratios of means of strongly skewed
    quantities, and over a few lines nothing like normal, so that a single long chord would "prove" an
    entry. For intricate shapes the skew shows up to a hundred lines.

    Args:
        entries: exact moments of each entry, from `analysis.quadrature.exact_moments`.
        prior: relative prior weight of each entry, > 0; equal without it.
        classes: the twins among the entries, from `analysis.congruence.congruence_classes`.
    """

    def __init__(
        self,
        entries: Mapping[str, Moments],
        *,
        prior: Mapping[str, float] | None = None,
        classes: Sequence[Sequence[str]] = (),
    ) -> None:
        self.names = tuple(entries)
        self.classes = class_heads(self.names, classes)
        self._log_prior = log_prior(self.names, prior)
        moments = list(entries.values())
        self._size = np.array([[m.area_cm2, m.perimeter_cm] for m in moments])
        self._relative = np.array([m.relative for m in moments])
        self._bias = np.array([ratio_bias(m.mean, m.covariance) for m in moments])
        self.reset()

    @property
    def n(self) -> int:
        """Crossing lines taken in so far."""
        return self._n

    def reset(self) -> None:
        """Forget every line."""
        self._n = 0
        self._sums = np.zeros(3)
        self._weights = Weights()

    def update(self, k: int, l1_cm: float, l3_cm3: float, weight: float = 1.0) -> None:
        """Take in one line; k = 0 changes nothing."""
        if k >= 1:
            self._n += 1
            self._sums += weight * np.array((k, l1_cm, l3_cm3))
            self._weights.take(weight)

    def update_many(self, k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, weight: ArrayLike = 1.0) -> None:
        """Take in many lines, arrays of shape (lines,)."""
        lines = crossing_lines(k, l1_cm, l3_cm3, weight)
        self._n += len(lines)
        self._sums += (lines[:, 3:] * lines[:, :3]).sum(axis=0)
        self._weights.take(lines[:, 3])

    def posterior(self) -> dict[str, float]:
        """Probability of each entry from the running means; the prior before `FIRST_POSTERIOR_N` lines."""
        if self._n < FIRST_POSTERIOR_N:
            return normalised(self.names, self._log_prior)
        k, l1, l3 = self._sums / self._weights.total
        effective = self._weights.effective_lines
        return self.posterior_at(float(area_cm2(l1, l3)), float(perimeter_cm(k, l1, l3)), effective)

    def ranked(self) -> list[tuple[str, float]]:
        """(name, probability) of each class, the most probable first, under its first member's name."""
        return rank_classes(self.posterior(), self.classes)

    def unknown(self) -> float:
        """Probability that the shape is none of the dictionary's, from how far the estimate lies from every entry.

        A p-value p of the χ² distance speaks against an entry by at most −e·p·ln p to one (Sellke, Bayarri and
        Berger, The American Statistician 55, 2001). `OUTSIDER_PRIOR` before `FIRST_POSTERIOR_N` lines.
        """
        if self._n < FIRST_POSTERIOR_N:
            return OUTSIDER_PRIOR
        k, l1, l3 = self._sums / self._weights.total
        area, perimeter = float(area_cm2(l1, l3)), float(perimeter_cm(k, l1, l3))
        p_value = math.exp(-0.5 * min(self.misfit(area, perimeter, self._weights.effective_lines).values()))
        entry = -math.e * p_value * math.log(p_value) if 0 < p_value < math.exp(-1) else float(p_value > 0)
        return OUTSIDER_PRIOR / (OUTSIDER_PRIOR + (1 - OUTSIDER_PRIOR) * entry)

    def posterior_at(self, area: float, perimeter: float, n: float) -> dict[str, float]:
        """Probability of each entry for an estimate (cm², cm) from ``n`` lines: the likelihood landscape."""
        distance2, log_norm = self._terms(area, perimeter, n)
        return normalised(self.names, self._log_prior - 0.5 * distance2 - log_norm)

    def misfit(self, area: float, perimeter: float, n: float) -> dict[str, float]:
        """Squared Mahalanobis distance to each entry, χ² with 2 degrees of freedom if that entry is true.

        When all of them are above 14 (p < 0.001) the shape is in no entry, whatever the posterior says.
        """
        distance2, _ = self._terms(area, perimeter, n)
        return {name: float(value) for name, value in zip(self.names, distance2, strict=True)}

    def landscape(self, area: ArrayLike, perimeter: ArrayLike, n: float) -> Floats:
        """Posterior (…, entries) at estimates (cm², cm) of any one shape of array, each from ``n`` lines."""
        distance2, log_norm = self._terms(area, perimeter, n)
        logs = self._log_prior - 0.5 * distance2 - log_norm
        weights = np.exp(logs - logs.max(axis=-1, keepdims=True))
        return weights / weights.sum(axis=-1, keepdims=True)

    def _terms(self, area: ArrayLike, perimeter: ArrayLike, n: float) -> tuple[Floats, Floats]:
        """Squared distances (…, entries) and log norms (entries,)."""
        covariance = self._relative / n
        estimates = np.stack([np.asarray(area, dtype=float), np.asarray(perimeter, dtype=float)], axis=-1)
        relative_error = estimates[..., None, :] / self._size - 1 - self._bias / n
        # In relative units; the determinant of the absolute covariance then needs the sizes.
        distance2 = np.einsum("...ei,eij,...ej->...e", relative_error, np.linalg.inv(covariance), relative_error)
        log_norm = 0.5 * np.linalg.slogdet(covariance)[1] + np.log(self._size).sum(axis=1)
        return distance2, log_norm


def log_prior(names: tuple[str, ...], prior: Mapping[str, float] | None) -> Floats:
    """Log prior of each name, not normalised. Raises RequestError for an empty dictionary or a bad weight."""
    if not names:
        raise RequestError("the dictionary is empty; give at least one entry to recognise")
    if prior is None:
        return np.zeros(len(names))
    weights = np.array([prior.get(name, 0.0) for name in names])
    if not (weights > 0).all() or not np.isfinite(weights).all():
        raise RequestError("every entry needs a prior weight above 0")
    return np.log(weights)


def normalised(names: tuple[str, ...], log_weights: Floats) -> dict[str, float]:
    """Turn log weights into probabilities; the largest is taken off first, so that nothing under- or overflows."""
    weights = np.exp(log_weights - log_weights.max())
    return {name: float(value) for name, value in zip(names, weights / weights.sum(), strict=True)}


def class_heads(names: tuple[str, ...], classes: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], ...]:
    """Sort all ``names`` into classes: those given, and one for each name that is in none.

    Raises RequestError where a class names what is not among them.
    """
    given = {name: tuple(members) for members in classes for name in members}
    strangers = sorted(given.keys() - set(names))
    if strangers:
        raise RequestError(f"{', '.join(strangers)}: in a class of twins, but not in the dictionary")
    return tuple(dict.fromkeys(given.get(name, (name,)) for name in names))


def rank_classes(posterior: Mapping[str, float], classes: Sequence[Sequence[str]]) -> list[tuple[str, float]]:
    """Add up each class under its first member's name, the most probable first; ties keep the dictionary's order."""
    summed = [(members[0], sum(posterior[name] for name in members)) for members in classes]
    return sorted(summed, key=lambda item: -item[1])
