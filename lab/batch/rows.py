"""One session's figures as one flat row."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from analysis.estimate import Estimate
from analysis.montecarlo import simulate
from lab.review.filmed import Filmed
from lab.review.findings import summarise, to_result
from lab.review.review import examine
from lab.review.reviewed import Reviewed
from lab.spread.task import one_line
from lab.store.layout import SessionFolderError, to_json

_FLOAT, _COUNT, _FLAG, _TEXT = "float64", "Int64", "boolean", "str"
SIDES = (("area", "cm2"), ("perimeter", "cm"))
TERMS = ("speed", "latency", "sampling", "footprint", "parallax", "anisotropy", "counting", "rest")
TWINS = "; "
_SIMULATED_RUNS, _SIMULATED_LINES = 1000, 4_000_000


def _sized(*names: str) -> dict[str, str]:
    return {name.format(side=side, unit=unit): _FLOAT for name in names for side, unit in SIDES}


# Every column of a batch's table, with its pandas dtype, in their order.
COLUMNS: dict[str, str] = {
    "session": _TEXT,
    "root": _TEXT,
    "folder": _TEXT,
    "error": _TEXT,
    "shape": _TEXT,
    "lines": _COUNT,
    "runs": _COUNT,
    "rolling_s": _FLOAT,
    **_sized("truth_{side}_{unit}", "robot_{side}_{unit}", "robot_sigma_{side}_{unit}"),
    "robot_correlation": _FLOAT,
    **_sized("camera_{side}_{unit}", "camera_sigma_{side}_{unit}"),
    "camera_correlation": _FLOAT,
    **_sized("exact_sigma_{side}_{unit}", "simulated_sigma_{side}_{unit}"),
    **_sized("{side}_error_rel", "camera_{side}_error_rel", "{side}_z", "{side}_z_exact"),
    "recognised_name": _TEXT,
    "recognised_posterior": _FLOAT,
    "recognised_twins": _TEXT,
    "recognised_unknown": _FLOAT,
    "recognised_right": _FLAG,
    "chords_matched": _COUNT,
    "chords_missed": _COUNT,
    "chords_extra": _COUNT,
    "chords_bias_cm": _FLOAT,
    "chords_sd_cm": _FLOAT,
    "chords_scale": _FLOAT,
    "latency_entering_s": _FLOAT,
    "latency_entering_sigma_s": _FLOAT,
    "latency_leaving_s": _FLOAT,
    "latency_leaving_sigma_s": _FLOAT,
    "latency_jitter_s": _FLOAT,
    "isotropy_p_value": _FLOAT,
    "isotropy_bias": _FLOAT,
    **_sized("isotropy_{side}_rel"),
    "homogeneity_p_value": _FLOAT,
    "run_length_mean_cm": _FLOAT,
    "run_length_p_value": _FLOAT,
    "montecarlo_p_value": _FLOAT,
    "montecarlo_inside": _FLAG,
    **{name: _FLOAT for term in TERMS for name in _sized(f"budget_{{side}}_{term}_percent")},
    "budget_closes": _FLAG,
    "filter_honest": _FLAG,
    "filter_mean_nis": _FLOAT,
    "straight": _FLAG,
    "bend_cm": _FLOAT,
    "checksums_ok": _FLAG,
    "end_state": _TEXT,
    "runs_given_up": _COUNT,
    "link_losses": _COUNT,
    "frames": _COUNT,
    "frames_dropped": _COUNT,
    "frames_late": _COUNT,
    "parts": _COUNT,
    "verdict": _TEXT,
    "started": _TEXT,
    "seed": _TEXT,
    "virtual": _FLAG,
    "robots": _TEXT,
    "firmware": _TEXT,
    "schema_version": _COUNT,
    "chordlab_version": _TEXT,
    "content_digest": _TEXT,
    "settings_digest": _TEXT,
    "seconds": _FLOAT,
}


def row_of(folder: Path) -> dict[str, Any]:
    """Examine a session and give its row, in plain JSON values; what is not known is not in it.

    Nothing is written in the folder. What fails, of whatever kind, is the row's ``error`` in one line.
    """
    start_s = time.perf_counter()
    try:
        if not folder.is_dir():
            raise SessionFolderError(folder, "is not there; a cluster's workers need it under the same path")
        row = dict(_figures(examine(folder, workers=1)))
    except Exception as error:  # noqa: BLE001 - a broken session is a row, whatever breaks in it
        return {"error": one_line(error) or type(error).__name__}
    known = {name: _plain(value) for name, value in row.items()}
    return {
        "error": "",
        **{name: value for name, value in known.items() if value is not None},
        "seconds": time.perf_counter() - start_s,
    }


def _figures(found: Reviewed) -> Iterator[tuple[str, Any]]:
    yield from {"shape": found.shape.name, "runs": len(found.tables.lines)}.items()
    lines = found.tables.lines
    crossed = len(found.tables.crossed)
    yield "lines", crossed
    yield "rolling_s", (lines["t_end_s"] - lines["t_start_s"]).sum()
    yield from _sizes(found, crossed)
    recognition = found.recognition
    name, posterior = recognition.ranking[0]
    yield from {
        "recognised_name": name,
        "recognised_posterior": posterior,
        "recognised_twins": TWINS.join(recognition.twins_of(name)),
        "recognised_unknown": recognition.unknown[-1] if recognition.unknown.size else None,
        "recognised_right": found.shape.name in recognition.answer,
    }.items()
    yield from _judged(summarise(found, to_result(found)))
    if found.filmed is not None:
        yield from _filmed(found.filmed)
    yield from _health(found)
    yield from _provenance(found)


def _sizes(found: Reviewed, crossed: int) -> Iterator[tuple[str, Any]]:
    truth = np.array([found.shape.area_cm2, found.shape.perimeter_cm])
    yield from _sides("truth_{side}_{unit}", truth)
    seen = {"robot": found.robot, "camera": found.filmed.estimate if found.filmed is not None else None}
    for who, estimate in seen.items():
        if estimate is not None:
            yield from _sides(f"{who}_{{side}}_{{unit}}", _pair(estimate))
            yield from _sides(f"{who}_sigma_{{side}}_{{unit}}", np.sqrt(np.diag(estimate.covariance)))
            yield f"{who}_correlation", estimate.correlation
            of_whom = "" if who == "robot" else f"{who}_"
            yield from _sides(f"{of_whom}{{side}}_error_rel", _pair(estimate) / truth - 1)
    if crossed == 0:
        return
    exact = np.sqrt(np.diag(found.moments[found.shape.name].covariance_at(crossed)))
    yield from _sides("exact_sigma_{side}_{unit}", exact)
    runs = max(3, min(_SIMULATED_RUNS, _SIMULATED_LINES // crossed))
    rng = np.random.default_rng([found.settings.seed, crossed])
    simulated = simulate(found.shape.geometry, lines=crossed, runs=runs, rng=rng)
    yield from _sides("simulated_sigma_{side}_{unit}", np.sqrt(np.diag(simulated.covariance)))
    if found.robot is not None:
        off = _pair(found.robot) - truth
        own = np.sqrt(np.diag(found.robot.covariance))
        yield from _sides("{side}_z", np.divide(off, own, out=np.full(2, np.nan), where=own > 0))
        yield from _sides("{side}_z_exact", off / exact)


def _pair(estimate: Estimate) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([estimate.area_cm2, estimate.perimeter_cm])


def _sides(name: str, values: np.ndarray[Any, np.dtype[np.float64]]) -> Iterator[tuple[str, float]]:
    for (side, unit), value in zip(SIDES, values, strict=True):
        yield name.format(side=side, unit=unit), float(value)


def _judged(summary: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """What a review says beyond the sizes; a section that a session has no figures for is None."""
    isotropy, lengths, curve = summary["isotropy"], summary["run_lengths"], summary["montecarlo"]
    if isotropy is not None:
        yield from {"isotropy_p_value": isotropy["p_value"], "isotropy_bias": isotropy["bias"]}.items()
        yield "homogeneity_p_value", summary["homogeneity"]["p_value"]
        if isotropy["shape_bias"] is not None:
            for side, _ in SIDES:
                yield f"isotropy_{side}_rel", isotropy["shape_bias"][f"{side}_rel"]
    if lengths is not None:
        yield from {"run_length_mean_cm": lengths["mean_cm"], "run_length_p_value": lengths["p_value"]}.items()
    if curve is not None:
        yield from {"montecarlo_p_value": curve["band_p_value"], "montecarlo_inside": curve["inside"]}.items()
    budget = summary["budget"]
    if budget is not None:
        for side, _ in SIDES:
            for term in budget[side]:
                yield f"budget_{side}_{term['term']}_percent", term["percent"]
        yield "budget_closes", budget["closes"]
    yield "verdict", summary["verdict"]


def _filmed(filmed: Filmed) -> Iterator[tuple[str, Any]]:
    match, health = filmed.match, filmed.health
    for name in ("matched", "missed", "extra", "bias_cm", "sd_cm", "scale"):
        yield f"chords_{name}", getattr(match, name)
    for name, side in (("entering", match.entering), ("leaving", match.leaving)):
        yield from {f"latency_{name}_s": side.mean_s, f"latency_{name}_sigma_s": side.sigma_s}.items()
    yield "latency_jitter_s", match.jitter_s
    yield from {"filter_honest": health.honest, "filter_mean_nis": health.mean_nis}.items()
    if filmed.straightness is not None:
        yield from {"straight": not filmed.straightness.significant, "bend_cm": filmed.straightness.bend_cm}.items()


def _health(found: Reviewed) -> Iterator[tuple[str, Any]]:
    ended = found.tables.lines["ended"]
    films: list[Mapping[str, Any]] = []
    losses = 0
    for event in found.session.events():
        losses += event["event"] == "lost"
        if event["event"] == "line" and event.get("video"):
            films.append(event["video"])
    yield from {
        "end_state": _section(found.session.manifest, "end").get("state", "cut"),
        "runs_given_up": ended.isin(["stall", "timeout"]).sum(),
        "link_losses": losses,
        "parts": 1 + len(found.session.manifest.get("parts") or ()),
    }.items()
    if films:
        for column, name in (("frames", "frames"), ("frames_dropped", "dropped"), ("frames_late", "late")):
            yield column, sum(int(film.get(name) or 0) for film in films)


def _provenance(found: Reviewed) -> Iterator[tuple[str, Any]]:
    manifest = found.session.manifest
    devices = _section(manifest, "devices")
    robots: list[Mapping[str, Any]] = devices.get("robots") or [_section(devices, "robot")]
    settings = {name: value for name, value in _section(manifest, "settings").items() if name != "seed"}
    yield from {
        "started": manifest.get("started"),
        "seed": str(found.settings.seed),  # may be larger than any integer of a table
        "virtual": bool(manifest.get("virtual")),
        "robots": ", ".join(str(robot.get("name")) for robot in robots),
        "firmware": ", ".join(dict.fromkeys(str(robot.get("firmware")) for robot in robots)),
        "schema_version": found.session.schema_version,
        "chordlab_version": _section(manifest, "versions").get("chordlab"),
        "settings_digest": hashlib.sha256(to_json(settings).encode()).hexdigest(),
    }.items()


def _section(record: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    return record.get(name) or {}


def _plain(value: Any) -> Any:
    """A value as JSON has it; numbers that are not finite as None."""
    plain = cast("Any", value).item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
