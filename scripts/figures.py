# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draws the figures of docs/bending.md, springs.md and node/air.md, and prints the tables of docs/bending.md.

.venv/bin/python scripts/figures.py docs/images [name ...]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.bending import RATIOS
from cloth_sim_ros.physics.model.sheets.chain import Chain, SpringLaw
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape, Length
from cloth_sim_ros.physics.model.sheets.material import grid_threads
from cloth_sim_ros.physics.model.sheets.surface import LAYOUTS
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation
from validation.bending.elastica import hanging_strip, heavy_elastica
from validation.bending.patterns import Plate, grid_patch, plate_moduli, triangle_patch
from validation.bending.recovery import REST_TRIANGLES, STARTS, rest_shape, simulate_recovery, start_positions

ANGLES = (0, 15, 30, 45, 60, 75, 90, 105, 120, 135, 150, 165)
RATIO_SCALE = (0.125, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
EDGE_STIFFNESSES = (10.0, 100.0)
MODELS: dict[Length, str] = {"crossed": "S7 + S8", "altitude": "S7 + S9"}
SHEET_SIZE, DENSITY = 0.3, 0.45 / 2.30
#: How far the held corners are carried across the sheet [m], in what time [s], and what follows [s]: at most 0.75 m/s.
CARRY_DISTANCE, CARRIED, WATCHED = 0.25, 0.5, 5.0
DRAGS = (0.0, 0.45)
_UPRIGHT, ACROSS = (0.0, 0.0, 0.0, 1.0), np.array([0.0, 1.0, 0.0])


def missed_starts(model: Length, count: int = 20) -> Array:
    """Share of starts that miss the rest shape, by rest angle (rows) and stiffness ratio (columns)."""
    missed = np.zeros((len(ANGLES), len(RATIO_SCALE)))
    for i, degrees in enumerate(ANGLES):
        for name in REST_TRIANGLES:
            rest_positions = rest_shape(name, math.radians(degrees))
            for j, ratio in enumerate(RATIO_SCALE):
                for kind in STARTS:
                    for edge in EDGE_STIFFNESSES:
                        begin = start_positions(kind, rest_positions, count, np.random.default_rng(1))
                        came = simulate_recovery(
                            begin, rest_positions, model=model, ratio=ratio, edge_stiffness=edge, limit=20_000
                        )
                        missed[i, j] += came.missed
    return missed / (len(REST_TRIANGLES) * len(STARTS) * len(EDGE_STIFFNESSES) * count)


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
            column = np.interp(math.log(ratio), np.log(RATIO_SCALE), np.arange(len(RATIO_SCALE)))
            axis.plot(column, i, "s", markersize=17, markerfacecolor="none", markeredgecolor="tab:green")
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
        rest_hinge = HingeShape.of(pair, rest_shape(name, math.radians(degrees)))
        across = np.array([rest_hinge.folded(fold).wing_distance()[0] for fold in folds])
        half = 0.5 * np.ptp(across)
        seven = ((across - rest_hinge.wing_distance()[0]) / half) ** 2
        axis.plot(np.degrees(folds), seven, label="S7")
        for kind, label in MODELS.items():
            length = np.array([rest_hinge.folded(fold).length(kind)[0] for fold in folds[1:-1]])
            scaled = (length - rest_hinge.length(kind)[0]) / (rest_hinge.half_range_ratio(kind)[0] * half)
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
            _print(
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
        def mean(quantity: str) -> float:
            return float(np.mean([getattr(plate, quantity) for plate in plates])) + 0.0

        both = f"{mean('along_x'):.3f}, {mean('along_y'):.3f}"
        other_columns = " | ".join(
            f"{mean(quantity):.3f}" for quantity in ("cylindrical", "poisson", "twist", "isotropy")
        )
        return f"| {name} | {both} | {other_columns} |"

    rows.append(row("grid, both checkerboards", [plate_moduli(grid_patch())]))
    rows += [
        row(f"grid, {layout} alone", [plate_moduli(grid_patch(layout))]) for layout in ("alternating", "left", "right")
    ]
    for jitter in (0.0, 0.1, 0.2, 0.3, 0.4, 1.0):
        name = "regular triangles" if jitter == 0.0 else f"triangles, vertices moved by up to {jitter:g} side"
        rows.append(row(name, [plate_moduli(triangle_patch(jitter, seed=seed)) for seed in range(6 if jitter else 1)]))
    return "\n".join(rows)


def mode_frequencies(chain: Chain) -> Array:
    """Angular frequencies [rad/s] of a chain's longitudinal modes, by the springs' own Jacobian, ascending."""
    model, state = chain.model(), chain.state()
    plan = compile(model)
    free = np.setdiff1d(np.arange(chain.particle_count), chain.anchors)
    columns = []
    for particle in free:
        push, out, nothing = (np.zeros_like(state.x) for _ in range(3))
        push[0, particle] = 1.0
        plan.add_jacobian_product(0.0, state.x, state.v, push, nothing, out)
        columns.append(-out[0, free] * model.inverse_masses[free])
    return np.asarray(np.sqrt(np.sort(np.linalg.eigvals(np.array(columns)).real)))


def draw_chain(pyplot: Any, folder: Path) -> Path:
    """Draw a pulse that runs along a chain, and the dispersion of its modes."""
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    chain = Chain(law=SpringLaw(mass=0.001, rest_length=0.01, stiffness=20.0), particle_count=401, anchored="both")
    c, x0, width = chain.law.sound_speed, chain.positions()[:, 0], 0.15
    pulse = np.exp(-(((x0 - 1.0) / width) ** 2))
    state = chain.state()
    state.x[0] += 1e-3 * pulse
    state.v[0] = 2e-3 * c * (x0 - 1.0) / width**2 * pulse
    state.v[0, [0, -1]] = 0.0
    plan, t = compile(chain.model()), 0.0
    for k in range(4):
        left.plot(x0, (state.x[0] - x0) * 1e3, label=f"t = {t * 1e3:.0f} ms")
        left.axvline(1.0 + c * t, color=f"C{k}", linewidth=0.8, linestyle=":")
        Leapfrog().advance(plan, state, t, 0.6 / c)
        t += 0.6 / c
    left.set(xlabel="along the chain [m]", ylabel="displacement [mm]", title="A pulse, and where c says it is (dotted)")
    left.legend()
    law = SpringLaw(mass=1.0, rest_length=1.0, stiffness=1.0)
    short = Chain(law=law, particle_count=22, anchored="both")
    q = np.pi * np.arange(1, 21) / 21
    right.plot(q, mode_frequencies(short), "o", markersize=4, label="modes of 20 particles between anchors")
    fine = np.linspace(0, np.pi, 200)
    right.plot(fine, 2 * np.sin(fine / 2), label="2 λ sin(q ℓ0 / 2)")
    right.plot(fine, fine, ":", label="c q, the continuum")
    right.set(xlabel="q ℓ0", ylabel="ω / λ", ylim=(0, 2.5), title="Dispersion of a chain (S2)")
    right.legend()
    return _saved(figure, folder / "springs_chain.png")


def draw_layouts(pyplot: Any, folder: Path) -> Path:
    """Draw the four shear layouts, and a square of edge springs sheared flat."""
    figure, axes = pyplot.subplots(1, 5, figsize=(12, 2.8), layout="constrained")
    for axis, layout in zip(axes, LAYOUTS, strict=False):
        sheet = GridSheet(height=1.0, width=1.0, rows=5, columns=5, layout=layout)
        threads = grid_threads(stretch_modulus=1000.0, shear_modulus=100.0, spacing=sheet.spacing, layout=layout)
        positions = sheet.positions()
        springs = sheet.springs(sheet.families(threads, k_d0=0.0, density=0.2))
        for force, colour in zip(springs, ("C0", "C1"), strict=True):
            for a, b in force.pairs:
                axis.plot(*positions[[a, b], :2].T, color=colour, linewidth=1.0)
        axis.set_title(f"{layout}, Poisson {threads.poisson_ratio:.3f}", fontsize=9)
    sheet = GridSheet(height=1.0, width=1.0, rows=2, columns=2, layout="both")
    for k, angle in enumerate(np.radians([0, 40, 65, 80, 89])):
        corners = sheet.positions()[[0, 1, 3, 2, 0]] + 0.5
        corners[:, 0] += corners[:, 1] * np.sin(angle)
        corners[:, 1] *= np.cos(angle)
        axes[4].plot(*corners[:, :2].T, color=f"C{k}", linewidth=1.0)
    axes[4].set_title("edge springs alone: no energy", fontsize=9)
    for axis in axes:
        axis.set_aspect("equal")
        axis.set_axis_off()
    return _saved(figure, folder / "springs_layouts.png")


def draw_refinement(pyplot: Any, folder: Path) -> Path:
    """Draw what converges under the refinement law, and what does not."""
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
    factors = 2 ** np.arange(6)
    for axis, kind, title in ((left, "k_d0", "constant k_d0"), (right, "viscosity", "constant viscosity")):
        damping = {"k_d0": {"k_d0": 0.4}, "viscosity": {"viscosity": 0.1}}[kind]
        law = SpringLaw(mass=0.3, rest_length=0.25, stiffness=40.0, **damping)
        chain = Chain(law=law, particle_count=5, anchored="both")
        q = np.pi / chain.length
        frequency, rate = [], []
        for factor in factors:
            fine = chain.refined(int(factor))
            sine = np.sin(0.5 * q * fine.law.rest_length)
            frequency.append(2 * fine.law.frequency * sine / (law.sound_speed * q))
            rate.append(2 * fine.law.damping / fine.law.mass * sine**2)
        axis.semilogx(factors, frequency, "o-", base=2, label="slowest mode's frequency / (c q)")
        axis.semilogx(
            factors, np.array(rate) / rate[0], "s-", base=2, label="its damping rate / that of the coarse chain"
        )
        axis.set(xlabel="refinement", ylim=(0, 1.15), title=title)
        axis.legend()
    return _saved(figure, folder / "springs_refinement.png")


def swing(normal_drag: float) -> tuple[Array, Array]:
    """Carry a hung cloth by two corners, stop, and let it swing.

    Args:
        normal_drag: `wind.normal_drag` [N s/m^3].

    Returns:
        Times since the stop [s], (frames,), and how far the free edge's middle is from below the held corners [m].
    """
    values = {
        "cloth.size": [SHEET_SIZE, SHEET_SIZE],
        "cloth.resolution": [21, 21],
        "cloth.anchors": [""],
        "material.density": DENSITY,
        "wind.normal_drag": normal_drag,
        "grippers": ["left", "right"],
        "gripper.radius": 0.02,
    }
    scene = Scene.from_parameters(values)
    cloth = Simulation(scene)
    places = scene.initial_positions()
    rows, columns = scene.shape
    held = {"left": places[0], "right": places[columns - 1]}
    middle = (rows - 1) * columns + columns // 2
    times, ways = [], []
    for frame in range(round((CARRIED + WATCHED) * scene.rate) + 1):
        part = min(frame * scene.period / CARRIED, 1.0)
        moved = CARRY_DISTANCE * part**2 * (3.0 - 2.0 * part)
        events: list[Event] = [Target(name, position + moved * ACROSS, _UPRIGHT) for name, position in held.items()]
        if frame == 0:
            events += [Grasp(name, True) for name in held]
        cloth.advance(events)
        times.append(frame * scene.period - CARRIED)
        ways.append(cloth.positions[middle, 1] - places[0, 1] - moved)
    return np.array(times), np.array(ways)


def draw_swing(pyplot: Any, folder: Path) -> Path:
    """Draw the swing of a cloth with and without air across it."""
    figure, axis = pyplot.subplots(figsize=(9, 3.5), layout="constrained")
    for normal_drag in DRAGS:
        times, ways = swing(normal_drag)
        axis.plot(times, 1e3 * ways, label=f"wind.normal_drag {normal_drag:g} N s/m³")
    axis.axvspan(-CARRIED, 0.0, color="0.9", label="corners are carried")
    axis.set(
        xlim=(-CARRIED, WATCHED), xlabel="time since the corners stopped [s]", ylabel="free edge, behind or ahead [mm]"
    )
    axis.set_title(f"A cloth of {SHEET_SIZE:g} m, held at two corners")
    figure.legend(loc="outside lower center", ncols=3)
    return _saved(figure, folder / "air_swing.png", dpi=100)


def _saved(figure: Any, path: Path, *, dpi: int = 110) -> Path:
    figure.savefig(path, dpi=dpi)
    return path


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")


FIGURES: dict[str, Callable[[Any, Path], Path]] = {
    "bending_folds": draw_folds,
    "bending_elastica": draw_elastica,
    "bending_map": draw_map,
    "springs_chain": draw_chain,
    "springs_layouts": draw_layouts,
    "springs_refinement": draw_refinement,
    "air_swing": draw_swing,
}


def main() -> None:
    """Draw the figures into a folder, and print the tables."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for the figures, e.g. docs/images")
    parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(FIGURES)}; all if left out")
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in FIGURES]:
        parser.error(f"no figure {', '.join(unknown)}; there are {', '.join(FIGURES)}")
    options.folder.mkdir(parents=True, exist_ok=True)
    if not options.names:
        _print(table_of_patterns())
    for name in options.names or FIGURES:
        _print(f"wrote {FIGURES[name](pyplot, options.folder)}")


if __name__ == "__main__":
    main()
