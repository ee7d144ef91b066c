"""The on-board estimator on lines that miss, are dropped, end lit or are wrong; its memory and its imports."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest

import robot.onboard
from robot.onboard import Estimator
from tests.robot.drawnlines import annulus_lines, roll, rolled


def test_lines_are_forgotten_between_lines():
    estimator = Estimator()
    first = roll(estimator, [1.0, 4.0, 9.0, 11.0])
    roll(estimator, [0.5, 30.0])
    assert roll(estimator, [1.0, 4.0, 9.0, 11.0]) == first


def test_runs_that_miss_the_shape_do_not_count_as_lines():
    estimator = Estimator()
    assert roll(estimator, []) == (0, 0.0, 0.0)
    assert math.isnan(estimator.area())
    assert math.isnan(estimator.means()[0])
    roll(estimator, [1.0, 4.0])
    area = estimator.area()
    roll(estimator, [])
    assert (estimator.runs, estimator.lines, estimator.chords) == (3, 1, 1)
    assert estimator.area() == area == pytest.approx(math.pi / 3 * 9)
    assert estimator.perimeter() == pytest.approx(math.pi * area / 3)


def test_a_dropped_line_has_never_been():
    rng = np.random.default_rng(10)
    kept, dropped = Estimator(), Estimator()
    for line in annulus_lines(20, 12.0, 6.0, rng):
        roll(kept, line)
        dropped.start_line()
        for order, s_cm in enumerate(line[: rng.integers(1, len(line) + 1)]):
            dropped.crossing(s_cm, order % 2 == 0)
        dropped.drop_line()
        roll(dropped, line)
    assert dropped.covariance() == kept.covariance()
    assert (dropped.runs, dropped.lines, dropped.chords) == (kept.runs, kept.lines, kept.chords)
    kept.drop_line()  # none in progress: harmless
    assert dropped.area() == kept.area()


def test_a_line_that_ends_lit_is_closed_at_its_end():
    estimator = Estimator()
    estimator.start_line()
    estimator.crossing(2.0, True)
    with pytest.raises(ValueError, match="ended in the light"):
        estimator.end_line()
    assert estimator.runs == 0
    assert estimator.end_line(7.0) == (1, 5.0, 125.0)
    estimator.start_line()
    estimator.crossing(2.0, True)
    estimator.crossing(7.0, False)
    assert estimator.end_line(9.0) == (1, 5.0, 125.0)  # in the dark, the end adds nothing


def test_refused_calls_leave_the_line_as_it_was():
    estimator = Estimator()
    for call in (lambda: estimator.crossing(1.0, True), estimator.end_line):
        with pytest.raises(ValueError, match="no line is in progress"):
            call()
    estimator.start_line()
    with pytest.raises(ValueError, match="in progress"):
        estimator.start_line()
    with pytest.raises(ValueError, match="alternate"):
        estimator.crossing(1.0, False)
    with pytest.raises(ValueError, match="nowhere"):
        estimator.crossing(math.nan, True)
    estimator.crossing(1.0, True)
    with pytest.raises(ValueError, match="alternate"):
        estimator.crossing(2.0, True)
    with pytest.raises(ValueError, match="behind"):
        estimator.crossing(0.5, False)
    estimator.crossing(3.0, False)
    with pytest.raises(ValueError, match="behind"):
        estimator.crossing(2.5, True)
    assert estimator.end_line() == (1, 2.0, 8.0)


def test_sigmas_where_they_are_not_known():
    single = rolled([[0.0, 3.0]])
    assert all(math.isnan(value) for value in (single.sigma_area(), single.sigma_perimeter(), single.correlation()))
    alike = rolled([[0.0, 3.0]] * 5)
    assert alike.sigma_area() == pytest.approx(0.0, abs=1e-9)
    assert math.isnan(alike.correlation())
    without = rolled([[0.0, 3.0], [0.0, 4.0]], covariance=False)
    assert math.isnan(without.sigma_perimeter())
    assert without.area() == pytest.approx(math.pi / 3 * 91 / 7)
    nothing = rolled([[1.0, 1.0]])  # a chord of no length
    assert math.isnan(nothing.area() + nothing.perimeter())


def test_memory_is_constant():
    """No attribute beyond the slots, and none of them grows with the session."""

    def size(estimator):
        values = [getattr(estimator, slot) for slot in Estimator.__slots__]
        return sum(len(value) if hasattr(value, "__len__") else 1 for value in values)

    estimator = Estimator()
    before = size(estimator)
    for line in annulus_lines(500, 12.0, 6.0, np.random.default_rng(11)):
        roll(estimator, line)
    assert not hasattr(estimator, "__dict__")
    assert size(estimator) == before == 24


def test_module_keeps_to_micropython():
    """Imports, syntax and ``math`` names that every MicroPython build has; none of its gaps."""
    tree = ast.parse(Path(robot.onboard.__file__).read_text(encoding="utf-8"))
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(node.module)
    assert imported == {"math", "array"}
    unsupported = (ast.Match, ast.TryStar, ast.JoinedStr, ast.AsyncFunctionDef, ast.Starred, ast.NamedExpr)
    assert [type(node).__name__ for node in ast.walk(tree) if isinstance(node, unsupported)] == []
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    assert all(not function.args.posonlyargs and not function.decorator_list for function in functions)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    assert all(len(cls.bases) < 2 and not cls.keywords and not cls.decorator_list for cls in classes)
    math_names = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "math"
    }
    assert math_names <= {"pi", "sqrt", "isfinite"}
