import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from shapely import affinity
from shapely.geometry import LineString, Point, box

from analysis.boundary import Boundary
from analysis.estimate import estimate
from analysis.invariants import area_cm2, perimeter_cm
from analysis.quadrature import exact_moments
from analysis.recognition import GaussianRecogniser
from analysis.sensor import SensorModel
from analysis.sensorkernels import cross_parallel, detect, read_light, sense_lines
from lab.base.errors import RequestError
from robot.crossings import Levels, crossings_of
from tests.analysis.blind_robot import BlindRobot

SENSOR = SensorModel(0.75, footprint_cm=0.37, margin=0.06, noise=0.01, speed_sigma=0.02)
POINT = 1e-9  # a margin of next to nothing: a sensor that only samples

light_values = st.one_of(
    st.floats(-0.2, 1.2), st.sampled_from([0.0, 0.44, 0.5, 0.56, 1.0, np.nan, np.inf]), st.floats(0.43, 0.57)
)


@settings(deadline=None)  # the first example compiles
@given(st.lists(light_values, min_size=1, max_size=60), st.integers(0, 2**32 - 1))
@example([0.5, 0.5, 0.44], 0)
@example([np.nan, 1.0, np.nan], 0)
@example([0.0, 0.51, 0.49, 0.52, 1.0], 0)
def test_the_detector_is_the_robots(light, seed):
    light = np.array(light)
    s_cm = np.cumsum(np.random.default_rng(seed).random(light.size))
    expected = crossings_of(s_cm, s_cm, light, Levels(0.0, 1.0, 0.44, 0.5, 0.56))
    found = np.empty(light.size + 2)
    count = detect(s_cm, light, light.size, (0.44, 0.5, 0.56), found)
    assert found[:count].tolist() == pytest.approx([crossing.s_cm for crossing in expected], rel=1e-12)


def outline(geometry):
    boundary = Boundary.of(geometry)
    arrays = boundary.x_cm, boundary.y_cm, boundary.chunks, boundary.discs
    return boundary, arrays, np.empty((7, boundary.x_cm.size)), np.zeros(7, dtype=np.int64)


def random_lines(geometry, count, rng):
    boundary, arrays, t_cm, counts = outline(geometry)
    for _ in range(count):
        theta, p = rng.uniform(0, np.pi), rng.uniform(-1, 1) * boundary.radius_cm
        cross_parallel((np.cos(theta), np.sin(theta), p), SENSOR.footprint()[0], arrays, t_cm, counts)
        normal = np.array([np.cos(theta), np.sin(theta)])
        yield np.array(boundary.centre_cm) + p * normal, np.array([-normal[1], normal[0]]), t_cm, counts


@pytest.mark.parametrize("name", ["annulus", "two discs", "statue"])
def test_crossings_of_parallel_lines_are_where_shapely_cuts(shapes, name, rng):
    offsets_cm = SENSOR.footprint()[0]
    for foot, along, t_cm, counts in random_lines(shapes[name], 100, rng):
        for offset, t, count in zip(offsets_cm, t_cm, counts, strict=True):
            start = foot + offset * np.array([along[1], -along[0]])
            cut = LineString([start - 200 * along, start + 200 * along]).intersection(shapes[name])
            ends = shapely.get_coordinates(cut) @ along - start @ along
            assert t[:count] == pytest.approx(np.sort(ends), abs=1e-9)


@pytest.mark.parametrize("name", ["square", "statue"])
def test_the_light_is_the_lit_share_of_the_disc(shapes, name, rng):
    """Against the exact area of shape ∩ disc, where the light is neither 0 nor 1: less off than a reading's noise."""
    _, half_cm, weight = SENSOR.footprint()
    error = []
    s_cm, light = np.empty(5000), np.empty(5000)
    for foot, along, t_cm, counts in random_lines(shapes[name], 80, rng):
        if not counts.any():
            continue
        count = read_light((t_cm, counts), (half_cm, weight), 0.1, rng.random(), (-1.0, 2.0), s_cm, light)
        for s, seen in zip(s_cm[:count], light[:count], strict=True):
            disc = Point(foot + s * along).buffer(SENSOR.footprint_cm, quad_segs=16)
            share = disc.intersection(shapes[name]).area / disc.area
            if 0 < share < 1:
                error.append(seen - share)
    assert len(error) > 500
    assert abs(np.mean(error)) < 0.002
    assert np.std(error) < 0.01
    assert np.abs(error).max() < 0.13  # along an edge, where a slice is lit or not


