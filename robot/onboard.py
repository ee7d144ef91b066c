"""Area and perimeter from the crossings of random lines, in constant memory: what runs on the robot.

Eq. 1 needs the signed sums over all pairs of crossings of a line (in-out pairs +, in-in and out-out
pairs -), L_n = sum +-l^n. Two accumulators carry them from crossing to crossing instead of a store of
pairs, and both only ever grow, so nothing cancels. With C_j the sum, over the chords behind the robot,
of (distance to where it came in)^j - (distance to where it went out)^j::

    over a dark gap g     C2 += 2 g C1
    over a lit chord c    L3 += 3 C2 c + 3 C1 c^2 + c^3;  C2 += 2 C1 c + c^2;  C1 += c
    at the line's end     L1 = C1

From the means over the lines that cross the shape,

    A = (pi/3) <L3>/<L1>,    P = pi A <k>/<L1>.

(The paper prints 3/pi in its Eq. 1; a disc's chords, <l> = pi R/2 and <l^3> = 3 pi R^3/2, show that the
fraction stands on its head.) The signed sums are those of Vlasov, arXiv:0711.4734.

Pure Python on ``math`` and ``array`` alone, so that the same file runs under MicroPython on a robot that
takes user code, and at the end of the link of one that does not. Lengths in cm throughout.
"""

import math
from array import array

_NAN = float("nan")


class Estimator:
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
        "_comoments",
        "_k",
        "_l3",
        "_lit",
        "_means",
        "_rolling",
        "_s_cm",
        "chords",
        "lines",
        "runs",
    )

    def __init__(self, covariance: bool = True):
        """Start a session; without ``covariance`` six numbers are not kept and the sigmas are NaN."""
        self.runs = 0
        self.lines = 0
        self.chords = 0
        self._means = array("d", [0.0, 0.0, 0.0])  # of (k, L1, L3)
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
        self._l3 = 0.0

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
            self._c2 += 2.0 * step * self._c1
        else:
            self._l3 += step * (3.0 * self._c2 + step * (3.0 * self._c1 + step))
            self._c2 += step * (2.0 * self._c1 + step)
            self._c1 += step
            self._k += 1
        self._lit = entering
        self._s_cm = s_cm

    def end_line(self, s_cm: float | None = None) -> tuple[int, float, float]:
        """End the line in progress and take it into the session.

        Args:
            s_cm: Where the line ended; needed when it ended in the light, to close the last chord.

        Returns:
            (k, L1, L3) of the line: chords, cm, cm^3; (0, 0.0, 0.0) if it met no light.

        Raises:
            ValueError: No line is in progress, or it ended in the light and ``s_cm`` is missing or lies
                before the last crossing.
        """
        if not self._rolling:
            raise ValueError("no line is in progress: call start_line first")
        if self._lit:
            if s_cm is None:
                raise ValueError("the line ended in the light: give end_line its end, or drop the line")
            self.crossing(s_cm, False)
        self._rolling = False
        self.add_line(self._k, self._c1, self._l3)
        return self._k, self._c1, self._l3

    def drop_line(self) -> None:
        """Forget the line in progress, as if it had never been; harmless when there is none."""
        self._rolling = False  # start_line clears what it had gathered

    def add_line(self, k: int, l1_cm: float, l3_cm3: float) -> None:
        """Take a finished line into the session: the running means and Welford's co-moments.

        ``end_line`` calls this; a resumed session calls it with the lines it has stored.
        """
        self.runs += 1
        if k == 0:
            return
        self.lines += 1
        self.chords += k
        before = (k - self._means[0], l1_cm - self._means[1], l3_cm3 - self._means[2])
        for i in range(3):
            self._means[i] += before[i] / self.lines
        if self._comoments is not None:
            after = (k - self._means[0], l1_cm - self._means[1], l3_cm3 - self._means[2])
            at = 0
            for i in range(3):
                for j in range(i, 3):
                    self._comoments[at] += before[i] * after[j]
                    at += 1

    def merge(self, other: "Estimator") -> None:
        """Take in the lines of another robot in the same light: sufficient statistics, never estimates.

        The parallel form of Welford's recursion (Chan, Golub and LeVeque 1979). A session without
        covariance on either side ends without. ``other`` is left as it was.
        """
        both = self.lines + other.lines
        self.runs += other.runs
        if other._comoments is None:
            self._comoments = None
        if other.lines == 0:
            return
        apart = (
            other._means[0] - self._means[0],
            other._means[1] - self._means[1],
            other._means[2] - self._means[2],
        )
        if self._comoments is not None and other._comoments is not None:
            weight = self.lines * other.lines / both
            at = 0
            for i in range(3):
                for j in range(i, 3):
                    self._comoments[at] += other._comoments[at] + weight * apart[i] * apart[j]
                    at += 1
        for i in range(3):
            self._means[i] += apart[i] * other.lines / both
        self.lines = both
        self.chords += other.chords

    def means(self) -> tuple[float, float, float]:
        """Means of (k, L1, L3) over the lines that cross; NaN before the first."""
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

    def covariance(self) -> tuple[float, float, float]:
        """Variance of A (cm^4), covariance of A and P (cm^3), variance of P (cm^2).

        Delta method on log A = log<L3> - log<L1> and log P = log<L3> + log<k> - 2 log<L1>, for independent
        lines. NaN before the second line, and in a session without covariance.
        """
        if self._comoments is None or self.lines < 2 or not (self._means[1] > 0.0 and self._means[2] > 0.0):
            return _NAN, _NAN, _NAN
        k, l1, l3 = self._means
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
