# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures and tables of docs/bending.md: `python -m scripts.pictures_bending docs/images`."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.sheets.bending import RATIOS
from cloth_sim_ros.physics.sheets.hinge_shape import HingeShape, Length
from validation.bending.elastica import hanging_strip, heavy_elastica
from validation.bending.patterns import Plate, grid_patch, plate_of, triangle_patch
from validation.bending.recovery import RESTS, STARTS, recover, rest_shape, starts

ANGLES = (0, 15, 30, 45, 60, 75, 90, 105, 120, 135, 150, 165)
RATIO_SCALE = (0.125, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
EDGE_STIFFNESSES = (10.0, 100.0)
MODELS: dict[Length, str] = {"crossed": "S7 + S8", "altitude": "S7 + S9"}


def missed_starts(model: Length, each: int = 20) -> Array:
    """Share of starts that miss the rest shape, by rest angle (rows) and stiffness ratio (columns)."""
    missed = np.zeros((len(ANGLES), len(RATIO_SCALE)))
    for i, degrees in enumerate(ANGLES):
        for name in RESTS:
            rest = rest_shape(name, math.radians(degrees))
            for j, ratio in enumerate(RATIO_SCALE):
                for kind in STARTS:
                    for edge in EDGE_STIFFNESSES:
                        begin = starts(kind, rest, each, np.random.default_rng(1))
                        came = recover(begin, rest, model=model, ratio=ratio, edge_stiffness=edge, limit=20_000)
                        missed[i, j] += came.missed
    return missed / (len(RESTS) * len(STARTS) * len(EDGE_STIFFNESSES) * each)


def draw_map(pyplot: Any, folder: Path) -> Path:
    """Draw where S8 and S9, each with S7, find the rest shape again."""
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    for axis, (model, springs) in zip(axes, MODELS.items(), strict=True):
        share = missed_starts(model)
        axis.imshow(100 * share, origin="lower", aspect="auto", cmap="magma_r", vmin=0, vmax=40)
        for (i, j), value in np.ndenumerate(share):
            text = "0" if value == 0 else f"{100 * value:.1f}" if value < 0.1 else f"{100 * value:.0f}"
            axis.text(j, i, text, ha="center", va="center", fontsize=7, color="black" if value < 0.2 else "white")
        flat, angle, folded = RATIOS[model]
        for i, degrees in enumerate(ANGLES):
            ratio = folded if math.radians(degrees) > angle else flat
            place = np.interp(math.log(ratio), np.log(RATIO_SCALE), np.arange(len(RATIO_SCALE)))
            axis.plot(place, i, "s", markersize=17, markerfacecolor="none", markeredgecolor="tab:green")
        axis.set_xticks(range(len(RATIO_SCALE)), [f"{ratio:g}" for ratio in RATIO_SCALE])
        axis.set_yticks(range(len(ANGLES)), [f"{degrees}°" for degrees in ANGLES])
        axis.set(
            xlabel="stiffness ratio ρ",
            ylabel="rest fold",
            title=f"{model}: {springs}\nstarts missed, %; the chosen ρ is framed",
        )
    return _saved(figure, folder / "bending_map.png")


def draw_folds(pyplot: Any, folder: Path) -> Path:
    """Draw the energies of a pair of rigid triangles over its fold, for S7 alone, S7 + S8 and S7 + S9."""
    figure, axes = pyplot.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    folds = np.radians(np.linspace(-180, 180, 1441))
    pair = np.array([[0, 1, 2, 3]])
    for axis, (name, degrees) in zip(axes, (("grid diagonal", 0), ("grid diagonal", 60), ("scalene", 60)), strict=True):
        rest = HingeShape.of(pair, rest_shape(name, math.radians(degrees)))
        across = np.array([rest.at(fold).wing_distance()[0] for fold in folds])
        half = 0.5 * np.ptp(across)
        seven = ((across - rest.wing_distance()[0]) / half) ** 2
        axis.plot(np.degrees(folds), seven, label="S7")
        for kind, label in MODELS.items():
            length = np.array([rest.at(fold).length(kind)[0] for fold in folds[1:-1]])
            scaled = (length - rest.length(kind)[0]) / (rest.half_range_ratio(kind)[0] * half)
            axis.plot(np.degrees(folds[1:-1]), seven[1:-1] + RATIOS[kind][0] * scaled**2, label=label)
        axis.axvline(degrees, color="grey", linewidth=0.8, linestyle=":")
        axis.set(
            xlabel="fold, degrees", title=f"{name}, rest fold {degrees}°", xticks=range(-180, 181, 60), ylim=(0, None)
        )
    axes[0].set_ylabel("energy")
    axes[0].legend()
    return _saved(figure, folder / "bending_folds.png")


def draw_elastica(pyplot: Any, folder: Path) -> Path:
    """Draw the clamped strip beside the heavy elastica, and its error under refinement."""
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    counts = (10, 20, 40, 80)
    for k, degrees in enumerate((5, 20, 40, 60, 80)):
        exact = heavy_elastica(math.radians(degrees))
        left.plot(exact.curve[:, 0], -exact.curve[:, 1], color=f"C{k}", label=f"tip at {degrees}°")
        for model, style in zip(MODELS, ("o-", "s--"), strict=True):
            errors = []
            for columns in counts:
                strip = hanging_strip(model, exact, columns=columns)
                errors.append(float(np.linalg.norm(strip.curve - exact.at(strip.arc), axis=1).max()))
                if columns == 20 and model == "altitude":
                    left.plot(strip.curve[:, 0], -strip.curve[:, 1], ".", color=f"C{k}")
            right.loglog(counts, errors, style, color=f"C{k}", markersize=4)
            _say(
                f"{model} {degrees:3d} deg "
                + " ".join(f"{columns}: {e:.2e}" for columns, e in zip(counts, errors, strict=True))
            )
    right.loglog(counts, 2.0 * np.array(counts, float) ** -2, "k:", label="second order")
    left.set(aspect="equal", title="Elastica (lines), altitude springs, 20 points", xlabel="m", ylabel="m")
    right.set(xlabel="points along the strip", ylabel="largest error / length", title="o crossed, □ altitude")
    left.legend()
    right.legend()
    return _saved(figure, folder / "bending_elastica.png")


def table_of_patterns() -> str:
    """Return what plate each pattern is, as a table in Markdown."""
    rows = [
        "| pattern | strip along x, y | no curvature across | Poisson | twist | isotropy |",
        "|---|---|---|---|---|---|",
    ]

    def row(name: str, plates: list[Plate]) -> str:
        def mean(what: str) -> float:
            return float(np.mean([getattr(plate, what) for plate in plates])) + 0.0

        both = f"{mean('along_x'):.3f}, {mean('along_y'):.3f}"
        rest = " | ".join(f"{mean(what):.3f}" for what in ("cylindrical", "poisson", "twist", "isotropy"))
        return f"| {name} | {both} | {rest} |"

    rows.append(row("grid, both checkerboards", [plate_of(grid_patch())]))
    rows += [
        row(f"grid, {layout} alone", [plate_of(grid_patch(layout))]) for layout in ("alternating", "left", "right")
    ]
    for jitter in (0.0, 0.1, 0.2, 0.3, 0.4, 1.0):
        name = "regular triangles" if jitter == 0.0 else f"triangles, vertices moved by up to {jitter:g} side"
        rows.append(row(name, [plate_of(triangle_patch(jitter, seed=seed)) for seed in range(6 if jitter else 1)]))
    return "\n".join(rows)


def _saved(figure: Any, path: Path) -> Path:
    figure.savefig(path, dpi=110)
    return path


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


def main() -> None:
    """Draw all pictures into the folder given, and write the tables to standard output."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    _say(table_of_patterns())
    for draw in (draw_folds, draw_elastica, draw_map):
        _say(f"wrote {draw(pyplot, folder)}")


if __name__ == "__main__":
    main()