def test_readings_that_are_left_out_would_have_told_nothing(shapes, rng):
    _, half_cm, weight = SENSOR.footprint()
    few_s, few, all_s, every = (np.empty(5000) for _ in range(4))
    found, again = np.empty(200), np.empty(200)
    levels = 0.44, 0.5, 0.56
    saved = 0
    for _, _, t_cm, counts in random_lines(shapes["statue"], 300, rng):
        if not counts.any():
            continue
        phase, slices = rng.random(), (half_cm, weight)
        fewer = read_light((t_cm, counts), slices, 0.2, phase, (0.38, 0.62), few_s, few)
        total = read_light((t_cm, counts), slices, 0.2, phase, (-1.0, 2.0), all_s, every)
        saved += total - fewer
        assert set(few_s[:fewer].round(9)) <= set(all_s[:total].round(9))
        count = detect(few_s, few, fewer, levels, found)
        assert count == detect(all_s, every, total, levels, again)
        assert found[:count] == pytest.approx(again[:count])
    assert saved > 1000


def test_compiled_kernels_do_what_their_python_says(shapes):
    sensor = SensorModel(0.7, 0.4, margin=0.06, noise=0.05, speed_sigma=0.1, jitter_cm=0.1)
    boundary, arrays, t_cm, counts = outline(shapes["statue"])
    offsets_cm, half_cm, weight = sensor.footprint()
    seen = [(np.zeros(40, np.int64), np.zeros(40), np.zeros(40)) for _ in range(2)]
    for function, columns in zip((sense_lines, sense_lines.py_func), seen, strict=True):
        motion = sensor.step_cm, sensor.jitter_cm, sensor.speed_sigma
        rng = np.random.default_rng(8)
        function(rng, boundary.radius_cm, arrays, sensor.footprint(), motion, sensor.levels, sensor.noise, columns)
    assert seen[0][0].any()
    for compiled, plain in zip(*seen, strict=True):
        assert compiled == pytest.approx(plain)
    found = np.empty(200)
    rows = []
    for cross, read, pick in (
        (cross_parallel, read_light, detect),
        (cross_parallel.py_func, read_light.py_func, detect.py_func),
    ):
        s_cm, light = np.empty(500), np.empty(500)
        total = cross((0.6, 0.8, 1.0), offsets_cm, arrays, t_cm, counts)
        readings = read((t_cm, counts), (half_cm, weight), 0.3, 0.4, (0.2, 0.8), s_cm, light)
        light[3] = np.nan
        crossings = pick(s_cm, light, readings, (0.44, 0.5, 0.56), found)
        rows.append([total, readings, *found[:crossings]])
    assert rows[0] == pytest.approx(rows[1])
    assert len(rows[0]) >= 4


@pytest.mark.parametrize("name", ["tower", "two discs"])
def test_lines_are_those_of_a_robot_simulated_another_way(shapes, name, rng):
    robot = BlindRobot(1.5, 0.5)
    model = SensorModel(1.5, 0.5, margin=robot.margin, noise=robot.noise, speed_sigma=robot.speed_sigma)
    k, l1, l3 = robot.roll(shapes[name], 1500, rng).T
    sensed = model.sense(shapes[name], 100_000, rng)
    assert stats.ks_2samp(l1, sensed.l1_cm).pvalue > 1e-3
    assert stats.ks_2samp(l3, sensed.l3_cm3).pvalue > 1e-3
    assert stats.ks_2samp(k, sensed.k).pvalue > 1e-3
    assert k.mean() == pytest.approx(sensed.k.mean(), abs=4 * k.std() / np.sqrt(k.size))


