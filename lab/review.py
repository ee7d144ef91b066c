"""A stored session, reviewed: its video tracked, its estimates held against ground truth, its report written."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from shapely import Polygon
from shapely.geometry import shape as shape_of

from analysis.bandcheck import MonteCarloCheck
from analysis.budget import Budget
from analysis.estimate import Estimate, estimate
from analysis.figures.values import Band, Entry, Isotropy
from analysis.invariants import invariants_table
from analysis.montecarlo import available_cores, running_bands
from analysis.quadrature import Moments, exact_moments
from analysis.report.result import RunCheck, SessionResult
from analysis.report.verdict import verdict_of
from analysis.report.write import write_report
from lab.attribution import attribute, camera_estimate, lines_from_the_edge
from lab.base.errors import RequestError
from lab.budget import session_budget
from lab.experiment import dictionary_with
from lab.finalize import Tables, finalize
from lab.recognisers import Recognition, recognise_lines, recogniser_for
from lab.runcheck import check_runs
from lab.session import CONTACT_WINDOW_S
from lab.settings import Settings, parse_settings
from lab.simulated import check_against_simulation
from lab.store import REPORT, SessionReader
from lab.tally import stored_estimate
from projector.collections import load_dictionary
from projector.shape import Shape, Silhouette
from robot.contacts import contacts_among
from robot.turning import Policy
from tracking.anisotropy import TooFewHitsError, bias_from
from tracking.calibration import Calibration
from tracking.identity import LedMark
from tracking.innovations import FilterHealth, filter_health
from tracking.isotropy import IsotropyReport, TooFewLinesError, examine_lines
from tracking.linespace import LineSpace
from tracking.matching import ChordMatch, match_crossings
from tracking.runs import fit_lines
from tracking.segment import frames_table
from tracking.straightness import Straightness, straightness
from tracking.table import systematic_cm
from tracking.track import track_segments
from tracking.truth import near_chords, true_crossings

Progress = Callable[[int, int], None]

SHORTEST_RUN_CM = 5.0  # a few frames: shorter runs cannot be told from turning on the spot
_TEST_TITLES = {
    "rayleigh": "Rayleigh, directions",
    "hermans_rasson": "Hermans–Rasson, directions",
    "cramer_von_mises": "Cramér–von Mises, places",
    "neyman": "Neyman, directions and places",
}
_BAND_RUNS = 400
_BAND_POINTS = 40


@dataclass(frozen=True, slots=True)
class Filmed:
    """What the camera saw of a session. ``tested``: the lines that isotropy is judged by."""

    track: pd.DataFrame
    lines: pd.DataFrame
    crossings: pd.DataFrame
    match: ChordMatch
    estimate: Estimate | None
    isotropy: IsotropyReport | None
    tested: pd.DataFrame
    straightness: Straightness | None
    health: FilterHealth


@dataclass(frozen=True, slots=True)
class Reviewed:
    """A session with everything that was found in it."""

    session: SessionReader
    settings: Settings
    shape: Shape
    tables: Tables
    moments: dict[str, Moments]
    titles: dict[str, str]
    recognition: Recognition
    robot: Estimate | None
    filmed: Filmed | None
    runs: RunCheck | None
    budget: Budget | None = None
    montecarlo: MonteCarloCheck | None = None


def stored_shape(session: SessionReader) -> Shape:
    """The shape that was projected, from the session's own manifest."""
    try:
        stored = session.manifest["shape"]
        geometry: Any = shape_of(stored["geometry"])
        return Shape(stored["name"], stored["title"], geometry, "the session's manifest")
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RequestError(f"{session.folder}: the manifest's shape is not whole ({error!r})") from error


def stored_settings(session: SessionReader) -> Settings:
    """The settings that a session ran with."""
    return parse_settings(session.manifest.get("settings", {}), origin=f"{session.folder}: manifest settings")


