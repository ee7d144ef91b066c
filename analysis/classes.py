# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# (scikit-learn is untyped; nothing of it leaves this module)
"""Which runs were over the same shape, and over how many shapes: classes without a dictionary.

A run is a session, or a stretch of one, over a shape that nobody has named. It is described by a few features whose
sampling error is known from its own lines. The features are whitened by the mean of these errors, so that one unit is
one standard error in every direction, and clustered:

- ``errors``: a mixture of points, each run scattered about its class by its own known errors. It has nothing to learn
  but where the classes lie, so that two runs of a shape are enough for it.
- ``mixture``: a Gaussian mixture that learns the scatter too (scikit-learn).
- ``kmeans``: k-means (scikit-learn).

The number of classes is the one with the least Bayesian information criterion (BIC) for the mixtures; for k-means the
one with the largest silhouette (Rousseeuw, J. Comput. Appl. Math. 20 (1987) 53), or the gap statistic's (Tibshirani,
Walther, Hastie, J. R. Stat. Soc. B 63 (2001) 411), which alone can answer that all runs are of one class. Both see how
far classes lie apart and not how far they should: with shapes of very different size they may stop at the coarsest cut.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp
from threadpoolctl import threadpool_limits

from analysis.estimate import relative_covariance
from analysis.invariants import area_cm2, perimeter_cm
from lab.base.errors import RequestError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Method = Literal["errors", "mixture", "kmeans"]
Kind = Literal["size", "lines"]

FEWEST_RUNS = 4
FEWEST_LINES = 10
SYSTEMATIC = 0.01  # relative error that runs over one shape do not share: speed, calibration
_MOST_CLASSES = 40
_STARTS = 10
_ROUNDS = 200
_PATIENCE = 4  # numbers of classes in a row that are no better than the best so far
_REFERENCES = 20  # of the gap statistic
_COVARIANCES = ("tied", "spherical", "diag", "full")


class TooFewRunsError(RequestError):
    """There are too few runs to sort into classes; ``runs`` is how many there are."""

    def __init__(self, runs: int) -> None:
        super().__init__(
            f"{runs} run(s) with {FEWEST_LINES} crossing lines or more are too few to sort into classes: "
            f"roll at least {FEWEST_RUNS}"
        )
        self.runs = runs


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What runs look like.

    Attributes:
        names: of the features.
        values: (runs, features).
        covariance: (runs, features, features) of each run's own sampling error.
    """

    names: tuple[str, ...]
    values: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        if len(self.values) < FEWEST_RUNS:
            raise TooFewRunsError(len(self.values))

    def errors(self, systematic: float) -> Floats:
        """``covariance`` with a relative error that runs do not share (the features are logarithms)."""
        return self.covariance + systematic**2 * np.eye(self.values.shape[1])

    def whitened(self, systematic: float = SYSTEMATIC) -> tuple[Floats, Floats]:
        """Values (runs, features) and errors (runs, features, features), where the mean error is the unit matrix."""
        errors = self.errors(systematic)
        root = np.linalg.cholesky(errors.mean(axis=0))
        centred = self.values - self.values.mean(axis=0)
        inverse = np.linalg.inv(root)
        return centred @ inverse.T, inverse @ errors @ inverse.T

    def nearest(self, run: int, count: int = 2, *, systematic: float = SYSTEMATIC) -> list[tuple[int, float]]:
        """The runs that look most like one, with their distance in standard errors of the difference."""
        errors = self.errors(systematic)
        gap = self.values - self.values[run]
        squared = np.einsum("ra,rab,rb->r", gap, np.linalg.inv(errors + errors[run]), gap)
        squared[run] = np.inf
        return [(int(other), float(np.sqrt(squared[other]))) for other in np.argsort(squared)[:count]]


@dataclass(frozen=True, slots=True, eq=False)
class Classes:
    """Runs sorted into classes.

    Attributes:
        labels: (runs,) class of each run, 0 for the one that the first run is in, and so on.
        probability: (runs,) of that label; 1 for k-means, which knows no doubt.
        number: of classes.
        method: how they were found.
        criterion: name of what chose their number; "asked for" where nothing did.
        scores: what was tried: number of classes → criterion.
    """

    labels: Ints
    probability: Floats
    number: int
    method: Method
    criterion: str
    scores: dict[int, float]


@dataclass(frozen=True, slots=True)
class LabelScore:
    """Classes against the truth; 1 is perfect.

    Attributes:
        rand: adjusted Rand index, 0 for labels by chance.
        v_measure: harmonic mean of the next two.
        homogeneity: 1 where no class mixes shapes.
        completeness: 1 where no shape is split.
    """

    rand: float
    v_measure: float
    homogeneity: float
    completeness: float


