"""Sessions whose runs end at light or at a wall, turned by each policy: against shapely, line by line and in sum."""

import json
import math

import numpy as np
import pytest
from shapely import LineString, Point, box

from lab.base.errors import RequestError
from lab.session.run import Run
from lab.settings.load import parse_settings
from robot.crossings import CrossingDetector, Levels
from robot.device import Sample
from robot.turning import Leg
from tests.lab.traces import area_perimeter, pair_sum, rolled

N = 60
DISC = {"arena__kind": "disc", "arena__radius_cm": 46.0, "shape": "circle", "arena__ring_cm": 7.0}
UNIFORM = {"motion__turning": "uniform", "motion__weighting": "run_length"}
INTERIOR = {"motion__turning": "interior"}
SESSIONS = {
    "dark rectangle": {"arena__edge": "dark_ring"},
    "bright rectangle": {"arena__edge": "bright_ring"},
    "dark disc": {"arena__edge": "dark_ring", **DISC},
    "lambert disc": DISC,
    "uniform disc": UNIFORM | DISC,
    "uniform dark disc": {"arena__edge": "dark_ring", **UNIFORM, **DISC},
    "interior": INTERIOR,
    "interior bright": {"arena__edge": "bright_ring", **INTERIOR},
}
# Standard errors of one line's area and perimeter: of a square by quadrature, of a circle from the moments of its
# chords, 2R √(1 − u²) with u even in (0, 1).
MOMENT = {n: math.gamma(n / 2 + 1) * math.gamma(0.5) / (2 * math.gamma(n / 2 + 1.5)) for n in (1, 2, 3, 4, 6)}
COMMON = MOMENT[6] / MOMENT[3] ** 2
CIRCLE_A = math.sqrt(COMMON - 2 * MOMENT[4] / (MOMENT[1] * MOMENT[3]) + MOMENT[2] / MOMENT[1] ** 2)
CIRCLE_P = math.sqrt(COMMON - 4 * MOMENT[4] / (MOMENT[1] * MOMENT[3]) + 4 * MOMENT[2] / MOMENT[1] ** 2 - 1)
SHAPES = {"square": (box(-22, -22, 22, 22), 0.393, 0.337), "circle": (Point(0, 0).buffer(32, 90), CIRCLE_A, CIRCLE_P)}


@pytest.fixture(scope="session", params=SESSIONS)
def session(request, tmp_path_factory):
    """Sixty lines of a robot that rolls as straight and as fast as it is told; its true path is kept."""
    found = rolled(
        tmp_path_factory.mktemp("edge"),
        stop__lines=N,
        seed=3,
        virtual__speed_error_sigma=0,
        virtual__heading_drift_rad_per_cm=0,
        **SESSIONS[request.param],
    )
    assert found.finished.failure is None
    return found


def settings_of(session):
    stored = json.loads((session.folder / "manifest.json").read_text())["settings"]
    return parse_settings(stored, origin="manifest")


def inside(session):
    """The polygon in which the lines are uniform, drawn here."""
    arena = settings_of(session).arena
    off_cm = 3.65 if arena.edge == "bump" else arena.ring_cm
    if arena.kind == "disc":
        return Point(0, 0).buffer(arena.radius_cm - off_cm, quad_segs=500)
    return box(-60 + off_cm, -45 + off_cm, 60 - off_cm, 45 - off_cm)


def true_paths(session):
    """Of each line of the statistics: (run, the straight way that the body took, far beyond both its ends)."""
    (body,) = session.bodies
    trace = np.array(body.trace)
    found = []
    for run in session.runs:
        if not run["whole"]:
            continue
        during = (trace[:, 0] >= run["t_start_s"]) & (trace[:, 0] <= run["t_end_s"])
        x_cm, y_cm = trace[during, 1:].T
        step = np.array([x_cm[-1] - x_cm[0], y_cm[-1] - y_cm[0]])
        far = 300 * step / np.hypot(*step)
        found.append((run, LineString([(x_cm[0] - far[0], y_cm[0] - far[1]), (x_cm[-1] + far[0], y_cm[-1] + far[1])])))
    return found


def test_area_and_perimeter_are_those_of_the_shape(session):
    shape, sigma_area, sigma_perimeter = SHAPES[settings_of(session).shape]
    last = session.runs[-1]["estimate"]
    assert last["n"] == N
    # The robot's own standard error, or that of as many lines of the shape where chance made its own too small.
    area = max(last["sigma_area_cm2"], sigma_area * shape.area / math.sqrt(N))
    perimeter = max(last["sigma_perimeter_cm"], sigma_perimeter * shape.length / math.sqrt(N))
    assert abs(last["area_cm2"] - shape.area) < 3.5 * area
    assert abs(last["perimeter_cm"] - shape.length) < 3.5 * perimeter
    assert last["sigma_area_cm2"] < 2 * sigma_area * shape.area / math.sqrt(N)


def test_each_line_met_what_the_shape_has_on_its_way(session):
    shape, _, _ = SHAPES[settings_of(session).shape]
    paths = true_paths(session)
    assert len(paths) >= N
    off_cm = []
    for run, path in paths:
        true_cm = path.intersection(shape).length
        if true_cm > 5:  # the sensor looks every 0.74 cm, and a corner may slip through
            off_cm.append(pair_sum(run["crossings"], 1) - true_cm)
    assert len(off_cm) >= 0.8 * N
    assert np.median(off_cm) == pytest.approx(0, abs=0.25)
    assert np.quantile(np.abs(off_cm), 0.9) < 1.0