def test_a_fine_sensor_sees_the_shape_itself(shapes, rng):
    fine = SensorModel(0.02, 0.01, margin=0.05)
    for name in ("square", "annulus", "tower"):
        exact, seen = exact_moments(shapes[name]), fine.sense(shapes[name], 50_000, rng).moments(shapes[name])
        assert seen.area_cm2 == pytest.approx(exact.area_cm2, rel=1e-3)
        assert seen.perimeter_cm == pytest.approx(exact.perimeter_cm, rel=3e-3)
        assert seen.hitting_measure_cm == pytest.approx(exact.hitting_measure_cm, rel=0.02)
        assert np.sqrt(np.diag(seen.relative)) == pytest.approx(np.sqrt(np.diag(exact.relative)), rel=0.03)


def test_corners_lose_the_chords_that_fall_between_readings(rng):
    """(Δ/4) Σ_v [1 + (π−α) cot α] of ∫[hit] dG: Δ for a square, whose four corners count 1 each."""
    square = box(-12, -12, 12, 12)
    seen = SensorModel(1.0, margin=POINT).sense(square, 400_000, rng).moments(square)
    assert 96 - seen.hitting_measure_cm == pytest.approx(1.0, abs=0.3)
    lost = 1 - seen.mean[0] * seen.hitting_measure_cm / 96
    assert lost == pytest.approx(1 / 96, rel=0.05)


def test_a_step_widens_the_area(rng):
    """Both ends of a chord are off by a uniform Δ: A + πΔ²/6."""
    disc = Point(1, 2).buffer(15, quad_segs=90)
    seen = SensorModel(2.0, margin=POINT).sense(disc, 400_000, rng).moments(disc)
    assert seen.area_cm2 - disc.area == pytest.approx(np.pi * 4 / 6, rel=0.15)


def test_uneven_arrival_widens_the_area(rng):
    """Independent errors σ of a crossing's place: A + 2πσ². It lies midway between two readings: σ² = jitter²/2."""
    disc = Point(0, 0).buffer(15, quad_segs=90)
    step, seen = (
        SensorModel(2.0, margin=POINT, jitter_cm=jitter_cm).sense(disc, 1_000_000, rng).moments(disc)
        for jitter_cm in (0.0, 0.6)
    )
    assert seen.area_cm2 - step.area_cm2 == pytest.approx(np.pi * 0.6**2, rel=0.5)


def test_speed_that_scatters_weighs_slow_runs_more(rng):
    """Lengths are true length/speed: A is seen ⟨g⁻³⟩/⟨g⁻¹⟩ times too large, P ⟨g⁻³⟩/⟨g⁻¹⟩² times."""
    disc = Point(0, 0).buffer(15, quad_segs=90)
    seen = SensorModel(0.05, margin=POINT, speed_sigma=0.1).sense(disc, 200_000, rng).moments(disc)

    def mean(power):
        return integrate.quad(lambda z: stats.norm.pdf(z) * (1 + 0.1 * z) ** power, -6, 6)[0]

    assert seen.area_cm2 / disc.area == pytest.approx(mean(-3) / mean(-1), abs=4e-3)
    assert seen.perimeter_cm / disc.length == pytest.approx(mean(-3) / mean(-1) ** 2, abs=4e-3)


def test_moments_are_those_of_the_lines_and_sharper(shapes, rng):
    tower = shapes["tower"]
    sensed = SENSOR.sense(tower, 50_000, rng)
    moments, plain = sensed.moments(tower), estimate(*sensed.invariants())
    assert moments.area_cm2 == pytest.approx(plain.area_cm2, abs=4 * plain.sigma_area_cm2)
    assert moments.perimeter_cm == pytest.approx(plain.perimeter_cm, abs=4 * plain.sigma_perimeter_cm)
    assert moments.area_cm2 == pytest.approx(area_cm2(*moments.mean[1:]))
    assert moments.perimeter_cm == pytest.approx(perimeter_cm(*moments.mean))
    repeated = [SENSOR.sense(tower, 10_000, rng).moments(tower).perimeter_cm for _ in range(20)]
    assert np.std(repeated) < 0.5 * plain.sigma_perimeter_cm * np.sqrt(5)
    ratio = np.std(repeated) / tower.length / SENSOR.sense(tower, 10_000, rng).moments(tower).error
    assert 0.3 < ratio < 3


