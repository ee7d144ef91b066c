"""Area and perimeter from lines that contacts with other robots, or stalls, have cut short.

A cut never makes the ratio A/P wrong: the lit path and the crossings are both counted per path rolled,

    A/P = (2/pi) T_lit / n,

whatever ends the lines. Eq. 1 it makes too small, for it takes pairs of crossings away, long ones first (naive
areas lose 21 to 45 %). Where cuts come at random, one per path L on the mean, a pair of crossings the way r
apart is seen with the probability e^(-r/L); counted e^(r/L) times it is restored::

    A = (pi/3) <L3>/<L1>,    L3 = sum over pairs, signed, of r^3 e^(r/L),
    P = A / (A/P).

The sum runs in constant memory, and nothing in it cancels on a line that begins in the dark. With C_m the
sum, over the chords behind the robot, of r^m e^(r/L) at the distance to where it came in less the same at the
distance to where it went out, and E = e^(g/L)::

    over a dark gap g     C_m <- E sum_i binom(m, i) g^(m-i) C_i
    over a lit chord c    L3 += (E - 1) C_3 + E (3 C_2 c + 3 C_1 c^2 + (C_0 + 1) c^3)
                          C_m likewise, with C_0 + 1 for C_0; then C_0 -= 1

and r^4 alike, whose share tells how much the area owes to L. A line may begin in the light: then its first way out
stands alone, C_0 = -1. It may end there: then its last way in stands alone, L3 -= C_3.

L is the lit path per cut in the light. Contacts crowd along the walls and come again where they came before, so
those of the whole arena, told from walls or not, give an L that is too short for the middle, where the light is
(six robots on 120 x 90 cm: 120 cm for 205, and areas 6 to 10 % too large).

What it costs. A pair seen with the probability e^(-r/L) and counted e^(r/L) times has a variance that grows as
e^(r/L), and a crossing whose partner was cut off adds noise and no knowledge. For a square or an annulus of diameter
d the standard error of the area, for the same path rolled, is

    d/L                  0     0.1   0.3   0.5   1     2     3
    over that at 0       1     1.5   2.3   3     5     10    15
    naive area lacks     0     9 %   24 %  35 %  59 %  81 %  90 %

and four times the path halves it. From d = 2 L on a handful of long pairs carries the area, so that its standard error
is itself unsure, and an error in 1/L moves the area by ``reach`` times as much. ``warning`` says so. A/P stays as
sure as it was.

Several robots: merge their sums under one common L, never their estimates. The ratio of small sums is biased and the
weights are convex in 1/L, so noise in L alone makes an area too large; robots of one kind in one arena have the same
L, and all their cuts together know it best.

Pure Python on ``math``, ``array`` and ``robot.onboard`` alone, and so fit for a robot too. Lengths in cm throughout.
"""

import math
from array import array

from robot.onboard import Precision, take_line, take_lines

_NAN = float("nan")
# Of a line: crossings, L1, L3, cuts.
_SIZE = 4
# Relative change of the estimate per relative change of the means.
_OF_AREA = (0.0, -1.0, 1.0)
_OF_PERIMETER = (1.0, -2.0, 1.0)
_OF_RATIO = (-1.0, 1.0, 0.0)
# An area that leans on fewer lines than this, or on pairs of more than this many L, is not to be trusted.
_FEW_LINES = 25.0
_FAR_REACH = 2.0
_FARTHEST = 500.0
# A path per cut is found no shorter than the ball is wide.
_SHORTEST_CM = 7.3


