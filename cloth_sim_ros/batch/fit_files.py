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

from cloth_sim_ros.batch.fit import Fit, path_of
from cloth_sim_ros.batch.fit_parameters import scene_with
from cloth_sim_ros.batch.fit_recording import visible
from cloth_sim_ros.batch.fit_text import verdict
from cloth_sim_ros.scene import parameter_file
from cloth_sim_ros.session.outputs import written_whole


def write_json(fit: Fit, path: Path) -> None:
    """Write all numbers of a fit as JSON; numbers that are not finite are null."""
    content: dict[str, Any] = {
        "name": fit.name,
        "all_told": fit.all_told,
        "parameters": [
            {
                "name": estimate.parameter.name,
                "unit": estimate.parameter.unit,
                "value": estimate.value,
                "start": estimate.parameter.start,
                "bound": estimate.bound,
                "interval": estimate.interval if math.isfinite(estimate.bound) else None,
                "told": estimate.told,
                "verdict": verdict(estimate, fit.within),
            }
            for estimate in fit.estimates
        ],
        "ties": [
            {"parameters": [p.name for p in tie.parameters], "parts": list(tie.parts), "bound": tie.bound}
            for tie in fit.ties
        ],
        "sigma": fit.sigma,
        "sigma_given": fit.sigma_given,
        "rms": fit.rms,
        "correlation": fit.correlation,
        "clouds": fit.clouds,
        "all_clouds": fit.all_clouds,
        "until": fit.until,
        "missing": fit.missing,
        "shift": fit.shift,
        "reason": fit.reason,
        "doubt": fit.doubt,
        "lost": fit.recording.lost,
        "runs": fit.runs,
        "tolerance": fit.tolerance,
        "within": fit.within,
        "held": [attrs.asdict(held) for held in fit.recording.held],
        "by_cloud": {
            "seconds": fit.seconds.tolist(),
            "before": fit.before.tolist(),
            "after": fit.after.tolist(),
        },
    }
    with written_whole(path) as place:
        place.write_text(json.dumps(_plain(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_parameters(fit: Fit, path: Path) -> list[str]:
    """Write the scene with the identified parameters as a ROS parameter file.

    Other parameters keep the scene's values.

    Returns:
        Full names of the identified parameters.
    """
    told = [estimate for estimate in fit.estimates if estimate.told]
    values = [float(f"{estimate.value:.6g}") for estimate in told]
    scene = scene_with(fit.recording.scene, [estimate.parameter for estimate in told], values)
    lines = [f"# The scene of {fit.name} with the parameters that cloth_fit identified:"]
    for estimate in fit.estimates:
        low, high = estimate.interval
        if estimate.told:
            lines.append(f"#   {estimate.parameter.name}: {estimate.value:.6g}, 95 % {low:.4g} to {high:.4g}")
        else:
            lines.append(f"#   {estimate.parameter.name}: not identified by these clouds; the scene's value is kept")
    lines += [f"# No parameter is identified: {fit.doubt}."] if fit.doubt else []
    with written_whole(path) as place:
        place.write_text("\n".join(lines) + "\n" + parameter_file.dump(scene.parameters()), encoding="utf-8")
    return [estimate.parameter.name for estimate in told]


def write_plot(fit: Fit, path: Path) -> None:
    """Plot the residuals over time, before and after the fit, and their distribution."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1)
    above.semilogy(fit.seconds, 1e3 * fit.before, "0.6", linewidth=1.2, label="with the starting values")
    above.semilogy(fit.seconds, 1e3 * fit.after, "C0-", linewidth=1.4, label="fitted")
    above.axhline(1e3 * fit.sigma, color="k", linestyle=":", linewidth=1.0, label="deviation of a coordinate")
    above.set(
        xlabel="time of the cloud [s]",
        ylabel="residual, root mean square [mm]",
        title=f"{fit.name}: clouds against the fitted cloth",
    )
    above.legend(fontsize=8)
    above.grid(which="both", alpha=0.2)
    if fit.recording.matched:
        found = path_of(fit) + (0.0 if fit.shift is None else np.array(fit.shift))
        parts = [
            cloud[visible(cloud)] - x[visible(cloud)] for cloud, x in zip(fit.recording.clouds, found, strict=False)
        ]
        away = 1e3 * np.concatenate(parts)
        reach = max(4.0 * 1e3 * fit.rms, 1e-6)
        grid = np.linspace(-reach, reach, 81)
        for axis, name in enumerate("xyz"):
            below.hist(away[:, axis], bins=list(grid), histtype="step", density=True, label=name)
        sigma = 1e3 * fit.sigma
        below.plot(grid, np.exp(-0.5 * (grid / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi)), "k:", label="normal")
        below.set(xlabel="measured less fitted [mm]", ylabel="density")
        below.legend(fontsize=8)
    else:
        below.plot(fit.seconds, 1e3 * fit.after, "C0.")
        below.set(xlabel="time of the cloud [s]", ylabel="distance from the surface, rms [mm]")
    with written_whole(path) as place:
        figure.savefig(place, dpi=120, format="png")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