def describe(k: ArrayLike, l1_cm: ArrayLike, l3_cm3: ArrayLike, kind: Kind = "size") -> tuple[Floats, Floats]:
    """Features of one run and the covariance of their sampling error, from its crossing lines (lines,).

    ``size``: (log A, log P). ``lines``: the logarithms of the means of k, 𝓛_1, 𝓛_3, 𝓛_1² and k², which hold A and P
    and more: shapes of equal area and perimeter differ in how often lines cross them and how evenly.

    Raises:
        RequestError: fewer than ten lines.
    """
    columns = [np.asarray(column, dtype=float).ravel() for column in (k, l1_cm, l3_cm3)]
    lines = columns[0].size
    if lines < FEWEST_LINES:
        raise RequestError(f"{lines} crossing line(s) describe no shape: roll at least {FEWEST_LINES}")
    if kind == "lines":
        columns += [columns[1] ** 2, columns[0] ** 2]
    values = np.column_stack(columns)
    mean, covariance = values.mean(axis=0), np.cov(values, rowvar=False)
    if kind == "size":
        size = np.array([float(area_cm2(mean[1], mean[2])), float(perimeter_cm(*mean))])
        return np.log(size), relative_covariance(mean, covariance) / lines
    return np.log(mean), covariance / np.outer(mean, mean) / lines


def features_of(runs: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike]], kind: Kind = "size") -> Features:
    """Describe runs, each the arrays (k, 𝓛_1 in cm, 𝓛_3 in cm³) of its crossing lines, as `describe` does."""
    found = [describe(*run, kind) for run in runs]
    if not found:
        raise TooFewRunsError(0)
    names = ("log A", "log P") if kind == "size" else ("log k", "log L1", "log L3", "log L1²", "log k²")
    return Features(names, np.array([value for value, _ in found]), np.array([error for _, error in found]))


