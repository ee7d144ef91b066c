"""The figures' content, read back from their artists."""

import io
from xml.etree import ElementTree

import matplotlib.colors
import numpy as np
import pandas as pd
import pytest
import shapely
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import PathPatch

from analysis.figures import pen
from analysis.figures.blinks import blinks_figure, lit_positions
from analysis.figures.camera import agreement, chord_pairs_figure
from analysis.figures.chords import Chords, chords_figure
from analysis.figures.convergence import Convergence, convergence_figure, posterior_figure
from analysis.figures.isotropy import isotropy_figure, lines_figure
from analysis.figures.plane import plane_figure
from analysis.figures.style import colour_of, png_bytes, save_figure, svg_text
from analysis.figures.values import Band, Entry, Isotropy, Measured
from analysis.invariants import lit_lengths
from analysis.quadrature import exact_moments
from tests.analysis import sample_session as sample

PAPER_SHAPES = ("circle", "pyramid", "triangle", "liberty", "eiffel", "square")


@pytest.fixture(scope="module")
def result():
    return sample.session("eiffel", runs=240, seed=11)


def by_gid(figure: Figure, gid: str):
    found = figure.findobj(lambda artist: artist.get_gid() == gid)
    assert found, f"nothing in the figure is called {gid}"
    return found


def band_of(shape, n_last, runs=30, seed=5):
    """A band by plain numpy over resampled lines of the sample."""
    rng = np.random.default_rng(seed)
    values = sample.invariants(sample.throw(rng, 900), sample.SHAPES[shape][1])
    values = values[values[:, 0] > 0]
    n = np.unique(np.geomspace(2, n_last, 12).astype(int))
    picks = values[rng.integers(0, len(values), (runs, n_last))].cumsum(axis=1)[:, n - 1]
    area, perimeter = sample.area_perimeter(picks)
    levels = np.array([0.025, 0.16, 0.5, 0.84, 0.975])
    return Band(
        n,
        levels,
        np.quantile(area, levels, axis=0),
        np.quantile(perimeter, levels, axis=0),
        runs,
        area[:3],
        perimeter[:3],
    )


def all_figures(result):
    exact = result.exact
    lengths = lit_lengths(result.crossings)
    area = result.measured.area_cm2
    one = Convergence(result.name, result.title, result.estimates, exact, band_of("eiffel", len(result.estimates)))
    return {
        "blinks": blinks_figure(
            result.track,
            result.geometry,
            result.arena,
            name=result.name,
            estimates=result.estimates,
            counts=(10, 40, None),
        ),
        "chords": chords_figure([Chords(result.name, result.title, lengths, area, exact.area_cm2, exact.perimeter_cm)]),
        "four chords": chords_figure([Chords(name, name, lengths, area) for name in sample.SHAPES]),
        "plane": plane_figure(
            result.dictionary, {result.name: result.estimates}, n=result.measured.n, camera=result.measured
        ),
        "convergence": convergence_figure([one]),
        "posterior": posterior_figure(result.estimates, titles={}),
        "lines": lines_figure(result.true_lines, result.geometry, result.arena, name=result.name),
        "isotropy": isotropy_figure(result.isotropy, name=result.name),
        "camera": chord_pairs_figure(result.chord_pairs, name=result.name),
    }


# --- the look ---------------------------------------------------------------------------------------------------


