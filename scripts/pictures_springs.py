# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of docs/springs.md, computed anew: `python -m scripts.pictures_springs docs/images`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.plan import compile
from cloth_sim_ros.physics.sheets.chain import Chain, SpringLaw
from cloth_sim_ros.physics.sheets.grid import GridSheet
from cloth_sim_ros.physics.sheets.material import grid_threads
from cloth_sim_ros.physics.sheets.surface import LAYOUTS


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
    return _save(figure, folder / "springs_chain.png")


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
    return _save(figure, folder / "springs_layouts.png")


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
    return _save(figure, folder / "springs_refinement.png")


def _save(figure: Any, path: Path) -> Path:
    figure.savefig(path, dpi=110)
    return path


def main() -> None:
    """Draw all pictures into a folder and name them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    for draw in (draw_chain, draw_layouts, draw_refinement):
        print(draw(pyplot, folder))


if __name__ == "__main__":
    main()