def test_matched_moments_put_the_gaussian_recogniser_right(shapes, rng):
    six = {name: shapes[name] for name in ("circle", "square", "triangle", "pyramid", "tower", "statue")}
    sensor = SensorModel(2.0, 0.3, margin=0.06, noise=0.01, speed_sigma=0.02)
    matched = GaussianRecogniser({name: sensor.sense(g, 50_000, rng).moments(g) for name, g in six.items()})
    ideal = GaussianRecogniser({name: exact_moments(g) for name, g in six.items()})
    lines = BlindRobot(2.0, 0.3).roll(six["statue"], 3000, rng)
    k, l1, l3 = lines.mean(axis=0)
    seen = float(area_cm2(l1, l3)), float(perimeter_cm(k, l1, l3)), 3000
    assert matched.misfit(*seen)["statue"] < 14 < ideal.misfit(*seen)["statue"]


def test_the_generator_alone_decides_and_a_turn_changes_nothing(shapes):
    one, two = (SENSOR.sense(shapes["ell"], 40_000, np.random.default_rng(5), threads=n) for n in (1, 3))
    assert [column.tolist() for column in one.invariants()] == [column.tolist() for column in two.invariants()]
    assert one.excess.tolist() == two.excess.tolist()
    turned = SENSOR.sense(affinity.rotate(shapes["ell"], 40), 40_000, np.random.default_rng(6))
    assert stats.ks_2samp(one.l1_cm, turned.l1_cm).pvalue > 1e-3


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"step_cm": 0.0}, "step_cm"),
        ({"noise": -1.0}, "noise"),
        ({"footprint_cm": np.nan}, "footprint_cm"),
        ({"margin": 0.5}, "margin"),
        ({"mid": 1.2}, "mid"),
    ],
)
def test_senseless_sensors_are_refused(changed, said):
    with pytest.raises(RequestError, match=said):
        SensorModel(**{"step_cm": 1.0, **changed})


def test_what_is_not_seen_is_said(rng):
    spot = Point(0, 0).buffer(0.5)
    blind = SensorModel(1.0, footprint_cm=3.0).sense(spot, 1000, rng)
    assert blind.k.size == 0
    with pytest.raises(RequestError, match="sees nothing"):
        blind.moments(spot)
    with pytest.raises(RequestError, match="lines"):
        SENSOR.sense(spot, 0, rng)


@pytest.mark.slow
def test_a_virtual_session_measures_what_the_sensor_model_says(tmp_path):
    """The whole virtual bench: radio, driver, projector's pixels, Lambert's turns, levels learnt in the preflight."""
    from lab.store.reader import SessionReader
    from lab.store.tables import tables_of
    from projector.dictionary import shape_from
    from tests.lab.conftest import roll

    session = SessionReader(roll(tmp_path, shape="eiffel", stop__lines=200, seed=11).folder)
    lines = tables_of(session).lines
    lines = lines[lines["counts"] & (lines["k"] > 0)]
    tower = shape_from("eiffel").geometry
    sensed = SENSOR.sense(tower, 200_000, np.random.default_rng(1))
    assert stats.ks_2samp(lines["l1_cm"], sensed.l1_cm).pvalue > 1e-3
    assert stats.ks_2samp(lines["l3_cm3"], sensed.l3_cm3).pvalue > 1e-3
    most = 4  # chords; more are too rare to count
    share = np.bincount(np.minimum(sensed.k, most), minlength=most + 1)[1:] / sensed.k.size
    seen = np.bincount(np.minimum(lines["k"], most), minlength=most + 1)[1:]
    assert stats.chisquare(seen, share * len(lines)).pvalue > 1e-3
    moments = sensed.moments(tower)
    found = estimate(lines["k"], lines["l1_cm"], lines["l3_cm3"])
    # P/A, in which most of the lines' scatter cancels: some 3.6 % less than the tower's own.
    bias = moments.perimeter_cm / moments.area_cm2 / (tower.length / tower.area) - 1
    assert -0.05 < bias < -0.025
    relative = found.covariance / np.outer(*2 * [np.array([found.area_cm2, found.perimeter_cm])])
    sigma = np.sqrt(relative[0, 0] + relative[1, 1] - 2 * relative[0, 1])
    expected = moments.perimeter_cm / moments.area_cm2
    assert found.perimeter_cm / found.area_cm2 == pytest.approx(expected, rel=4 * sigma)
