"""A whole session against simulated ones: its curves A(N) and P(N), and its chord lengths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from analysis.bandtest import BandTest
from analysis.compare import ChordsByLine

DOUBTFUL = 0.05


@dataclass(frozen=True, slots=True)
class MonteCarloCheck:
    """What the comparison with Monte Carlo says.

    Attributes:
        rolled: the curves against ideal lines that follow each other from wall to wall as the session's should.
        independent: against independent ideal lines, the paper's Monte Carlo; None for lines of unequal weight.
        sensed: against lines from wall to wall seen through the robot's light sensor.
        chords: the chord lengths against those of ideal lines; None for lines of unequal weight.
    """

    rolled: BandTest
    independent: BandTest | None
    sensed: BandTest
    chords: ChordsByLine | None

    def to_dict(self) -> dict[str, Any]:
        """The figures of `chordlab validate`; what was not compared is None."""
        chords = self.chords
        return {
            "band_p_value": self.rolled.p_value,
            "inside": self.rolled.inside,
            "leaves_at": self.rolled.leaves_at,
            "independent_p_value": None if self.independent is None else self.independent.p_value,
            "sensed_p_value": self.sensed.p_value,
            "sensed_inside": self.sensed.inside,
            "ks_statistic": None if chords is None else chords.test.statistic,
            "ks_p_value": None if chords is None else chords.test.p_value,
            "kl_nats": None if chords is None else chords.divergence.nats,
            "kl_bias_nats": None if chords is None else chords.divergence.bias_nats,
            "kl_p_value": None if chords is None else chords.divergence_p,
            "sessions": self.rolled.sessions,
            "sentence": self.sentence,
        }

    @property
    def sentence(self) -> str:
        """What it means, for people."""
        ideal, sensed = self.rolled, self.sensed
        held = f"{100 * ideal.level:g} % of whole simulated curves"
        if ideal.inside:
            said = f"A(N) and P(N) stay inside the band that holds {held} (p = {ideal.p_value:.3f})"
            if not sensed.inside:
                said += f", though not inside that of lines seen through the robot's sensor (p = {sensed.p_value:.3f})"
        else:
            where = "" if ideal.leaves_at is None else f" at N = {ideal.leaves_at}"
            said = f"A(N) or P(N) leaves the band that holds {held}{where} (p = {ideal.p_value:.3f}); "
            if sensed.inside:
                said += f"through the robot's sensor the band holds it (p = {sensed.p_value:.3f})"
            else:
                said += f"the robot's sensor does not explain it (p = {sensed.p_value:.3f})"
        chords = self.chords
        if chords is None:
            return f"{said}."
        agree = "are" if chords.test.p_value > DOUBTFUL else "are not"
        return (
            f"{said}. The chord lengths {agree} those of ideal lines "
            f"(Kolmogorov–Smirnov by whole lines, p = {chords.test.p_value:.3f}; divergence "
            f"{chords.divergence.nats:.3f} nats, of which {chords.divergence.bias_nats:.3f} come of themselves)."
        )