def luminance(colour):
    rgb = np.array(matplotlib.colors.to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


@pytest.mark.parametrize("name", [*PAPER_SHAPES, "text:FREEDOM", "A", "q"])
@pytest.mark.parametrize("ground", ["#ffffff", "#14171c"])
def test_colours_are_seen_on_white_and_on_dark(name, ground):
    low, high = sorted([luminance(colour_of(name)), luminance(ground)])
    assert (high + 0.05) / (low + 0.05) >= 3.0  # WCAG 2 for graphics


def test_paper_shapes_have_colours_of_their_own_whatever_they_are_called():
    six = [colour_of(name) for name in PAPER_SHAPES]
    assert len(set(six)) == 6
    assert colour_of("Chichen Itza pyramid") == six[1]
    assert colour_of("Statue of Liberty") == six[3]
    red, green, blue = matplotlib.colors.to_rgb(six[3])
    assert blue > green > red


def test_nothing_is_cut_off_and_every_axis_has_a_label(result):
    for name, figure in all_figures(result).items():
        figure.draw_without_rendering()
        page = figure.bbox
        words = [text for legend in figure.legends for text in legend.get_texts()]
        for axes in figure.axes:
            words += [axes.title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
            if axes.axison:
                assert axes.get_xlabel() or axes.get_ylabel(), name
        for text in words:
            box = text.get_window_extent()
            inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= page.x1 + 1 and box.y1 <= page.y1 + 1
            assert inside or not text.get_text(), f"{name}: {text.get_text()!r} is cut off"


def test_svg_is_wellformed_and_points_nowhere(result):
    text = svg_text(all_figures(result)["plane"])
    assert "http" not in text
    assert "xmlns" not in text
    root = ElementTree.fromstring(text)
    assert root.tag == "svg"
    assert len(list(root.iter("path"))) > 50


def test_saved_png_is_opaque_and_white(result, tmp_path):
    path = save_figure(all_figures(result)["chords"], tmp_path / "deep" / "chords.png", dpi=60)
    pixels = imread(path)
    assert pixels.shape[2] == 3 or (pixels[..., 3] == 1).all()
    assert (pixels[0, 0, :3] == 1).all()
    same = imread(io.BytesIO(png_bytes(all_figures(result)["chords"], dpi=60)))
    assert (same[0, 0, :3] == 1).all()


# --- the plane --------------------------------------------------------------------------------------------------


def test_ellipses_hold_the_share_of_simulated_sessions_that_they_claim():
    n, sessions = 400, 3000
    rng = np.random.default_rng(2)
    values = sample.invariants(sample.throw(rng, 6000), sample.SQUARE)
    values = values[values[:, 0] > 0]
    points = np.stack(
        [sample.area_perimeter(values[rng.integers(0, len(values), n)].sum(axis=0)) for _ in range(sessions)]
    )
    centre = sample.area_perimeter(values.sum(axis=0))
    entry = Entry("Square", *centre, sample.dictionary()["square"].covariance_per_line)
    figure = plane_figure({"square": entry}, {}, n=n)
    for level in (0.75, 0.95, 0.99):
        (patch,) = by_gid(figure, f"square {level:g}")
        assert isinstance(patch, PathPatch)
        share = patch.get_path().contains_points(points[:, ::-1]).mean()
        assert share == pytest.approx(level, abs=0.045)


def test_plane_puts_perimeter_across_and_area_up(result):
    figure = plane_figure(
        result.dictionary, {"eiffel": result.estimates}, n=50, camera=Measured(5, 700.0, 190.0, np.eye(2))
    )
    axes = figure.axes[0]
    assert "perimeter" in axes.get_xlabel()
    assert "cm²" in axes.get_ylabel()
    (last,) = by_gid(figure, "last estimate")
    ending = result.estimates.iloc[-1]
    np.testing.assert_allclose(last.get_offsets()[0], [ending["perimeter_cm"], ending["area_cm2"]])
    (trace,) = by_gid(figure, "trajectory")
    contrast = np.asarray(trace.get_alpha())
    assert len(contrast) == len(result.estimates) - 1
    assert (np.diff(contrast) >= 0).all()
    assert contrast[-1] > 5 * contrast[0]
    assert axes.get_xlim()[0] <= 190 <= axes.get_xlim()[1]


def test_entry_names_do_not_cover_one_another():
    rng = np.random.default_rng(0)
    entries = {
        f"e{i}": Entry(f"Entry {i}", *rng.uniform((300, 90), (900, 200)), np.diag([2000.0, 60.0])) for i in range(26)
    }
    figure = plane_figure(entries, {}, n=100)
    figure.draw_without_rendering()
    titles = {entry.title for entry in entries.values()}
    boxes = [text.get_window_extent() for text in figure.axes[0].texts if text.get_text() in titles]
    assert len(boxes) >= 15
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_many_entries_keep_one_ellipse_each():
    entries = {f"e{i}": Entry(str(i), 500.0 + 9 * i, 100.0 + i, np.diag([2000.0, 60.0])) for i in range(60)}
    figure = plane_figure(entries, {}, n=100)
    assert by_gid(figure, "e7 0.95")
    assert not figure.findobj(lambda artist: artist.get_gid() == "e7 0.75")


def test_plane_of_nothing_is_still_a_figure():
    empty = pd.DataFrame({"n": [], "perimeter_cm": [], "area_cm2": []})
    assert plane_figure({}, {"eiffel": empty}, n=10).axes


# --- chords -----------------------------------------------------------------------------------------------------


def test_histogram_marks_the_mean_chord_and_the_root_of_the_area(result):
    # The truth from the geometry, chord by chord: the camera's lengths are not the robot's.
    ends = result.true_lines[["x_start_cm", "y_start_cm", "x_end_cm", "y_end_cm"]].to_numpy()
    truth = [b - a for row in ends for a, b in sample.chords_of(row, result.geometry)]
    lengths = lit_lengths(result.true_crossings)
    np.testing.assert_allclose(np.sort(lengths), np.sort(truth))
    figure = chords_figure([Chords("eiffel", "Eiffel Tower", lengths, 625.0, 630.0, 181.0)])
    longest = max(truth)
    mark = {
        gid: by_gid(figure, gid)[0].get_xdata()[0] * longest for gid in ("mean", "root", "exact mean", "exact root")
    }
    assert mark["mean"] == pytest.approx(sum(truth) / len(truth))
    assert mark["root"] == pytest.approx(25.0)
    assert mark["exact mean"] == pytest.approx(np.pi * 630 / 181)
    assert mark["exact root"] == pytest.approx(630**0.5)
    bars = figure.axes[0].patches
    assert sum(bar.get_width() * bar.get_height() for bar in bars) == pytest.approx(1.0)
    assert any(f"{sum(truth) / len(truth):.1f} cm" in text.get_text() for text in figure.axes[0].texts)


def test_a_crossing_without_its_partner_makes_no_chord():
    crossings = pd.DataFrame(
        {
            "line": [0, 0, 1, 1, 1, 2],
            "order": [1, 0, 0, 1, 2, 0],
            "s_cm": [9.0, 2.0, 1.0, 4.0, 6.0, 8.0],
            "entering": [False, True, True, False, True, False],
        }
    )
    np.testing.assert_allclose(lit_lengths(crossings), [7.0, 3.0])
    assert lit_lengths(crossings.iloc[:0]).size == 0


# --- blinks and maps --------------------------------------------------------------------------------------------


def test_blinks_panels_hold_the_lit_frames_up_to_their_line(result):
    figure = blinks_figure(
        result.track,
        result.geometry,
        result.arena,
        name="eiffel",
        estimates=result.estimates,
        counts=(10, 10_000, None),
    )
    assert [axes.get_title() for axes in figure.axes] == ["N = 10", f"N = {len(result.estimates)}"]
    tenth = result.lines.loc[result.lines["k"] > 0, "line"].iloc[9]
    expected = [
        ((result.track["line"] <= tenth) & result.track["led_on"]).sum(),
        result.track["led_on"].sum(),
    ]
    drawn = [scatter.get_offsets() for scatter in by_gid(figure, "blinks")]
    assert [len(places) for places in drawn] == expected
    near = shapely.contains_xy(result.geometry.buffer(0.01), np.asarray(drawn[1]))
    assert near.all()
    assert all(scatter.get_rasterized() for scatter in by_gid(figure, "blinks"))


def test_blinks_leave_out_what_the_camera_lost():
    track = pd.DataFrame({"x_cm": [0.0, np.nan, 3.0], "y_cm": [0.0, 1.0, 3.0], "led_on": [True, True, False]})
    np.testing.assert_allclose(lit_positions(track), [[0.0, 0.0]])


def test_map_of_lines_draws_every_run(result):
    figure = lines_figure(result.true_lines, result.geometry, result.arena, name="eiffel")
    (web,) = by_gid(figure, "runs")
    assert isinstance(web, PathCollection)
    drawn = np.concatenate([path.vertices.reshape(-1, 4) for path in web.get_paths()])
    ends = result.true_lines[["x_start_cm", "y_start_cm", "x_end_cm", "y_end_cm"]].to_numpy()
    np.testing.assert_allclose(drawn[np.lexsort(drawn.T)], ends[np.lexsort(ends.T)])


def test_scale_bar_has_the_length_it_names(result):
    figure = lines_figure(result.true_lines, result.geometry, result.arena, name="eiffel")
    (bar,) = by_gid(figure, "scale")
    length = np.ptp(bar.get_xdata())
    assert f"{length:g} cm" in [text.get_text() for text in figure.axes[0].texts]
    assert figure.axes[0].get_aspect() == 1.0


# --- convergence, posterior -------------------------------------------------------------------------------------


def test_convergence_draws_the_table_the_band_and_the_exact_values(result):
    band = band_of("eiffel", 80)
    figure = convergence_figure([Convergence("eiffel", "Eiffel Tower", result.estimates, result.exact, band)])
    area, perimeter = figure.axes[:2]
    robots = by_gid(figure, "eiffel robot")
    np.testing.assert_allclose(robots[0].get_ydata(), result.estimates["area_cm2"])
    np.testing.assert_allclose(robots[1].get_ydata(), result.estimates["perimeter_cm"])
    assert [line.get_ydata()[0] for line in by_gid(figure, "eiffel exact")] == [
        result.exact.area_cm2,
        result.exact.perimeter_cm,
    ]
    assert len(by_gid(figure, "simulated")) == 6
    outer = area.collections[0].get_paths()[0].vertices
    assert outer[:, 1].max() == pytest.approx(band.area_cm2[-1].max())
    assert outer[:, 1].min() == pytest.approx(band.area_cm2[0].min())
    for axes, exact in ((area, result.exact.area_cm2), (perimeter, result.exact.perimeter_cm)):
        low, high = axes.get_ylim()
        assert low < exact < high
        assert axes.get_xscale() == "log"
    assert "95 % of simulations" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_band_of_a_simulation_keeps_its_quantiles():
    class Simulated:
        n = np.array([2, 10])
        quantile_levels = np.array([0.1, 0.9])
        area_quantiles_cm2 = np.arange(4.0).reshape(2, 2)
        perimeter_quantiles_cm = area_quantiles_cm2 + 10
        area_runs_cm2 = np.ones((50, 2))
        perimeter_runs_cm = np.ones((50, 2))

    band = Band.of(Simulated())
    assert band.runs == 50
    assert band.area_runs_cm2.shape == (8, 2)
    assert band.perimeter_cm[1, 1] == 13


def test_entry_of_exact_moments_scatters_as_simulated_sessions_do():
    moments = exact_moments(sample.SQUARE)
    entry = Entry.of("Square", moments)
    assert (entry.area_cm2, entry.perimeter_cm) == pytest.approx((784.0, 112.0))
    relative = np.sqrt(np.diag(entry.covariance_at(100))) / (784.0, 112.0)
    np.testing.assert_allclose(relative, [0.039278, 0.033730], rtol=1e-4)


def test_several_shapes_share_the_axes_and_are_named(result):
    other = result.estimates.assign(area_cm2=result.estimates["area_cm2"] * 2)
    figure = convergence_figure(
        [
            Convergence("eiffel", "Eiffel Tower", result.estimates, result.exact),
            Convergence("circle", "Circle", other, sample.dictionary()["circle"]),
        ]
    )
    named = [text.get_text() for text in figure.legends[0].get_texts()]
    assert named == ["Eiffel Tower", "Circle", "exact"]


def test_posterior_of_the_leader_and_of_every_entry(result):
    figure = posterior_figure(result.estimates, titles={"eiffel": "The Tower"}, stop_at=0.9)
    (curve,) = by_gid(figure, "posterior")
    np.testing.assert_allclose(curve.get_ydata(), result.estimates["posterior"])
    assert by_gid(figure, "stop")[0].get_ydata()[0] == 0.9
    assert any(text.get_text().startswith("The Tower") for text in figure.legends[0].get_texts())
    every = pd.DataFrame({"n": [3, 1, 2], "eiffel": [0.9, 0.4, 0.6], "circle": [0.1, 0.6, 0.4]})
    figure = posterior_figure(result.estimates, titles={}, posteriors=every, most=1)
    np.testing.assert_allclose(by_gid(figure, "posterior circle")[0].get_ydata(), [0.6, 0.4, 0.1])
    assert by_gid(figure, "posterior eiffel")[0].get_color() == colour_of("eiffel")
    assert by_gid(figure, "posterior circle")[0].get_color() == pen.GRID


# --- isotropy, camera -------------------------------------------------------------------------------------------


def test_isotropy_margins_count_every_run(result):
    u = np.array([0.05, 0.1, 0.8, 0.95, 0.99])
    figure = isotropy_figure(Isotropy(u, u[::-1] ** 2), name="eiffel")
    (runs,) = by_gid(figure, "runs")
    np.testing.assert_allclose(runs.get_offsets(), np.column_stack([u, u[::-1] ** 2]))
    square, over, beside = figure.axes
    assert [bar.get_height() for bar in over.patches] == [2, 0, 0, 3]
    assert [bar.get_width() for bar in beside.patches] == np.histogram(u**2, 4, (0, 1))[0].tolist()
    assert square.get_xlim() == (0, 1)


def test_agreement_is_bland_and_altmans(result):
    rng = np.random.default_rng(3)
    camera = rng.uniform(2, 40, 4000)
    robot = 1.02 * camera + rng.normal(0, 0.3, camera.size)
    found = agreement(pd.DataFrame({"robot_length_cm": robot, "true_length_cm": camera}))
    assert found.scale == pytest.approx(np.linalg.lstsq(camera[:, None], robot)[0][0])
    assert found.scale == pytest.approx(1.02, abs=0.001)
    again = [
        agreement(pd.DataFrame({"robot_length_cm": camera + rng.normal(0, 0.3, camera.size), "true_length_cm": camera}))
        for _ in range(200)
    ]
    assert np.std([one.scale for one in again]) == pytest.approx(again[0].scale_sigma, rel=0.2)
    low, high = found.limits_cm
    between = np.mean((robot - camera > low) & (robot - camera < high))
    assert between == pytest.approx(0.95, abs=0.02)
    figure = chord_pairs_figure(result.chord_pairs, name="eiffel")
    difference = result.chord_pairs["robot_length_cm"] - result.chord_pairs["true_length_cm"]
    assert by_gid(figure, "bias")[0].get_ydata()[0] == pytest.approx(difference.mean())
    assert by_gid(figure, "high limit")[0].get_ydata()[0] == pytest.approx(difference.mean() + 1.96 * difference.std())


def test_agreement_needs_two_pairs_and_skips_what_is_unknown():
    pairs = pd.DataFrame({"robot_length_cm": [5.0, np.nan, 7.0], "true_length_cm": [4.0, 3.0, np.nan]})
    assert agreement(pairs) is None
    assert chord_pairs_figure(pairs, name="eiffel").axes[0].collections[0].get_offsets().shape == (1, 2)
    assert agreement(pairs.iloc[:0]) is None
