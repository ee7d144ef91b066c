"""Tables of a batch with a known truth, drawn with numpy alone: honest sessions, to which tests add one fault each."""

from __future__ import annotations

import numpy as np
import pandas as pd

# area (cm²), perimeter (cm), relative σ of A and P for one line: the order of magnitude of real shapes
SHAPES = {
    "square": (1936.0, 176.0, 0.42, 0.30),
    "circle": (1257.0, 125.7, 0.40, 0.24),
    "triangle": (900.0, 140.0, 0.55, 0.36),
    "eiffel": (700.0, 210.0, 1.1, 0.8),
}
CORRELATION = 0.4


def batch(sessions: int, *, shapes=("square", "circle", "triangle", "eiffel"), seed=1, video=True) -> pd.DataFrame:
    """``sessions`` honest sessions, the shapes in turn."""
    rng = np.random.default_rng(seed)
    started = pd.Timestamp("2026-11-20T09:00:00+00:00")
    rows = []
    for index in range(sessions):
        shape = shapes[index % len(shapes)]
        area, perimeter, sigma_a, sigma_p = SHAPES.get(shape, (1000.0, 150.0, 0.5, 0.4))
        lines = int(rng.integers(40, 400))
        z_a, z_p = rng.multivariate_normal([0, 0], [[1, CORRELATION], [CORRELATION, 1]])
        own_a, own_p = rng.normal(1, 0.3 / np.sqrt(lines), 2)
        rel_a, rel_p = z_a * sigma_a / np.sqrt(lines), z_p * sigma_p / np.sqrt(lines)
        begun = started + pd.Timedelta(minutes=37 * index)
        row = {
            "session": f"{begun:%Y-%m-%dT%H%M}_{shape}_{index:04x}",
            "root": "sessions",
            "folder": f"{begun:%Y-%m-%dT%H%M}_{shape}_{index:04x}",
            "error": "",
            "shape": shape,
            "lines": lines,
            "runs": 2 * lines,
            "truth_area_cm2": area,
            "truth_perimeter_cm": perimeter,
            "robot_area_cm2": area * (1 + rel_a),
            "robot_perimeter_cm": perimeter * (1 + rel_p),
            "robot_sigma_area_cm2": area * sigma_a / np.sqrt(lines) * own_a,
            "robot_sigma_perimeter_cm": perimeter * sigma_p / np.sqrt(lines) * own_p,
            "robot_correlation": CORRELATION,
            "exact_sigma_area_cm2": area * sigma_a / np.sqrt(lines),
            "exact_sigma_perimeter_cm": perimeter * sigma_p / np.sqrt(lines),
            "area_error_rel": rel_a,
            "perimeter_error_rel": rel_p,
            "area_z": z_a / own_a,
            "perimeter_z": z_p / own_p,
            "area_z_exact": z_a,
            "perimeter_z_exact": z_p,
            "recognised_name": shape,
            "recognised_posterior": 1 - 10.0 ** -rng.uniform(2, 8),
            "recognised_twins": "",
            "recognised_unknown": 0.001,
            "recognised_right": True,
            "run_length_p_value": rng.uniform(),
            "montecarlo_p_value": rng.uniform(),
            "end_state": "complete",
            "runs_given_up": int(rng.poisson(0.01 * lines)),
            "link_losses": 0,
            "parts": 1,
            "started": begun.isoformat(),
            "seed": str(100 + index),
            "virtual": True,
            "robots": "SB-1234",
            "firmware": "7.0",
            "schema_version": 3,
            "chordlab_version": "0.1.0",
            "settings_digest": shape,
        }
        if video:
            row |= {
                "isotropy_p_value": rng.uniform(),
                "homogeneity_p_value": rng.uniform(),
                "latency_entering_s": rng.normal(0.040, 0.002),
                "latency_leaving_s": rng.normal(0.035, 0.002),
                "latency_jitter_s": abs(rng.normal(0.008, 0.0005)),
                "filter_mean_nis": rng.normal(2, 0.05),
                "filter_honest": True,
                "frames": 9000,
                "frames_dropped": int(rng.poisson(3)),
            }
        rows.append(row)
    return pd.DataFrame(rows)


def biased(table: pd.DataFrame, shape: str, *, area_z: float = 0.0, perimeter_z: float = 0.0) -> pd.DataFrame:
    """The same sessions, those of one shape off by so many of their σ."""
    table = table.copy()
    own = table["shape"] == shape
    for quantity, unit, shift in (("area", "cm2", area_z), ("perimeter", "cm", perimeter_z)):
        sigma, truth = table[f"exact_sigma_{quantity}_{unit}"], table[f"truth_{quantity}_{unit}"]
        table.loc[own, f"robot_{quantity}_{unit}"] += shift * sigma[own]
        table.loc[own, f"{quantity}_error_rel"] += shift * sigma[own] / truth[own]
        table.loc[own, f"{quantity}_z"] += shift * sigma[own] / table.loc[own, f"robot_sigma_{quantity}_{unit}"]
        table.loc[own, f"{quantity}_z_exact"] += shift
    return table


def broken(table: pd.DataFrame, index: int, reason: str) -> pd.DataFrame:
    """The same sessions, one of which could not be analysed: nothing is known of it but where it is and why."""
    table = table.astype(object)
    row = table.index[index]
    kept = {"session", "root", "folder"}
    table.loc[row, [name for name in table.columns if name not in kept]] = None
    table.loc[row, "error"] = reason
    return table
