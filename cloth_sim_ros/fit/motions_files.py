# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Output files of a fit to several motions: JSON and plot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import attrs

from cloth_sim_ros.fit.files import confounded_entry, estimate_entry, finite_or_none
from cloth_sim_ros.fit.motions_result import MotionFit
from cloth_sim_ros.fit.scores import Score
from cloth_sim_ros.session.output_files import atomic_write


def write_json(fit: MotionFit, path: Path) -> None:
    """Write all numbers of a fit to several motions to a JSON file; numbers that are not finite are null."""
    has_intervals = fit.covariance.has_intervals
    content: dict[str, Any] = {
        "name": fit.name,
        "all_identified": fit.all_identified,
        "parameters": [{**estimate_entry(e, fit.within), "freedom": e.freedom} for e in fit.estimates],
        "covariance": fit.covariance.matrix.tolist() if has_intervals else None,
        "confounded": [confounded_entry(direction) for direction in fit.confounded],
        "time_offset": fit.alignment_model.time,
        "camera_pose": fit.alignment_model.camera,
        "pivot": list(fit.alignment_model.pivot),
        "alignment": [None if alignment is None else attrs.asdict(alignment) for alignment in fit.alignments],
        "grasped": None
        if fit.grasp is None
        else {
            "named": fit.grasp.is_named,
            "tie": fit.grasp.is_tie,
            "hypotheses": [
                {"particles": {name: list(p) for name, p in h.particles.items()}, "mean_distance": h.score}
                for h in fit.grasp.hypotheses
            ],
        },
        "sigma": fit.sigma,
        "smooth_share": fit.smooth_share,
        "loss": fit.loss,
        "fitted": _score(fit.fitted),
        "held_out": None if fit.held_out is None else _score(fit.held_out),
        "rigid": _score(fit.rigid),
        "floor": None if fit.floor is None else _score(fit.floor),
        "floor_basis": fit.floor_basis,
        "excess": fit.excess,
        "motions": [
            {
                "name": entry.name,
                "held_out": entry.is_held_out,
                "model": _score(entry.model),
                "rigid": _score(entry.rigid),
            }
            for entry in fit.motions
        ],
        "clouds": fit.n_clouds,
        "all_clouds": fit.n_recorded_clouds,
        "left_out": attrs.asdict(fit.left_out),
        "missing": fit.missing_fraction,
        "suspicious": list(fit.suspicious),
        "doubt": fit.doubt,
        "runs": fit.n_runs,
        "tolerance": fit.tolerance,
        "within": fit.within,
    }
    with atomic_write(path) as output:
        output.write_text(json.dumps(finite_or_none(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_plot(fit: MotionFit, path: Path) -> None:
    """Write a PNG of each motion's rms distance from the fitted cloth and from the cloth carried rigidly [mm]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    places = range(len(fit.motions))
    axes.plot(places, [1e3 * entry.rigid.rms for entry in fit.motions], "0.6", marker="s", label="carried rigidly")
    label = "fitted without the motion" if fit.held_out is not None else "fitted"
    axes.plot(places, [1e3 * entry.model.rms for entry in fit.motions], "C0", marker="o", label=label)
    if fit.floor is not None:
        axes.axhline(1e3 * fit.floor.rms, color="k", linestyle=":", label=f"floor: {fit.floor_basis}")
    axes.set(ylabel="distance of the points, root mean square [mm]", title=fit.name, ylim=(0.0, None))
    axes.set_xticks(list(places), [entry.name for entry in fit.motions], rotation=90, fontsize=7)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.2)
    with atomic_write(path) as output:
        figure.savefig(output, dpi=120, format="png")


def _score(entry: Score) -> dict[str, float]:
    return {"median": entry.median, "quantile_95": entry.quantile_95, "rms": entry.rms}
