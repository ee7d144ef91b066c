"""Whether the running log-likelihoods come as they should while the leading entry is true.

Every entry's log-likelihood follows the lines. While one entry is true, its lines say how fast it gains on each of
the others, and with what scatter: the gains over many lines are normal. A shape that is in no entry lets some gain
too fast and others too slowly, the more alike it is to some of them: near copies, words of the same letters, show
here when nothing else gives them away.

The gains are correlated; along the principal axes of their covariance they are not. An outsider is a shape whose
density is the entry's, bent a little towards or away from some others: its mean gain along an axis of variance λ is
normal with variance proportional to λ². That gives a Bayes factor in closed form for each size of the bend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]

FEWEST_LINES = 50  # before, a mean gain is nothing like normal
_CLIP = 2.0  # nats that one line may add to a gain: keeps single lines from deciding
_RIVALS = 64  # the nearest
_AXES = 32
_BENDS = np.array([0.15, 0.3])  # Kullback–Leibler rates of an outsider against the entry, nats a line


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """What an entry's own lines do to the others' gains.

    Attributes:
        score: (bins, axes) what a line in each bin adds along each axis, less its mean while the entry is true.
        variance: (axes,) of a line's score.
        learnt: lines that mean and variance were learnt from.
    """

    score: Singles
    variance: Floats
    learnt: float

    @classmethod
    def of(cls, own: Floats, rivals: Singles, filled: Ints, counts: Floats) -> Deviation:
        """Learn it.

        Args:
            own: (bins,) log-probability of each bin under the entry, learnt from other lines than ``counts``: on its
                own lines an entry does better than it ever will again.
            rivals: (bins, others) the same under all other entries, at least one.
            filled: (filled,) bins that lines of the entry fell in.
            counts: (filled,) how many.
        """
        total = float(counts.sum())
        share = counts / total
        advance = share @ (rivals[filled] - own[filled, None])
        near = np.argsort(-advance)[:_RIVALS]
        gain = np.clip(rivals[:, near] - own[:, None].astype(np.float32), -_CLIP, _CLIP)
        mean = share @ gain[filled]
        spread = (gain[filled] - mean) * np.sqrt(share)[:, None]
        variance, axes = np.linalg.eigh(spread.T @ spread)
        kept = np.flatnonzero(variance > 1e-4 * variance[-1])[::-1][:_AXES]
        turned = axes[:, kept].astype(np.float32)
        score = gain @ turned - (mean @ axes[:, kept]).astype(np.float32)
        return cls(score.astype(np.float32, copy=False), variance[kept], total)

    def evidence(self, bins: Ints, weights: Floats) -> float:
        """Log Bayes factor of an outsider against the entry, from lines in ``bins``, counted as ``weights``."""
        count = float(weights.sum())
        if count < FEWEST_LINES or not self.variance.size:
            return 0.0
        lines = 1 / (1 / count + 1 / self.learnt)  # the mean is only known from the learnt lines
        mean = weights @ self.score[bins] / count
        square = lines * mean**2 / self.variance
        # a bend of KL rate r has Σ θ²λ = 2r over the axes
        grown = lines * self.variance * (2 * _BENDS / self.variance.sum())[:, None]
        factors = 0.5 * (grown / (1 + grown) * square - np.log1p(grown)).sum(axis=1)
        return float(np.logaddexp.reduce(factors) - np.log(_BENDS.size))
