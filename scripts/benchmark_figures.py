# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Six figures of docs/benchmarks.md, drawn from the rows in docs/data."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from validation.report import Report

Reports = dict[str, Report]
Points = dict[str, list[tuple[float, float]]]
#: Colour of the product in each figure that compares it with others.
PRODUCT_COLOUR = "black"
#: Larger errors [m] say that a solver failed.
MAX_DRAWN_ERROR = 1e-2


def draw_figures(reports: Reports, folder: Path) -> None:
    """Write bench_NAME.png for each figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    for name, draw in FIGURES.items():
        figure = Figure(figsize=(10.0, 4.2), layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure.subplots(1, 2), reports)
        figure.savefig(folder / f"bench_{name}.png", dpi=100, metadata={"Software": None})


def draw_speed(axes: Any, reports: Reports) -> None:
    """Draw speed, and time per spring, against size."""
    speed, springs = Points(), Points()
    for row in reports["speed"].table("Scene C as shipped").records():
        if row["cores"] == "all":
            point = row["N"] ** 2, row["x real time"]
            speed.setdefault(f"tolerance {1e3 * row['tolerance m']:g} mm", []).append(point)
    for row in reports["speed"].table("Nanoseconds per spring").records():
        for column in ("whole step", "C forces"):
            if row[column] != "-":
                springs.setdefault(f"{column}, {row['precision']}", []).append((row["N"] ** 2, row[column]))
    _draw_curves(axes[0], speed, "particles", "simulated seconds per second")
    _draw_real_time(axes[0])
    axes[0].set_title("A curtain, all cores")
    _draw_curves(axes[1], springs, "particles", "ns per spring")
    axes[1].set(title="A step, one core", yscale="linear", ylim=(0.0, None))


def draw_threads(axes: Any, reports: Reports) -> None:
    """Draw the gain of a second thread for one cloth and for many."""
    gains = Points()
    for row in reports["speed"].table("A frame of 1/60 s on two threads").records():
        for column, label in (("gain", "one sheet"), ("two sheets apart", "two separate sheets")):
            gains.setdefault(f"{label}, {row['precision']}", []).append((row["N"], row[column]))
    _draw_curves(axes[0], gains, "particles a side", "speedup over one thread")
    axes[0].set(title="One cloth on two threads", xscale="linear", yscale="linear")
    (environment,) = reports["batch"].table("A step of the vector environment").records()
    speedups = [1.0, environment["gain"], environment["two processes"]]
    _draw_bars(axes[1], ["one thread", "two threads", "two processes"], {f"{environment['cloths']} cloths": speedups})
    axes[1].set(title="A vector environment", ylabel="speedup over one thread")
    for axis in axes:
        axis.set_ylim(0.0, 2.3)


def draw_work_precision(axes: Any, reports: Reports) -> None:
    """Draw time against error of the product and of library solvers."""
    for axis, resolution in zip(axes, (16, 32), strict=True):
        curves = Points()
        for row in reports[f"work-precision-{resolution}"].table("All runs").records():
            if row["error m"] < MAX_DRAWN_ERROR:
                curves.setdefault(row["solver"], []).append((row["error m"], row["wall s"]))
        _draw_curves(axis, curves, "largest position error [m]", "wall time [s]")
        axis.set(title=f"One second of a curtain of {resolution} × {resolution}", ylim=(5e-3, 5e3))
        axis.legend(fontsize=7, loc="upper left", ncols=2)


def draw_error_bound(axes: Any, reports: Reports) -> None:
    """Draw errors of random scenes in parts of the error bound, and errors of fixed scenes against tolerance."""
    for section, label in (("tolerance", "without contact"), ("tolerance-contact", "with contact")):
        rows = reports[section].table("Error relative to tolerance").records()
        points = [(row["tolerance m"], row["worst unflagged"]) for row in rows if row["worst unflagged"] != "-"]
        axes[0].loglog(*zip(*points, strict=True), ".", markersize=4, label=f"{len(points)} scenes {label}")
    axes[0].axhline(1.0, color="black", linestyle=":", linewidth=1.0, label="error bound")
    axes[0].set(xlabel="tolerance [m]", ylabel="largest error / error bound", title="Random scenes, frames not flagged")
    _finish(axes[0])
    curves = Points()
    for row in reports["tolerance-sweep"].table("Achieved error").records():
        curves.setdefault(row["scene"], []).append((row["tolerance m"], row["achieved m"]))
    _draw_curves(axes[1], curves, "tolerance [m]", "largest position error [m]")
    axes[1].plot((1e-7, 1e-2), (1e-7, 1e-2), ":", color="black", linewidth=1.0)
    axes[1].set_title("Fixed scenes over a second; dotted: the tolerance")


def draw_contact(axes: Any, reports: Reports) -> None:
    """Draw the cost of contact relative to a free sheet, and the speed of a folded towel."""
    report = reports["contact"]
    rows = report.table("Cost").records()
    labels = list(dict.fromkeys(row["what"] for row in rows))
    costs: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        costs[row["sheet"]].append(row["times"])
    for row in report.table("A sheet that hangs").records():
        costs[row["sheet"]].append(row["with contact.self: times"])
    _draw_bars(axes[0], [*labels, "hanging, contact.self"], costs)
    axes[0].axhline(1.0, color="gray", linestyle=":")
    axes[0].set(title="A frame with contact", ylabel="time relative to a frame without")
    towels = report.table("Folding a towel").records()
    speeds = {
        "mean": [row["times real time"] for row in towels],
        "slowest second": [row["in the worst second"] for row in towels],
    }
    _draw_bars(axes[1], [row["sheet"] for row in towels], speeds)
    _draw_real_time(axes[1])
    axes[1].set(title="A towel while it is folded", ylabel="simulated seconds per second", yscale="log")


def draw_peers(axes: Any, reports: Reports) -> None:
    """Draw the speed of other engines on the same sheets."""
    rows = reports["peers"].table("Simulated seconds per wall second").records()
    sizes = [column for column in rows[0] if column != "engine"]
    free = {row["engine"]: [row[size] for size in sizes] for row in rows if row["engine"] != "cloth_sim_ros, one core"}
    _draw_bars(axes[0], sizes, free)
    contact: dict[str, list[float]] = defaultdict(list)
    scenes = dict.fromkeys(row["scene"] for row in reports["peers-contact"].table("Cloth that touches").records())
    for row in reports["peers-contact"].table("Cloth that touches").records():
        contact[row["engine"]].append(row["times real time"])
    _draw_bars(axes[1], list(scenes), contact)
    for axis, title in zip(axes, ("A curtain, without contact", "Scenes with contact"), strict=True):
        _draw_real_time(axis)
        axis.set(title=title, ylabel="simulated seconds per second", yscale="log")


def _draw_curves(axis: Any, curves: Points, x: str, y: str) -> None:
    for name, points in curves.items():
        style = {"color": PRODUCT_COLOUR, "linewidth": 2.0} if name == "cloth_sim_ros, auto" else {}
        axis.loglog(*zip(*sorted(points), strict=True), "o-", markersize=3, label=name, **style)
    axis.set(xlabel=x, ylabel=y)
    _finish(axis)


def _draw_bars(axis: Any, labels: Sequence[str], groups: dict[str, list[float]]) -> None:
    width = 0.8 / len(groups)
    for i, (name, heights) in enumerate(groups.items()):
        style = {"color": PRODUCT_COLOUR} if name.startswith("cloth_sim_ros") else {}
        left = [k + (i - 0.5 * (len(groups) - 1)) * width for k in range(len(labels))]
        axis.bar(left, heights, width, label=name, **style)
    axis.set_xticks(range(len(labels)), [textwrap.fill(label, 14) for label in labels], fontsize=8)
    _finish(axis)


def _draw_real_time(axis: Any) -> None:
    axis.axhline(1.0, color="gray", linestyle=":", label="real time")
    _finish(axis)


def _finish(axis: Any) -> None:
    axis.grid(which="major", alpha=0.3)
    axis.set_axisbelow(True)
    axis.legend(fontsize=7)


FIGURES: dict[str, Callable[[Any, Reports], None]] = {
    "speed": draw_speed,
    "threads": draw_threads,
    "work_precision": draw_work_precision,
    "error_bound": draw_error_bound,
    "contact": draw_contact,
    "peers": draw_peers,
}
