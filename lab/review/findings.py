"""What a review found, as the figures of a summary and as everything that a report shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from shapely import Polygon

from analysis.estimate import Estimate
from analysis.figures.values import Band, Entry, Isotropy
from analysis.montecarlo import running_bands
from analysis.report.result import ENDED_WELL, RunCheck, SessionResult
from analysis.report.verdict import verdict_of
from lab.recognise.recognisers import Recognition
from lab.review.filmed import Filmed
from lab.review.history import history_of
from lab.review.reviewed import Reviewed
from lab.session.session import CONTACT_WINDOW_S
from projector.shape import Silhouette
from robot.contacts import contacts_among
from tracking.anisotropy import TooFewHitsError, bias_from
from tracking.isotropy import IsotropyReport
from tracking.linespace import LineSpace

_TEST_TITLES = {
    "rayleigh": "Rayleigh, directions",
    "hermans_rasson": "Hermans–Rasson, directions",
    "cramer_von_mises": "Cramér–von Mises, places",
    "neyman": "Neyman, directions and places",
}
_BAND_RUNS = 400
_BAND_POINTS = 40


def summarise(found: Reviewed, result: SessionResult) -> dict[str, Any]:
    """The figures of a review: robot, camera and truth, chords, isotropy, homogeneity, error budget, verdict."""
    filmed = found.filmed
    match, isotropy = (filmed.match, filmed.isotropy) if filmed else (None, None)
    return {
        "folder": found.session.folder,
        "shape": found.shape.name,
        "lines": len(found.tables.crossed),
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
        bias = bias_from(isotropy.evidence, found.settings.arena.lines_within, found.shape.geometry)
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
    counted = found.tables.crossed
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
                **({"resumed": [part["started"] for part in manifest["parts"]]} if manifest.get("parts") else {}),
                **(host or {}),
            },
            "devices": manifest.get("devices", {}),
            "shape": {"digest": manifest["shape"].get("digest"), "font": manifest["shape"].get("font")},
            "settings": manifest.get("settings", {}),
            "versions": manifest.get("versions", {}),
        },
        history=history_of(found.session.events()),
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
    if state not in ENDED_WELL:
        folder = found.session.folder.name
        mend = f"`chordlab recover {folder}`, then " if state == "cut short" else ""
        said.append(
            f"The session ended early ({state}); what was recorded until then is whole. To go on with it: {mend}"
            f"`chordlab run --resume {folder} --lines {found.settings.stop.lines}`."
        )
    given_up = int(lines["ended"].isin(["timeout", "stall"]).sum())
    if given_up > 0.02 * len(lines):
        said.append(f"{given_up} of {len(lines)} runs reached no wall and are left out: was the robot stuck or lifted?")
    if len(found.settings.robots) > 1:
        met = lines[lines["ended"].isin(["bump", "contact"])].sort_values("t_end_s")
        bumps = {str(robot): own["t_end_s"].tolist() for robot, own in met.groupby("robot")}
        flags, by_chance = contacts_among(bumps, CONTACT_WINDOW_S)
        contacts, walls = sum(map(sum, flags.values())), sum(by_chance.values())
        said.append(
            f"The robots met {contacts} times; some {walls:.0f} of these may be two robots at walls at the same moment."
        )
    if found.filmed is not None:
        unseen = int(lines["counts"].sum()) - len(found.filmed.lines)
        if unseen > 0.05 * len(lines):
            said.append(
                f"The camera could not follow {unseen} of {int(lines['counts'].sum())} runs: is the whole arena in its "
                "picture, and the LED brighter than the projected light?"
            )
        if not found.filmed.health.honest:
            said.append(f"Of the camera's track: {found.filmed.health.verdict}.")
    return said
