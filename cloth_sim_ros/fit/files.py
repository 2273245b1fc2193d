# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Output files of a fit: JSON, parameter file and plot."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.fit.fit import Estimate, Fit, fitted_positions
from cloth_sim_ros.fit.information import ConfoundedDirection
from cloth_sim_ros.fit.motions_result import MotionFit
from cloth_sim_ros.fit.parameters import scene_with
from cloth_sim_ros.fit.recording import visible_mask
from cloth_sim_ros.fit.text import verdict
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.output_files import atomic_write


def write_json(fit: Fit, path: Path) -> None:
    """Write all numbers of a fit to a JSON file; numbers that are not finite are null. Raises OSError."""
    content: dict[str, Any] = {
        "name": fit.name,
        "all_identified": fit.all_identified,
        "parameters": [estimate_entry(estimate, fit.within) for estimate in fit.estimates],
        "covariance": fit.covariance.tolist(),
        "confounded": [confounded_entry(direction) for direction in fit.confounded],
        "sigma": fit.sigma,
        "sigma_prescribed": fit.is_sigma_prescribed,
        "rms": fit.rms,
        "correlation": fit.correlation,
        "clouds": fit.n_clouds,
        "all_clouds": fit.n_recorded_clouds,
        "until": fit.end_time,
        "missing": fit.missing_fraction,
        "shift": fit.shift,
        "reason": fit.reason,
        "doubt": fit.doubt,
        "unreadable": fit.recording.unreadable,
        "runs": fit.n_runs,
        "tolerance": fit.tolerance,
        "within": fit.within,
        "grasped": [attrs.asdict(grasped) for grasped in fit.recording.grasped],
        "by_cloud": {
            "seconds": fit.seconds.tolist(),
            "before": fit.rms_before.tolist(),
            "after": fit.rms_after.tolist(),
        },
    }
    content = old_keys.add_old_keys(content, old_keys.FIT)
    with atomic_write(path) as output:
        output.write_text(json.dumps(finite_or_none(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def estimate_entry(estimate: Estimate, within: float) -> dict[str, Any]:
    """Return a parameter's estimate as a JSON object; without an interval, bound and interval are None."""
    has_interval = estimate.has_interval
    return {
        "name": estimate.parameter.name,
        "unit": estimate.parameter.unit,
        "value": estimate.value,
        "start": estimate.parameter.start,
        "bound": estimate.bound if has_interval else None,
        "interval": estimate.interval if has_interval and math.isfinite(estimate.bound) else None,
        "identified": estimate.is_identified,
        "verdict": verdict(estimate, within),
    }


def confounded_entry(direction: ConfoundedDirection) -> dict[str, Any]:
    """Return a confounded direction as a JSON object."""
    return {
        "parameters": [p.name for p in direction.parameters],
        "components": list(direction.components),
        "bound": direction.bound,
    }


def write_parameters(fit: Fit | MotionFit, path: Path) -> list[str]:
    """Write the scene with the identified parameters as a ROS parameter file; return their full names.

    Other parameters keep the scene's values.

    Returns:
        Full names of the identified parameters.
    """
    identified = [estimate for estimate in fit.estimates if estimate.is_identified]
    values = [float(f"{estimate.value:.6g}") for estimate in identified]
    scene = scene_with(fit.scene, [estimate.parameter for estimate in identified], values)
    lines = [f"# The scene of {fit.name} with the parameters that cloth_fit identified:"]
    for estimate in fit.estimates:
        low, high = estimate.interval
        if estimate.is_identified:
            lines.append(f"#   {estimate.parameter.name}: {estimate.value:.6g}, 95 % {low:.4g} to {high:.4g}")
        else:
            lines.append(f"#   {estimate.parameter.name}: not identified by these clouds; the scene's value is kept")
    lines += [f"# No parameter is identified: {fit.doubt}."] if fit.doubt else []
    # The recording's name need not be UTF-8.
    comment = "\n".join(lines).encode(errors="backslashreplace").decode()
    with atomic_write(path) as output:
        output.write_text(f"{comment}\n{parameter_file.dump(scene.parameters())}", encoding="utf-8")
    return [estimate.parameter.name for estimate in identified]


def absent_files(fit: Fit | MotionFit, path: Path) -> list[str]:
    """Return the names of the scene's files that are absent from the folder of a written parameter file."""
    return [name for name in fit.scene.files if not (path.parent / name).exists()]


def write_plot(fit: Fit, path: Path) -> None:
    """Write a PNG of the residuals over time, before and after the fit, and of their distribution."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1)
    above.semilogy(fit.seconds, 1e3 * fit.rms_before, "0.6", linewidth=1.2, label="with the starting values")
    above.semilogy(fit.seconds, 1e3 * fit.rms_after, "C0-", linewidth=1.4, label="fitted")
    above.axhline(1e3 * fit.sigma, color="k", linestyle=":", linewidth=1.0, label="deviation of a coordinate")
    above.set(
        xlabel="time of the cloud [s]",
        ylabel="residual, root mean square [mm]",
        title=f"{fit.name}: clouds against the fitted cloth",
    )
    above.legend(fontsize=8)
    above.grid(which="both", alpha=0.2)
    if fit.recording.matched:
        positions = fitted_positions(fit) + (0.0 if fit.shift is None else np.array(fit.shift))
        residuals = [
            cloud[visible_mask(cloud)] - x[visible_mask(cloud)]
            for cloud, x in zip(fit.recording.clouds, positions, strict=False)
        ]
        residuals_mm = 1e3 * np.concatenate(residuals)
        limit = max(4.0 * 1e3 * fit.rms, 1e-6)
        grid = np.linspace(-limit, limit, 81)
        for axis, name in enumerate("xyz"):
            below.hist(residuals_mm[:, axis], bins=list(grid), histtype="step", density=True, label=name)
        sigma = 1e3 * fit.sigma
        below.plot(grid, np.exp(-0.5 * (grid / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi)), "k:", label="normal")
        below.set(xlabel="measured less fitted [mm]", ylabel="density")
        below.legend(fontsize=8)
    else:
        below.plot(fit.seconds, 1e3 * fit.rms_after, "C0.")
        below.set(xlabel="time of the cloud [s]", ylabel="distance from the surface, rms [mm]")
    with atomic_write(path) as output:
        figure.savefig(output, dpi=120, format="png")


def finite_or_none(value: Any) -> Any:
    """Return a copy of a JSON tree in which None replaces the numbers that are not finite."""
    if isinstance(value, dict):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
