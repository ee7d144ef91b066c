"""`chordlab moments` and `chordlab simulate`: a shape's statistics, exact and by Monte Carlo."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from analysis.turning import Turning
from lab.base.errors import RequestError
from lab.cli.choosing import FontOption, ShapeArgument
from lab.cli.output import JsonFlag, QuietFlag, emit, progress_bar, say, show_table

if TYPE_CHECKING:
    from shapely.geometry import Polygon


def moments(shape: ShapeArgument, font: FontOption = None, as_json: JsonFlag = False) -> None:
    """Exact moments of a shape's random lines, by quadrature. Sigmas are for one line: divide by √N.

    Example: chordlab moments square
    """
    from analysis.quadrature import exact_moments
    from projector.dictionary import shape_from

    exact = exact_moments(shape_from(shape, font=font).geometry)
    data = exact.to_dict()
    if as_json:
        emit(data)
        return
    show_table(shape, ("quantity", "value"), [(name, f"{value:.6g}") for name, value in data.items()])


def simulate(
    shape: ShapeArgument,
    lines: Annotated[int, typer.Option(min=2, max=10_000_000, help="Crossing lines N in each run.")] = 1000,
    runs: Annotated[int, typer.Option(min=1, max=1_000_000, help="Independent runs.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random lines.")] = 1,
    arena: Annotated[
        str | None,
        typer.Option(
            help="Roll robots from edge to edge of an arena about the origin, in cm: 60 for a disc of that radius, "
            "120x90 for a rectangle. Without it lines are independent, uniform and isotropic."
        ),
    ] = None,
    turning: Annotated[Turning, typer.Option(help="How the robots turn at the arena's edge.")] = Turning.LAMBERT,
    step_cm: Annotated[
        float | None, typer.Option(min=0, help="Read the light every so many cm of the arena's runs, not everywhere.")
    ] = None,
    footprint_cm: Annotated[float, typer.Option(min=0, help="Radius of floor that the light is averaged over.")] = 0.0,
    font: FontOption = None,
    quiet: QuietFlag = False,
    as_json: JsonFlag = False,
) -> None:
    """Monte Carlo: A and P as RUNS robots would find them. After LINES crossing lines each.

    Example: chordlab simulate eiffel --lines 300 --runs 1000 --seed 1
    """
    import numpy as np

    from analysis.exploration import explore
    from analysis.montecarlo import simulate as simulate_runs
    from analysis.sensor import SensorModel
    from projector.dictionary import shape_from

    sensor = None if step_cm is None else SensorModel(step_cm, footprint_cm)
    if arena is None and (sensor is not None or turning is not Turning.LAMBERT):
        raise RequestError("a way of turning and a light sensor need an arena: add --arena 60 or --arena 120x90")
    drawn = shape_from(shape, font=font)
    started_s = time.perf_counter()
    with progress_bar("runs", quiet=quiet) as update:
        rng = np.random.default_rng(seed)
        if arena is None:
            result = simulate_runs(drawn.geometry, lines=lines, runs=runs, rng=rng, progress=update)
        else:
            result = explore(
                drawn.geometry,
                _arena(arena),
                lines=lines,
                runs=runs,
                rng=rng,
                turning=turning,
                sensor=sensor,
                progress=update,
            )
    elapsed_s = time.perf_counter() - started_s
    rate = lines * runs / elapsed_s
    if as_json:
        emit({"area_cm2": result.area_cm2, "perimeter_cm": result.perimeter_cm, "lines_per_second": rate})
        return
    rows = [
        ("area, cm²", drawn.area_cm2, result.area_cm2),
        ("perimeter, cm", drawn.perimeter_cm, result.perimeter_cm),
    ]
    show_table(
        f"{drawn.title}: {runs} runs of {lines} lines",
        ("quantity", "true", "mean", "σ of a run"),
        [(name, f"{true:.2f}", f"{found.mean():.2f}", f"{found.std():.2f}") for name, true, found in rows],
    )
    say(f"{rate:.3g} lines/s")


def _arena(text: str) -> Polygon:
    """The arena of ``--arena``: a radius, or width x height, in cm."""
    from analysis.exploration import disc_arena, rectangle_arena

    try:
        sides = [float(side) for side in text.lower().split("x")]
    except ValueError:
        sides = []
    if len(sides) == 1:
        return disc_arena(sides[0])
    if len(sides) == 2:
        return rectangle_arena(*sides)
    raise RequestError(f"`--arena {text}` is neither a radius nor width x height in cm: give 60 or 120x90")