def sort_runs(
    features: Features,
    rng: np.random.Generator,
    *,
    method: Method = "errors",
    number: int | None = None,
    choose: Literal["silhouette", "gap"] = "silhouette",
    systematic: float = SYSTEMATIC,
) -> Classes:
    """Sort runs into classes, ``number`` of them or as many as the method finds.

    Args:
        features: of the runs.
        rng: source of the starts and references.
        method: see the module.
        number: of classes; None: chosen.
        choose: how k-means chooses.
        systematic: relative error that runs over one shape do not share; it keeps very long runs of one shape together.

    Raises:
        RequestError: ``number`` is not between 1 and the number of runs.
    """
    points, errors = features.whitened(systematic)
    runs = len(points)
    if number is not None and not 1 <= number <= runs:
        raise RequestError(f"{runs} runs make 1 to {runs} classes, not {number}")
    seed = int(rng.integers(2**31))
    if method == "kmeans":
        criterion = choose
        fits, scores = _k_means(points, _tried(number, runs - 1), seed, choose, rng)
    elif method == "mixture":
        criterion = "BIC"
        fits, scores = _mixtures(points, _tried(number, runs // 2), seed)
    else:
        criterion = "BIC"
        fits, scores = _points_with_errors(points, errors, _tried(number, runs), rng)
    best = number or _best(scores, criterion)
    labels, probability = fits[best]
    return Classes(
        labels=_in_order(labels),
        probability=probability,
        number=int(np.unique(labels).size),
        method=method,
        criterion=criterion if number is None else "asked for",
        scores=scores,
    )


def score_labels(labels: ArrayLike, truth: Sequence[object]) -> LabelScore:
    """Check labels against what the runs really were over."""
    from sklearn import metrics  # noqa: PLC0415 - it takes a second to load

    codes = np.unique([str(name) for name in truth], return_inverse=True)[1]
    homogeneity, completeness, v_measure = metrics.homogeneity_completeness_v_measure(codes, np.asarray(labels))
    rand = metrics.adjusted_rand_score(codes, np.asarray(labels))
    return LabelScore(float(rand), float(v_measure), float(homogeneity), float(completeness))


_Fits = dict[int, tuple[Ints, Floats]]


def _tried(number: int | None, most: int) -> range:
    """The numbers of classes to try."""
    return range(number, number + 1) if number is not None else range(1, max(1, min(most, _MOST_CLASSES)) + 1)


def _best(scores: dict[int, float], criterion: str) -> int:
    if criterion == "gap":
        # the gap is stored less the next one and its error: the first number that needs no further class
        return next((number for number, score in scores.items() if score >= 0), max(scores, default=1))
    return min(scores, key=scores.__getitem__) if criterion == "BIC" else max(scores, key=scores.__getitem__)


def _in_order(labels: Ints) -> Ints:
    """Number the classes as they first appear."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse].astype(np.int64)


def _quietly(fit: Callable[[], Any]) -> Any:
    """Fit on one thread, which is faster for a few points, without being told that a start did not converge."""
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fit()


def _k_means(
    points: Floats, tried: range, seed: int, choose: str, rng: np.random.Generator
) -> tuple[_Fits, dict[int, float]]:
    from sklearn.cluster import KMeans  # noqa: PLC0415 - it takes a second to load
    from sklearn.metrics import silhouette_score  # noqa: PLC0415

    model: Any = KMeans  # its types, guessed from the defaults, are wrong

    def fit(data: Floats, number: int, starts: int = _STARTS) -> Any:
        return _quietly(lambda: model(number, n_init=starts, random_state=seed).fit(data))

    certain = np.ones(len(points))
    fits: _Fits = {}
    scores: dict[int, float] = {}
    found = {number: fit(points, number) for number in tried}
    fits = {number: (fitted.labels_.astype(np.int64), certain) for number, fitted in found.items()}
    if len(tried) == 1:
        return fits, {}
    if choose == "silhouette":
        scores = {number: float(silhouette_score(points, labels)) for number, (labels, _) in fits.items() if number > 1}
        return fits, scores
    # references: as many points evenly over the box along the points' principal axes
    axes = np.linalg.svd(points, full_matrices=False)[2]
    low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
    even = [rng.uniform(low, high, points.shape) for _ in range(_REFERENCES)]
    known = np.nan
    for number, fitted in found.items():
        logs = np.log([max(float(fit(data, number, 2).inertia_), 1e-12) for data in even])
        gap = float(logs.mean() - np.log(max(float(fitted.inertia_), 1e-12)))
        if number > tried.start:
            scores[number - 1] = known - gap + float(logs.std()) * np.sqrt(1 + 1 / _REFERENCES)
            if scores[number - 1] >= 0:
                break
        known = gap
    return fits, scores


def _mixtures(points: Floats, tried: range, seed: int) -> tuple[_Fits, dict[int, float]]:
    """Gaussian mixtures, each with the covariances (of four kinds) that have the least BIC."""
    from sklearn.mixture import GaussianMixture  # noqa: PLC0415 - it takes a second to load

    fits: _Fits = {}
    scores: dict[int, float] = {}
    for number in tried:
        for kind in _COVARIANCES:
            # no class is narrower than a quarter of the mean error's variance
            model = GaussianMixture(number, covariance_type=kind, n_init=3, reg_covar=0.25, random_state=seed)
            _quietly(lambda model=model: model.fit(points))
            score = float(model.bic(points))
            if score < scores.get(number, np.inf):
                chances = model.predict_proba(points)
                scores[number] = score
                fits[number] = chances.argmax(axis=1).astype(np.int64), chances.max(axis=1)
        if _past_the_best(scores):
            break
    return fits, scores


def _past_the_best(scores: dict[int, float]) -> bool:
    """Whether the last few numbers of classes were all worse than an earlier one."""
    costs = list(scores.values())
    return len(costs) > _PATIENCE and min(costs[-_PATIENCE:]) > min(costs)


def _points_with_errors(
    points: Floats, errors: Floats, tried: range, rng: np.random.Generator
) -> tuple[_Fits, dict[int, float]]:
    """Mixtures of points, seen with each run's own known errors, by expectation and maximisation."""
    inverse: Floats = np.asarray(np.linalg.inv(errors), dtype=float)
    log_volume = 0.5 * np.linalg.slogdet(2 * np.pi * errors)[1]
    runs, features = points.shape
    fits: _Fits = {}
    scores: dict[int, float] = {}
    for number in tried:
        starts = [_expect_and_maximise(points, inverse, _spread(points, number, rng)) for _ in range(_STARTS)]
        log_joint = max(starts, key=lambda joint: float(logsumexp(joint, axis=1).sum())) - log_volume[:, None]
        total = logsumexp(log_joint, axis=1)
        parameters = number * features + number - 1
        scores[number] = float(-2 * total.sum() + parameters * np.log(runs))
        chances = np.exp(log_joint - total[:, None])
        fits[number] = chances.argmax(axis=1).astype(np.int64), chances.max(axis=1)
        if _past_the_best(scores):
            break
    return fits, scores


def _spread(points: Floats, number: int, rng: np.random.Generator) -> Floats:
    """Starting places: points drawn far from each other (k-means++)."""
    places = [points[rng.integers(len(points))]]
    while len(places) < number:
        nearest = np.min([((points - place) ** 2).sum(axis=1) for place in places], axis=0) + 1e-12
        places.append(points[rng.choice(len(points), p=nearest / nearest.sum())])
    return np.array(places)


def _expect_and_maximise(points: Floats, inverse: Floats, places: Floats) -> Floats:
    """Log of weight times density (runs, classes), up to each run's own constant."""
    weights = np.full(len(places), 1 / len(places))
    known, log_joint = -np.inf, np.empty(0)
    for _ in range(_ROUNDS):
        gap = points[:, None, :] - places
        log_joint = np.log(weights) - 0.5 * np.einsum("rca,rab,rcb->rc", gap, inverse, gap)
        total = logsumexp(log_joint, axis=1)
        if total.sum() - known < 1e-6 * max(1.0, abs(known)) and np.isfinite(known):
            break
        known = float(total.sum())
        chances = np.exp(log_joint - total[:, None])
        weights = np.maximum(chances.mean(axis=0), 1e-12)
        # the weighted mean, each run counting by its own precision
        precision = np.einsum("rc,rab->cab", chances, inverse) + 1e-9 * np.eye(points.shape[1])
        pull = np.einsum("rc,rab,rb->ca", chances, inverse, points)
        places = np.linalg.solve(precision, pull[:, :, None])[:, :, 0]
    return log_joint
