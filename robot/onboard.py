"""Area and perimeter from the crossings of random lines, in constant memory: what runs on the robot.

Eq. 1 needs the signed sums over all pairs of crossings of a line (in-out pairs +, in-in and out-out
pairs -), L_n = sum +-l^n. Two accumulators carry them from crossing to crossing instead of a store of
pairs, and both only ever grow, so nothing cancels. With C_j the sum, over the chords behind the robot,
of (distance to where it came in)^j - (distance to where it went out)^j::

    over a dark gap g     C2 += 2 g C1
    over a lit chord c    L3 += 3 C2 c + 3 C1 c^2 + c^3;  C2 += 2 C1 c + c^2;  C1 += c
    at the line's end     L1 = C1

On request C3 and C4 are carried too, for L4 and L5 (binomial theorem; L_n gains what C_n gains in the light).
From the means over the lines that cross the shape,

    A = (pi/3) <L3>/<L1>,    P = pi A <k>/<L1>,
    mean distance of two of its points = <L4>/(2 <L3>),    R_g^2 = 3 <L5>/(20 <L3>),

the last two because the integral of L_n over all lines is n (n - 1)/2 times that of r^(n - 3) over all pairs of points.
Lines that were drawn with unequal probability are each given a weight that undoes it, 1/probability up to a
common factor: the means are then those of weight (k, L1, L3).

(The paper prints 3/pi in its Eq. 1; a disc's chords, <l> = pi R/2 and <l^3> = 3 pi R^3/2, show that the
fraction stands on its head.) The signed sums are those of Vlasov, arXiv:0711.4734.

Pure Python on ``math`` and ``array`` alone, so that the same file runs under MicroPython on a robot that
takes user code, and at the end of the link of one that does not. Lengths in cm throughout.
"""

import math
from array import array

_NAN = float("nan")


def _check_weight(weight: float) -> None:
    if not (weight > 0.0 and math.isfinite(weight)):
        raise ValueError("a line's weight must be a finite number above 0: check the turning policy")


def take_line(
    line: "list[float] | tuple[float, ...]",
    lines: int,
    means: "array[float]",
    comoments: "array[float] | None",
    size: int,
) -> None:
    """Take one more line, the ``lines``-th, into means and co-moments: Welford's recursion.

    Args:
        line: Its values.
        lines: Their number with it.
        means: Of all values; changed in place.
        comoments: Sums of products of deviations of the first ``size`` values from their means, the upper triangle by
            rows; changed in place. None where they are not kept.
        size: How many values have them.
    """
    before = [line[i] - means[i] for i in range(len(line))]
    for i in range(len(line)):
        means[i] += before[i] / lines
    if comoments is not None:
        at = 0
        for i in range(size):
            for j in range(i, size):
                comoments[at] += before[i] * (line[j] - means[j])
                at += 1


def take_lines(
    lines: int,
    means: "array[float]",
    comoments: "array[float] | None",
    more: int,
    means_more: "array[float]",
    comoments_more: "array[float] | None",
    size: int,
) -> None:
    """Take ``more`` lines into means and co-moments of ``lines``, as in `take_line`; what is added is left as it was.

    The parallel form of Welford's recursion (Chan, Golub and LeVeque 1979).
    """
    both = lines + more
    apart = [means_more[i] - means[i] for i in range(len(means))]
    if comoments is not None and comoments_more is not None:
        weight = lines * more / both
        at = 0
        for i in range(size):
            for j in range(i, size):
                comoments[at] += comoments_more[at] + weight * apart[i] * apart[j]
                at += 1
    for i in range(len(apart)):
        means[i] += apart[i] * more / both


class Precision:
    """Standard errors of an estimate, from its ``covariance()``."""

    __slots__ = ()

    def covariance(self) -> tuple[float, float, float]:
        """Variance of A (cm^4), covariance of A and P (cm^3), variance of P (cm^2); NaN where none is kept."""
        return _NAN, _NAN, _NAN

    def sigma_area(self) -> float:
        """Standard error of ``area()`` in cm^2; NaN before the second line."""
        return math.sqrt(self.covariance()[0])

    def sigma_perimeter(self) -> float:
        """Standard error of ``perimeter()`` in cm; NaN before the second line."""
        return math.sqrt(self.covariance()[2])

    def correlation(self) -> float:
        """Correlation of the errors of area and perimeter; NaN where one of them has no spread."""
        area_area, area_perimeter, perimeter_perimeter = self.covariance()
        scale = math.sqrt(area_area) * math.sqrt(perimeter_perimeter)
        return area_perimeter / scale if scale > 0.0 else _NAN


