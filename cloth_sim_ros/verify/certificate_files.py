# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificate as JSON and as a plot."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import attrs

from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.output_files import atomic_write
from cloth_sim_ros.verify.certificate import Certificate
from cloth_sim_ros.verify.verdict import Verdict


def write_json(certificate: Certificate, path: Path, verdict: Verdict) -> None:
    """Write a certificate and the verdict of the re-run to a JSON file; unknown numbers are null. Raises OSError."""
    content = attrs.asdict(certificate)
    content["run"] = {
        "same": verdict.same,
        "frames": verdict.frames,
        "compared": dict(verdict.compared),
        "differing": dict(verdict.differing),
        "first_frame": verdict.first_frame,
        "first_reason": verdict.first_reason,
        "not_compared": [
            {"topic": topic, "reason": reason, "count": count}
            for (topic, reason), count in sorted(verdict.not_compared.items())
        ],
        "absent": verdict.absent,
        "missing": verdict.missing,
    }
    for entry, window in zip(content["windows"], certificate.windows, strict=True):
        entry |= {"error_bound": window.error_bound, "verdict": window.verdict}
    for entry, frame in zip(content["frames"], certificate.frames, strict=True):
        entry["error_bound"] = frame.error_bound
    for entry, sample in zip(content["samples"], certificate.samples, strict=True):
        entry["agrees"] = sample.agrees
    content["satisfied"] = certificate.is_satisfied
    content = old_keys.add_old_keys(content, old_keys.CERTIFICATE)
    with atomic_write(path) as output:
        output.write_text(json.dumps(_plain(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_plot(certificate: Certificate, path: Path) -> None:
    """Write a PNG of errors, error bound, amplification and uncertainty over time [s]. Raises OSError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    frames = certificate.frames
    times = [frame.time for frame in frames]
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    error_axes, amplification_axes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    lines: dict[str, tuple[list[float], str]] = {
        "allowed: tolerance x amplification": ([frame.error_bound for frame in frames], "k-"),
        "tolerance": ([math.nan if frame.tolerance is None else frame.tolerance for frame in frames], "k:"),
        "error since the window's start": ([frame.error for frame in frames], "C3-"),
        "error of the frame alone": ([frame.error_of_frame for frame in frames], "C1-"),
        "error since the beginning": ([frame.session_error for frame in frames], "C0-"),
        "uncertainty of the certificate": ([frame.uncertainty for frame in frames], "C2--"),
        "rounding": ([frame.floor for frame in frames], "0.6"),
    }
    for name, (values, style) in lines.items():
        # A logarithmic axis cannot show an error of 0.
        plotted = [value if value > 0.0 else math.nan for value in values]
        if not all(map(math.isnan, plotted)):
            error_axes.semilogy(times, plotted, style, linewidth=1.2, label=name)
    flagged = [(frame.time, frame.error) for frame in frames if frame.flagged and frame.error > 0.0]
    if flagged:
        error_axes.semilogy(*zip(*flagged, strict=True), "kx", markersize=5, label="flagged by the simulation")
    amplification_axes.semilogy(
        times, [frame.amplification for frame in frames], "C4-", linewidth=1.2, label="in the window"
    )
    amplification_axes.semilogy(
        times, [frame.session_amplification for frame in frames], "C0-", linewidth=1.2, label="since the beginning"
    )
    error_axes.set(ylabel="position [m]", title=f"{certificate.name}: error of the recording")
    amplification_axes.set(xlabel="simulated time [s]", ylabel="amplification")
    for axes in (error_axes, amplification_axes):
        axes.grid(which="both", alpha=0.2)
        axes.legend(fontsize=7)
    with atomic_write(path) as output:
        figure.savefig(output, dpi=120, format="png")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