class InterruptedEstimator(Precision):
    """Running estimate of a shape's area and perimeter from lines cut short.

    Per line: ``start_line(lit)``, ``crossing(s_cm, entering)`` for each crossing, then ``end_line(s_cm)``, or
    ``drop_line()``, which leaves the session untouched.

    Attributes:
        path_per_cut_cm: L; infinite where nothing is cut, which gives what ``Estimator`` gives.
        found: Whether L was found from these very lines; the standard errors then hold its own.
        runs: Lines ended.
        lines: Those that saw light.
        crossings: Over all lines.
        cuts: Lines cut in the light.
        path_cm: Path rolled.
        lit_cm: The part of it in the light; ``path_per_cut(lit_cm, cuts)`` finds L.
    """

    __slots__ = (
        "_alone",
        "_began_lit",
        "_c",
        "_comoments",
        "_l1",
        "_l3",
        "_l4",
        "_lit",
        "_means",
        "_n",
        "_rolling",
        "_s_cm",
        "_start_cm",
        "_total_l4",
        "crossings",
        "cuts",
        "found",
        "lines",
        "lit_cm",
        "path_cm",
        "path_per_cut_cm",
        "runs",
    )

    def __init__(self, path_per_cut_cm: float, found: bool = False):
        """Start a session.

        Args:
            path_per_cut_cm: L, above 0; infinite where nothing is cut.
            found: Whether L was found from the lines that follow.

        Raises:
            ValueError: L is not above 0.
        """
        if not path_per_cut_cm > 0.0:
            raise ValueError("the path per cut must be above 0 cm, infinite where nothing is cut")
        self.path_per_cut_cm = path_per_cut_cm
        self.found = found
        self.runs = 0
        self.lines = 0
        self.crossings = 0
        self.cuts = 0
        self.path_cm = 0.0
        self.lit_cm = 0.0
        self._total_l4 = 0.0
        self._means = array("d", [0.0] * _SIZE)  # over all runs
        # Sums of products of deviations from the means, the upper triangle by rows.
        self._comoments = array("d", [0.0] * (_SIZE * (_SIZE + 1) // 2))
        self._c = array("d", [0.0] * 5)
        self._rolling = False

    def start_line(self, lit: bool = False, s_cm: float = 0.0) -> None:
        """Begin a line.

        Args:
            lit: Whether it begins in the light, a contact having ended the one before there. A line that begins
                in the light at the arena's edge begins dark, with a crossing.
            s_cm: Where, on the scale of the crossings.

        Raises:
            ValueError: A line is in progress.
        """
        if self._rolling:
            raise ValueError("a line is in progress: call end_line or drop_line first")
        for m in range(5):
            self._c[m] = 0.0
        self._lit = lit
        self._began_lit = lit
        self._alone = lit  # in the light without having come in
        self._n = 0
        self._start_cm = s_cm
        self._s_cm = s_cm
        self._l1 = 0.0
        self._l3 = 0.0
        self._l4 = 0.0
        self._rolling = True

    def crossing(self, s_cm: float, entering: bool) -> None:
        """Take one crossing of the shape's boundary.

        Args:
            s_cm: Distance along the line.
            entering: Whether the robot went from dark to light.

        Raises:
            ValueError: No line is in progress, or the crossing does not alternate with the one before, lies
                behind it, or so far off that L must be wrong. The line is left as it was; ``drop_line`` is
                the way out.
        """
        if not self._rolling:
            raise ValueError("no line is in progress: call start_line first")
        if entering == self._lit:
            raise ValueError("crossings must alternate, in then out: drop the line")
        step = self._step_to(s_cm)
        if self._alone:
            self._c[0] = -1.0
            self._alone = False
        elif self._n:
            gained_l3, gained_l4 = self._pass(step)
            if self._lit:
                self._l3 += gained_l3
                self._l4 += gained_l4
        if self._lit:
            self._l1 += step
        self._n += 1
        self._lit = entering
        self._s_cm = s_cm

    def _step_to(self, s_cm: float) -> float:
        step = s_cm - self._s_cm
        if not (step >= 0.0 and math.isfinite(s_cm)):  # so that a NaN is refused too
            raise ValueError("a point of the line lies behind the one before it, or nowhere: drop the line")
        if step > _FARTHEST * self.path_per_cut_cm:
            raise ValueError("a line cannot be so much longer than the path per cut: correct that, or drop the line")
        return step

    def _pass(self, step: float) -> tuple[float, float]:
        """Take C over a stretch, lit or dark as it is, and return what C_3 and C_4 gain."""
        c = self._c
        grown = math.exp(step / self.path_per_cut_cm)
        first = c[0] + 1.0 if self._lit else c[0]
        l3 = (grown - 1.0) * c[3] + grown * (step * (3.0 * c[2] + step * (3.0 * c[1] + step * first)))
        l4 = (grown - 1.0) * c[4] + grown * (
            step * (4.0 * c[3] + step * (6.0 * c[2] + step * (4.0 * c[1] + step * first)))
        )
        c[4] += l4
        c[3] += l3
        c[2] = grown * (c[2] + step * (2.0 * c[1] + step * first))
        c[1] = grown * (c[1] + step * first)
        c[0] = grown * c[0] + (grown - 1.0) if self._lit else grown * c[0]
        return l3, l4

    def end_line(self, s_cm: float, cut: bool = True) -> tuple[int, float, float]:
        """End the line in progress and take it into the session.

        Args:
            s_cm: Where it ended.
            cut: Whether, if it ended in the light, a contact or a stall ended it. At the arena's edge, which is
                no cut, its chord is closed, as in ``Estimator``; how it ended in the dark does not matter.

        Returns:
            (crossings, L1, L3) of the line: number, cm, cm^3.

        Raises:
            ValueError: No line is in progress, or the end lies before the last crossing. The line is left as
                it was.
        """
        if not self._rolling:
            raise ValueError("no line is in progress: call start_line first")
        step = self._step_to(s_cm)
        cut = cut and self._lit
        if cut:
            self._l1 += step
            if not self._alone:  # its last way in stands alone
                self._l3 -= self._c[3]
                self._l4 -= self._c[4]
        elif self._lit:
            self.crossing(s_cm, False)
        self._rolling = False
        self.runs += 1
        self.crossings += self._n
        self.path_cm += s_cm - self._start_cm
        self.lit_cm += self._l1
        self.cuts += cut
        if self._n or self._l1 > 0.0:
            self.lines += 1
        self._total_l4 += self._l4
        # A cut shows twice, by where a line ends and by where the next begins; halved between the two, each
        # with the pairs that it lost by it, the standard errors come out right.
        line = (float(self._n), self._l1, self._l3, 0.5 * (self._began_lit + cut))
        take_line(line, self.runs, self._means, self._comoments, _SIZE)
        return self._n, self._l1, self._l3

    def drop_line(self) -> None:
        """Forget the line in progress, as if it had never been; harmless when there is none."""
        self._rolling = False  # start_line clears what it had gathered

    def merge(self, other: "InterruptedEstimator") -> None:
        """Take in the lines of another robot in the same light; ``other`` is left as it was.

        Raises:
            ValueError: The two count with different L.
        """
        if other.path_per_cut_cm != self.path_per_cut_cm or other.found != self.found:
            raise ValueError("sums under different paths per cut cannot be merged: count both with a common one")
        if other.runs == 0:
            return
        take_lines(self.runs, self._means, self._comoments, other.runs, other._means, other._comoments, _SIZE)
        self.runs += other.runs
        self.lines += other.lines
        self.crossings += other.crossings
        self.cuts += other.cuts
        self.path_cm += other.path_cm
        self.lit_cm += other.lit_cm
        self._total_l4 += other._total_l4

    def area(self) -> float:
        """Area in cm^2, (pi/3) <L3>/<L1>; NaN before any light."""
        if self._means[1] == 0.0:
            return _NAN
        return math.pi / 3.0 * self._means[2] / self._means[1]

    def area_over_perimeter(self) -> float:
        """A/P in cm, (2/pi) T_lit / n, free of bias whatever cuts the lines; NaN before the first crossing."""
        if self._means[0] == 0.0:
            return _NAN
        return 2.0 / math.pi * self._means[1] / self._means[0]

    def perimeter(self) -> float:
        """Perimeter in cm, holes included, A / (A/P); NaN before any light."""
        if self._means[1] == 0.0:
            return _NAN
        return self.area() * math.pi / 2.0 * self._means[0] / self._means[1]

    @property
    def reach(self) -> float:
        """Mean distance of the pairs that make the area, as they count, in units of L; NaN before any.

        By this factor a relative error in 1/L goes over into the area.
        """
        total_l3 = self.runs * self._means[2]
        return self._total_l4 / (total_l3 * self.path_per_cut_cm) if total_l3 > 0.0 else _NAN

    @property
    def effective_lines(self) -> float:
        """Number of like lines that would give an L3 as sure as this one, (sum L3)^2 / sum L3^2."""
        square = self.runs * self._means[2] * self._means[2]
        both = square + self._comoments[7]
        return self.runs * square / both if both > 0.0 else 0.0

    @property
    def warning(self) -> str:
        """Why the area should not be trusted, one line; empty when nothing speaks against it."""
        if self.lines == 0:
            return ""
        if not self._means[2] > 0.0:
            return "the cut lines hold no pair of crossings to measure an area by: roll on"
        if self.reach > _FAR_REACH:
            return (
                "the area leans on pairs of crossings "
                + str(round(self.reach, 1))
                + " paths per cut apart: fewer robots, or trust A/P alone"
            )
        if self.effective_lines < _FEW_LINES:
            return "the area leans on as few as " + str(round(self.effective_lines, 1)) + " lines: roll on"
        return ""

    def _covariance(self, one: tuple[float, float, float], two: tuple[float, float, float]) -> float:
        """Relative covariance of two estimates that go as the given powers of <n>, <L1>, <L3>.

        Delta method for independent lines. All estimates are ratios, so runs that meet nothing add nothing:
        N is the number of those that saw light, as in ``Estimator``.
        """
        means = self._means
        if self.lines < 2 or not (means[1] > 0.0 and means[0] > 0.0 and (means[2] > 0.0 or one[2] == two[2] == 0.0)):
            return _NAN
        slopes: list[list[float]] = []
        for powers in (one, two):
            slope = [powers[i] / means[i] if powers[i] else 0.0 for i in range(3)] + [0.0]
            if self.found and powers[2] and means[3] > 0.0:
                # 1/L is cuts over lit path.
                slope[1] -= powers[2] * self.reach / means[1]
                slope[3] += powers[2] * self.reach / means[3]
            slopes.append(slope)
        total = 0.0
        at = 0
        for i in range(_SIZE):
            for j in range(i, _SIZE):
                pair = slopes[0][i] * slopes[1][j]
                total += self._comoments[at] * (pair if i == j else pair + slopes[0][j] * slopes[1][i])
                at += 1
        if one is two and total < 0.0:  # rounding, where all lines are alike
            total = 0.0
        return total / (self.runs * self.runs) * self.lines / (self.lines - 1.0)

    def covariance(self) -> tuple[float, float, float]:
        """Variance of A (cm^4), covariance of A and P (cm^3), variance of P (cm^2); NaN before the second line."""
        area, perimeter = self.area(), self.perimeter()
        return (
            self._covariance(_OF_AREA, _OF_AREA) * area * area,
            self._covariance(_OF_AREA, _OF_PERIMETER) * area * perimeter,
            self._covariance(_OF_PERIMETER, _OF_PERIMETER) * perimeter * perimeter,
        )

    def sigma_area_over_perimeter(self) -> float:
        """Standard error of ``area_over_perimeter()`` in cm; NaN before the second line."""
        return math.sqrt(self._covariance(_OF_RATIO, _OF_RATIO)) * self.area_over_perimeter()


def path_per_cut(path_cm: float, cuts: int) -> float:
    """L in cm, the path rolled per cut; infinite when nothing was cut.

    The maximum of the likelihood when cuts come at random along the path, lines that end otherwise included; but no
    less than a ball's width, for a first cut after a hair of light would make every weight nonsense.
    See the head of this module for why both are best counted in the light alone.
    """
    return max(_SHORTEST_CM, path_cm / cuts) if cuts else math.inf