class Estimator(Precision):
    """Running estimate of a shape's area and perimeter.

    Per line: ``start_line()``, ``crossing(s_cm, entering)`` for each crossing, then ``end_line(s_cm)``, or
    ``drop_line()`` when the run was cut short (a lost link, a stall), which leaves the session untouched.

    A line that ends in the light is closed at its end, for the ball's centre has then reached the edge of
    what it can reach, and the shape that is measured is the part of the light within that; closing keeps
    the sums exact for that part, dropping would favour the lines that end in the dark.

    Attributes:
        runs: Lines ended, whether they met the shape or not.
        lines: Lines that crossed the shape (k >= 1): the N of the means.
        chords: Lit stretches, over all lines.
    """

    __slots__ = (
        "_c1",
        "_c2",
        "_c3",
        "_c4",
        "_comoments",
        "_higher",
        "_k",
        "_l3",
        "_l4",
        "_l5",
        "_lit",
        "_means",
        "_rolling",
        "_s_cm",
        "chords",
        "lines",
        "runs",
    )

    def __init__(self, covariance: bool = True, higher: bool = False):
        """Start a session.

        Args:
            covariance: Keep the six co-moments; without them the sigmas are NaN.
            higher: Keep L4 and L5 too, six numbers more; without them the two distances are NaN.
        """
        self._higher = higher
        self.runs = 0
        self.lines = 0
        self.chords = 0
        self._means = array("d", [0.0] * (5 if higher else 3))  # of weight (k, L1, L3, L4, L5)
        # Sums of products of deviations from the means, the upper triangle by rows: kk, k1, k3, 11, 13, 33.
        self._comoments = array("d", [0.0] * 6) if covariance else None
        self._rolling = False
        self._clear_line()

    def _clear_line(self) -> None:
        self._lit = False
        self._k = 0
        self._s_cm = 0.0  # of the last crossing
        self._c1 = 0.0
        self._c2 = 0.0
        self._c3 = 0.0
        self._c4 = 0.0
        self._l3 = 0.0
        self._l4 = 0.0
        self._l5 = 0.0

    def start_line(self) -> None:
        """Begin a line, in the dark.

        Raises:
            ValueError: A line is in progress.
        """
        if self._rolling:
            raise ValueError("a line is in progress: call end_line or drop_line first")
        self._clear_line()
        self._rolling = True

    def crossing(self, s_cm: float, entering: bool) -> None:
        """Take one crossing of the shape's boundary.

        Args:
            s_cm: Distance along the line, from any origin.
            entering: Whether the robot went from dark to light.

        Raises:
            ValueError: No line is in progress, or the crossing does not alternate with the one before or
                lies behind it. The line is left as it was; ``drop_line`` is the way out.
        """
        if not self._rolling:
            raise ValueError("no line is in progress: call start_line first")
        if entering == self._lit:
            raise ValueError("crossings must alternate, in then out: drop the line")
        step = s_cm - self._s_cm if self._k or self._lit else 0.0
        if not (step >= 0.0 and math.isfinite(s_cm)):  # so that a NaN is refused too
            raise ValueError("a crossing lies behind the one before it, or nowhere: drop the line")
        if entering:
            if self._higher:
                self._move_on(step)
            self._c2 += 2.0 * step * self._c1
        else:
            if self._higher:
                self._pass_chord(step)
            self._l3 += step * (3.0 * self._c2 + step * (3.0 * self._c1 + step))
            self._c2 += step * (2.0 * self._c1 + step)
            self._c1 += step
            self._k += 1
        self._lit = entering
        self._s_cm = s_cm

    def _move_on(self, gap: float) -> None:
        """Take C3 and C4 over a dark gap; before C1 and C2 are, and C4 before C3."""
        c1, c2 = self._c1, self._c2
        self._c4 += gap * (4.0 * self._c3 + gap * (6.0 * c2 + gap * 4.0 * c1))
        self._c3 += gap * (3.0 * c2 + gap * 3.0 * c1)

    def _pass_chord(self, chord: float) -> None:
        """Take L4, L5, C3 and C4 over a lit chord; before C1 and C2 are."""
        c1, c2, c3 = self._c1, self._c2, self._c3
        gained = chord * (4.0 * c3 + chord * (6.0 * c2 + chord * (4.0 * c1 + chord)))
        self._l4 += gained
        self._l5 += chord * (5.0 * self._c4 + chord * (10.0 * c3 + chord * (10.0 * c2 + chord * (5.0 * c1 + chord))))
        self._c4 += gained
        self._c3 += chord * (3.0 * c2 + chord * (3.0 * c1 + chord))

    def end_line(self, s_cm: float | None = None, weight: float = 1.0) -> tuple[int, float, float]:
        """End the line in progress and take it into the session.

        Args:
            s_cm: Where the line ended; needed when it ended in the light, to close the last chord.
            weight: Undoes the probability that such a line had to be drawn.

        Returns:
            (k, L1, L3) of the line, not weighted: chords, cm, cm^3; (0, 0.0, 0.0) if it met no light.

        Raises:
            ValueError: No line is in progress, or it ended in the light and ``s_cm`` is missing or lies
                before the last crossing, or the weight is not a finite number above 0. The line is left
                as it was.
        """
        if not self._rolling:
            raise ValueError("no line is in progress: call start_line first")
        _check_weight(weight)
        if self._lit:
            if s_cm is None:
                raise ValueError("the line ended in the light: give end_line its end, or drop the line")
            self.crossing(s_cm, False)
        self._rolling = False
        self.add_line(self._k, self._c1, self._l3, weight, self._l4, self._l5)
        return self._k, self._c1, self._l3

    def higher_of_line(self) -> tuple[float, float]:
        """(L4, L5) of the line up to its last crossing, cm^4 and cm^5; NaN in a session without ``higher``."""
        return (self._l4, self._l5) if self._higher else (_NAN, _NAN)

    def drop_line(self) -> None:
        """Forget the line in progress, as if it had never been; harmless when there is none."""
        self._rolling = False  # start_line clears what it had gathered

    def add_line(
        self,
        k: int,
        l1_cm: float,
        l3_cm3: float,
        weight: float = 1.0,
        l4_cm4: float | None = None,
        l5_cm5: float | None = None,
    ) -> None:
        """Take a finished line into the session: the running means and co-moments.

        ``end_line`` calls this; a resumed session calls it with the lines it has stored.

        Raises:
            ValueError: The weight is not a finite number above 0, or the session keeps the higher
                invariants and they are missing. The session is left as it was.
        """
        _check_weight(weight)
        line = [k * weight, l1_cm * weight, l3_cm3 * weight]
        if self._higher:
            if l4_cm4 is None or l5_cm5 is None:
                raise ValueError("this session keeps L4 and L5: give add_line both, or start it without higher")
            line += [l4_cm4 * weight, l5_cm5 * weight]
        self.runs += 1
        if k == 0:
            return
        self.lines += 1
        self.chords += k
        take_line(line, self.lines, self._means, self._comoments, 3)

    def merge(self, other: "Estimator") -> None:
        """Take in the lines of another robot in the same light: sufficient statistics, never estimates.

        A session without covariance, or without the higher invariants, on either side ends without. ``other`` is
        left as it was.
        """
        self.runs += other.runs
        if other._comoments is None:
            self._comoments = None
        if self._higher and not other._higher:
            self._higher = False
            self._means = array("d", [self._means[0], self._means[1], self._means[2]])
        if other.lines == 0:
            return
        take_lines(self.lines, self._means, self._comoments, other.lines, other._means, other._comoments, 3)
        self.lines += other.lines
        self.chords += other.chords

    def means(self) -> tuple[float, float, float]:
        """Means of weight (k, L1, L3) over the lines that cross; NaN before the first."""
        if self.lines == 0:
            return _NAN, _NAN, _NAN
        return self._means[0], self._means[1], self._means[2]

    def area(self) -> float:
        """Area in cm^2, (pi/3) <L3>/<L1>; NaN before the first line of some length."""
        if self._means[1] == 0.0:
            return _NAN
        return math.pi / 3.0 * self._means[2] / self._means[1]

    def perimeter(self) -> float:
        """Perimeter in cm, holes included, pi A <k>/<L1>; NaN before the first line of some length."""
        if self._means[1] == 0.0:
            return _NAN
        return math.pi * self.area() * self._means[0] / self._means[1]

    def radius_of_gyration(self) -> float:
        """Root mean square distance of the shape's points from its centroid, cm, sqrt(3 <L5>/(20 <L3>)).

        NaN before the first line of some length, and in a session without ``higher``.
        """
        if not self._higher or self._means[2] == 0.0:
            return _NAN
        return math.sqrt(0.15 * self._means[4] / self._means[2])

    def mean_pair_distance(self) -> float:
        """Mean distance of two points drawn evenly over the shape, cm, <L4>/(2 <L3>).

        NaN before the first line of some length, and in a session without ``higher``.
        """
        if not self._higher or self._means[2] == 0.0:
            return _NAN
        return 0.5 * self._means[3] / self._means[2]

    def covariance(self) -> tuple[float, float, float]:
        """Variance of A (cm^4), covariance of A and P (cm^3), variance of P (cm^2).

        Delta method on log A = log<L3> - log<L1> and log P = log<L3> + log<k> - 2 log<L1>, for independent
        lines, weighted or not. NaN before the second line, and in a session without covariance.
        """
        if self._comoments is None or self.lines < 2 or not (self._means[1] > 0.0 and self._means[2] > 0.0):
            return _NAN, _NAN, _NAN
        k, l1, l3 = self.means()
        kk, k1, k3, m11, m13, m33 = self._comoments
        # Relative co-moments; the variance of a mean is the comoment / (N (N - 1)).
        scale = 1.0 / (self.lines * (self.lines - 1.0))
        kk, k1, k3 = kk / (k * k) * scale, k1 / (k * l1) * scale, k3 / (k * l3) * scale
        m11, m13, m33 = m11 / (l1 * l1) * scale, m13 / (l1 * l3) * scale, m33 / (l3 * l3) * scale
        area, perimeter = self.area(), self.perimeter()
        area_area = m33 - 2.0 * m13 + m11
        area_perimeter = m33 + k3 - 3.0 * m13 - k1 + 2.0 * m11
        perimeter_perimeter = m33 + kk + 4.0 * m11 + 2.0 * k3 - 4.0 * m13 - 4.0 * k1
        return (
            max(0.0, area_area) * area * area,  # rounding may leave -1e-20 where all lines are alike
            area_perimeter * area * perimeter,
            max(0.0, perimeter_perimeter) * perimeter * perimeter,
        )