def examine(folder: Path, *, workers: int | None = None, progress: Progress | None = None) -> Reviewed:
    """Read a session, track its video where there is one, and compare robot, camera and truth.

    ``workers`` processes track the video; by default one for two cores, since decoding takes two by itself.
    """
    session = SessionReader(folder)
    settings, shape = stored_settings(session), stored_shape(session)
    rng = np.random.default_rng(settings.seed)
    tables = finalize(folder)
    dictionary = dictionary_with(shape, settings)
    recognition = _recognised(dictionary, settings, tables, shape.name)
    found = Reviewed(
        session=session,
        settings=settings,
        shape=shape,
        tables=tables,
        moments={name: exact_moments(entry.geometry) for name, entry in dictionary.items()},
        titles={name: entry.title for name, entry in dictionary.items()},
        recognition=recognition,
        robot=stored_estimate(tables.lines, tables.crossings),
        filmed=_filmed(
            session, settings, shape.geometry, tables, rng, workers or max(1, available_cores() // 2), progress
        ),
        runs=check_runs(tables.lines, shape.geometry, settings, rng),
    )
    return replace(
        found,
        budget=session_budget(found, rng),
        montecarlo=check_against_simulation(tables, shape.geometry, settings, rng.spawn(1)[0]),
    )


def recognised(session: SessionReader, tables: Tables) -> tuple[list[tuple[str, float]], pd.DataFrame]:
    """The final ranking, and ``n`` with one column for each entry: the posterior after each crossing line."""
    found = recognition_of(session, tables)
    return found.ranking, found.posteriors


def recognition_of(session: SessionReader, tables: Tables, collection: str | None = None) -> Recognition:
    """What a stored session's lines say; with a ``collection``, of that one's entries alone."""
    settings, shape = stored_settings(session), stored_shape(session)
    known = load_dictionary(collection, font=settings.font) if collection else dictionary_with(shape, settings)
    return _recognised(known, settings, tables, shape.name)


def _recognised(dictionary: dict[str, Shape], settings: Settings, tables: Tables, called: str) -> Recognition:
    return recognise_lines(recogniser_for(dictionary, settings, called=called), _counted(tables))


def _counted(tables: Tables) -> pd.DataFrame:
    """The lines of the statistics that crossed the shape."""
    lines = tables.lines
    return lines[lines["counts"] & (lines["k"] > 0)]


def _estimate(lines: pd.DataFrame) -> Estimate | None:
    return estimate(lines["k"], lines["l1_cm"], lines["l3_cm3"]) if len(lines) > 1 else None


def _filmed(
    session: SessionReader,
    settings: Settings,
    geometry: Silhouette,
    tables: Tables,
    rng: np.random.Generator,
    workers: int,
    progress: Progress | None,
) -> Filmed | None:
    segments = session.segments()
    if not segments:
        return None
    calibration = Calibration.from_dict(session.manifest["calibration"]["camera"])
    several = len(settings.robots) > 1
    if several:
        leds = [LedMark(settings.led_colour(number)) for number in range(len(settings.robots))]
        # the film's slices follow each other as the runs ended, which is the order of the log
        slices = {int(line): segments[line] for line in tables.lines["line"] if line in segments}
        film = track_segments(slices, calibration, robots=len(leds), leds=leds, progress=progress)
        names = [robot["name"] for robot in session.manifest["devices"]["robots"]]
        track = attribute(on_host_clock(film, segments), tables.lines, names)
    else:
        track = on_host_clock(track_segments(segments, calibration, workers=workers, progress=progress), segments)
    track.to_parquet(session.folder / "track.parquet", index=False)
    counts = tables.lines.loc[tables.lines["counts"], "line"]
    # a run's number tells its robot
    runs = track.drop(columns="robot") if several else track
    lines = fit_lines(runs, systematic_cm=systematic_cm(calibration))
    lines = lines[lines["line"].isin(counts) & (lines["reason"] == "")].reset_index(drop=True)
    crossings = true_crossings(lines, geometry, track=runs)
    if several:
        found = camera_estimate(lines, crossings, tables.lines)
        tested = lines_from_the_edge(lines, tables.lines, settings.arena.lines_within)
    else:
        found, tested = _estimate(invariants_table(crossings)), lines
    try:
        # interior stops draw lines in proportion to their length, and mean to
        isotropy = (
            None
            if settings.motion.turning is Policy.INTERIOR
            else examine_lines(
                tested["theta_rad"],
                tested["p_cm"],
                tested["length_cm"],
                settings.arena.lines_within,
                rng,
                chain=tested["line"].map(tables.lines.set_index("line")["robot"]) if several else None,
                shortest_cm=SHORTEST_RUN_CM,
            )
        )
    except TooFewLinesError:
        isotropy = None
    return Filmed(
        track,
        lines,
        crossings,
        match_crossings(
            tables.crossings,
            crossings,
            lines=_unlit_at_their_ends(lines["line"], tables.lines),
            near=near_chords(lines, geometry),
        ),
        found,
        isotropy,
        tested,
        straightness(lines),
        filter_health(track),
    )


def _unlit_at_their_ends(numbers: pd.Series[int], runs: pd.DataFrame) -> pd.Series[int]:
    """The runs whose chords all end at the shape's outline: a chord that the run itself cuts is no measured length."""
    cut = runs.loc[runs["starts_lit"] | runs["ends_lit"], "line"]
    return numbers[~numbers.isin(cut)]


def on_host_clock(track: pd.DataFrame, segments: Mapping[int, Path]) -> pd.DataFrame:
    """Move each segment's times from the camera's clock to the host's, which stamped the robot's crossings."""
    shift_s: dict[int, float] = {}
    for line, video in segments.items():
        stamps = pd.read_parquet(frames_table(video))
        shift_s[line] = float((stamps["t_host_s"] - stamps["t_camera_s"]).median()) if len(stamps) else 0.0
    return track.assign(t_s=track["t_s"] + track["line"].map(shift_s))


def summarise(found: Reviewed, result: SessionResult) -> dict[str, Any]:
    """The figures of a review: robot, camera and truth, chords, isotropy, homogeneity, error budget, verdict."""
    filmed = found.filmed
    match, isotropy = (filmed.match, filmed.isotropy) if filmed else (None, None)
    return {
        "folder": found.session.folder,
        "shape": found.shape.name,
        "lines": len(_counted(found.tables)),
        "runs": len(found.tables.lines),
        "robot": _figures(found.robot),
        "camera": _figures(filmed.estimate if filmed else None),
        "truth": {"area_cm2": found.shape.area_cm2, "perimeter_cm": found.shape.perimeter_cm},
        "recognised": _named(found.recognition),
        "chords": None if match is None else match.to_dict(),
        "straightness": filmed.straightness.to_dict() if filmed and filmed.straightness else None,
        "filter": filmed.health.to_dict() if filmed else None,
        "isotropy": None if isotropy is None else _isotropy_figures(isotropy, found),
        "homogeneity": None if isotropy is None else {"p_value": isotropy.homogeneity_p},
        "budget": None if found.budget is None else found.budget.to_dict(),
        "montecarlo": None if found.montecarlo is None else found.montecarlo.to_dict(),
        "run_lengths": None if found.runs is None else _run_figures(found.runs),
        "verdict": verdict_of(result).headline,
    }


def _named(found: Recognition) -> dict[str, Any]:
    name, posterior = found.ranking[0]
    unknown = float(found.unknown[-1]) if found.unknown.size else None
    return {"name": name, "posterior": posterior, "twins": list(found.twins_of(name)), "unknown": unknown}


def _figures(found: Estimate | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "area_cm2": found.area_cm2,
        "perimeter_cm": found.perimeter_cm,
        "sigma_area_cm2": found.sigma_area_cm2,
        "sigma_perimeter_cm": found.sigma_perimeter_cm,
        "correlation": found.correlation,
        "lines": found.n,
    }


def _isotropy_figures(isotropy: IsotropyReport, found: Reviewed) -> dict[str, Any]:
    try:
        bias = bias_from(isotropy, found.settings.arena.lines_within, found.shape.geometry)
    except TooFewHitsError:
        bias = None
    return {
        "p_value": isotropy.isotropy_p,
        "bias": isotropy.bias,
        "effect": isotropy.effect_dict(),
        "least_seen": isotropy.least_seen_dict(),
        "shape_bias": None if bias is None else bias.to_dict(),
        "verdict": isotropy.verdict if bias is None else f"{isotropy.verdict} {bias.sentence()}",
    }


def _run_figures(check: RunCheck) -> dict[str, Any]:
    lengths, bias = check.lengths, check.bias
    return {
        "mean_cm": lengths.mean_cm,
        "expected_cm": lengths.expected_cm,
        "p_value": lengths.p_value,
        "exponent": None if math.isnan(lengths.exponent) else lengths.exponent,
        "bias": None if bias is None else {"area_rel": bias.area_rel, "perimeter_rel": bias.perimeter_rel},
    }


def to_result(found: Reviewed, host: Mapping[str, Any] | None = None) -> SessionResult:
    """Everything that the report shows, as plain data."""
    filmed, manifest = found.filmed, found.session.manifest
    name = found.shape.name
    counted = _counted(found.tables)
    return SessionResult(
        name=name,
        title=found.shape.title,
        geometry=found.shape.geometry,
        arena=found.settings.arena.polygon,
        lines=found.tables.lines[found.tables.lines["counts"]],
        crossings=found.tables.crossings,
        estimates=found.tables.estimates,
        exact=Entry.of(found.titles[name], found.moments[name]),
        dictionary={key: Entry.of(found.titles[key], moments) for key, moments in found.moments.items()},
        ranking=found.recognition.ranking,
        twins=found.recognition.twins_of(found.recognition.ranking[0][0]),
        unknown=float(found.recognition.unknown[-1]) if found.recognition.unknown.size else 0.0,
        stop_at=found.settings.stop.until or 0.95,
        posteriors=found.recognition.posteriors,
        band=_band(found.shape.geometry, len(counted), found.settings.seed),
        track=filmed.track if filmed else None,
        true_lines=filmed.lines if filmed else None,
        true_crossings=filmed.crossings if filmed else None,
        camera=filmed.estimate if filmed else None,
        chord_pairs=filmed.match.pairs if filmed else None,
        chords_missed=filmed.match.missed if filmed else None,
        chords_extra=filmed.match.extra if filmed else None,
        isotropy=_isotropy(filmed, found.settings.arena.lines_within) if filmed else None,
        runs_check=found.runs,
        budget=found.budget,
        montecarlo=found.montecarlo,
        session=found.session.folder.name,
        provenance={
            "session": {
                "started": manifest.get("started"),
                "seed": manifest.get("seed"),
                "bench": "virtual" if manifest.get("virtual") else "real",
                "end": manifest.get("end", {}).get("state", "was cut short"),
                **(host or {}),
            },
            "devices": manifest.get("devices", {}),
            "shape": {"digest": manifest["shape"].get("digest"), "font": manifest["shape"].get("font")},
            "settings": manifest.get("settings", {}),
            "versions": manifest.get("versions", {}),
        },
        warnings=_warnings(found),
    )


def _band(geometry: Silhouette, lines: int, seed: int) -> Band | None:
    if lines < 2:
        return None
    checkpoints = np.unique(np.geomspace(2, lines, _BAND_POINTS).round().astype(np.int64))
    return Band.of(running_bands(geometry, checkpoints, _BAND_RUNS, np.random.default_rng(seed)))


def _isotropy(filmed: Filmed, reachable: Polygon) -> Isotropy | None:
    found = filmed.isotropy
    if found is None:
        return None
    u, v = LineSpace.of(reachable).uniforms(filmed.tested["theta_rad"], filmed.tested["p_cm"])
    p_values = {_TEST_TITLES.get(test.name, test.name): test.holm_p_value for test in found.tests}
    return Isotropy(u, v, p_values | {"mean run length": found.run_length_p}, found.passed, found.verdict)


def _warnings(found: Reviewed) -> list[str]:
    lines = found.tables.lines
    said: list[str] = []
    state = found.session.manifest.get("end", {}).get("state", "cut short")
    if state not in ("complete", "recognised"):
        said.append(f"The session ended early ({state}); what was recorded until then is whole.")
    given_up = int(lines["ended"].isin(["timeout", "stall"]).sum())
    if given_up > 0.02 * len(lines):
        said.append(f"{given_up} of {len(lines)} runs reached no wall and are left out: was the robot stuck or lifted?")
    if len(found.settings.robots) > 1:
        met = lines[lines["ended"].isin(["bump", "contact"])].sort_values("t_end_s")
        bumps = {str(robot): own["t_end_s"].tolist() for robot, own in met.groupby("robot")}
        flags, by_chance = contacts_among(bumps, CONTACT_WINDOW_S)
        contacts, walls = sum(map(sum, flags.values())), sum(by_chance.values())
        said.append(f"The robots met {contacts} times, some {walls:.0f} of which were walls hit by two at once.")
    if found.filmed is not None:
        unseen = int(lines["counts"].sum()) - len(found.filmed.lines)
        if unseen > 0.05 * len(lines):
            said.append(f"The camera could not follow {unseen} of {int(lines['counts'].sum())} runs.")
        if not found.filmed.health.honest:
            said.append(f"Of the camera's track: {found.filmed.health.verdict}.")
    return said


def review(
    folder: Path,
    *,
    report: bool,
    host: Mapping[str, Any] | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Examine a session, write its report when asked, and give its figures (``report``: its path, or None)."""
    found = examine(folder, workers=workers, progress=progress)
    result = to_result(found, host)
    return {**summarise(found, result), "report": write_report(result, folder / REPORT) if report else None}