def odometer_scale(session):
    """What the wheels count for each true centimetre: hidden from the robot, the same in all its runs."""
    (body,) = session.bodies
    trace = np.array(body.trace)
    ratios = []
    for run in session.runs:
        light = session.light(run["line"])
        if run["length_cm"] > 30:
            first, last = (trace[np.argmin(np.abs(trace[:, 0] - t_s)), 1:] for t_s in light["t_host_s"].iloc[[0, -1]])
            counted_cm = math.hypot(*(light[axis].iloc[-1] - light[axis].iloc[0] for axis in ("x_cm", "y_cm")))
            ratios.append(counted_cm / math.dist(first, last))
    return float(np.median(ratios))


def test_runs_are_as_long_as_the_arena_is_wide_there_and_never_longer(session):
    polygon, scale = inside(session), odometer_scale(session)
    left, bottom, right, top = polygon.bounds
    longest_cm = right - left if settings_of(session).arena.kind == "disc" else math.hypot(right - left, top - bottom)
    assert max(run["length_cm"] for run in session.runs) < 1.01 * longest_cm
    assert scale == pytest.approx(1, abs=0.03)
    off_cm = [run["length_cm"] / scale - path.intersection(polygon).length for run, path in true_paths(session)]
    assert np.median(off_cm) == pytest.approx(0, abs=0.6)  # a ring brighter than the shape is met late at both ends
    assert np.quantile(np.abs(off_cm), 0.85) < 1.0


def test_lines_end_at_the_edge_that_was_asked_for(session):
    polygon, settings = inside(session), settings_of(session)
    ends = {run["ended"] for run in session.runs if run["whole"]}
    assert ends == {"bump" if settings.arena.edge == "bump" else "edge"}
    (body,) = session.bodies
    trace = np.array(body.trace)
    for run, _ in true_paths(session):
        at = np.searchsorted(trace[:, 0], run["t_end_s"])
        assert polygon.exterior.distance(Point(trace[at, 1:])) < 1.3


def test_the_estimate_follows_from_the_crossings_and_from_weights_by_the_policy(session):
    """Weights from the way by the stored odometer: 1/length for interior stops, length for uniform turns in a disc."""
    motion = settings_of(session).motion
    lines = [run for run in session.runs if run["counts"]]
    for run in lines:
        light = session.light(run["line"])
        way_cm = np.hypot(light["x_cm"].diff(), light["y_cm"].diff()).sum()
        wanted = {"interior": 1 / way_cm, "uniform": way_cm, "lambert": 1.0}[motion.turning]
        assert run["weight"] == pytest.approx(wanted)
    area, perimeter = area_perimeter(lines)
    assert lines[-1]["estimate"]["area_cm2"] == pytest.approx(area)
    assert lines[-1]["estimate"]["perimeter_cm"] == pytest.approx(perimeter)


def test_the_log_keeps_each_levels_light(session):
    (start,) = session.told("start")
    (levels,) = start["levels"]
    black, white = 5 + 15, 105 + 15  # of the virtual projector, and the room
    share = {"bump": (0, 1), "dark_ring": (0.4, 1), "bright_ring": (0, 0.4)}[settings_of(session).arena.edge]
    assert levels["shape"]["dark_lux"] == pytest.approx(black + share[0] * (white - black), abs=2)
    assert levels["shape"]["bright_lux"] == pytest.approx(black + share[1] * (white - black), abs=2)


def test_a_line_that_grazes_a_felt_edge_is_no_longer_than_the_arena():
    """The way back to the edge grows beyond all bounds along a straight one; a corner cuts it off."""
    detector = CrossingDetector(Levels(20.0, 120.0, 60.0, 70.0, 80.0))
    for run_up_cm, length_cm in ((7.0, 47.0), (5000.0, 130.0)):
        run = Run(3, "SB-0001", Leg(0.0, None, True), 0.0, 15.0, False, detector, run_up_cm, 130.0)
        for i in range(41):
            run.feed(Sample(t_host_s=i / 15, light_lux=20.0, x_cm=0.0, y_cm=float(i), speed_cm_s=15.0))
        assert run.length_cm == pytest.approx(length_cm)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"motion.turning": "uniform", "motion.weighting": "run_length"}, "disc"),
        ({"motion.turning": "interior", "motion.weighting": "run_length"}, "1/length"),
        ({"motion.weighting": "run_length", "arena.kind": "disc"}, "lambert"),
        ({"arena.edge": "dark_ring", "arena.ring_cm": 46.0}, "ring of 46 cm"),
        ({"arena.edge": "bright_ring", "arena.ring_cm": 22.5}, "does not fit"),
        ({"arena.edge": "dark_ring", "arena.kind": "disc"}, "ring falls beyond the projector"),
        ({"arena.edge": "dark_ring", "arena.ring_cm": 1.0}, "ring_cm"),
        ({"arena.edge": "hedge"}, "arena.edge"),
    ],
)
def test_what_cannot_be_rolled_is_refused_in_one_line_before_a_folder_is_made(tmp_path, overrides, says):
    with pytest.raises(RequestError, match=says) as caught:
        rolled(tmp_path, shape="square", **{name.replace(".", "__"): value for name, value in overrides.items()})
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2
    assert not list(tmp_path.iterdir())
