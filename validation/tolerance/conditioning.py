# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `conditioning`: amplification of a small perturbation in each scene.

A pointwise error is meaningful in scenes with a small amplification only.
"""

from __future__ import annotations

import argparse

import numpy as np
from support.problems import MORE_PROBLEMS, PERIOD, PROBLEMS, Problem, problem

from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from validation.report import Report, Table

#: Largest perturbation of a particle's position [m].
KICK = 1e-9
#: Amplification above which a pointwise error is not meaningful.
CHAOTIC = 1e3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--scenes",
        nargs="+",
        choices=[*PROBLEMS, *MORE_PROBLEMS],
        metavar="SCENE",
        default=[*PROBLEMS, "corners16"],
        help=f"of {', '.join([*PROBLEMS, *MORE_PROBLEMS])}",
    )
    parser.add_argument("--kicks", type=int, default=2, help="number of random perturbations; the worst counts")


def amplification(scene: Problem, *, seed: int) -> list[float]:
    """Return the amplification of a random perturbation at the end of each frame."""
    runs = [scene.build(), scene.build()]
    plan, kicked = runs[1]
    kick = np.random.default_rng(seed).normal(size=kicked.x.shape)
    # A closed-form scene is a line: the perturbation is along it.
    kick[1:] *= 0.0 if scene.exact is not None else 1.0
    kick /= np.sqrt((kick * kick).sum(axis=0).max())
    kicked.x += KICK * kick * (plan.model.inverse_masses > 0.0)
    integrators = [Extrapolated(n_runs=3), Extrapolated(n_runs=3)]
    growth = []
    for frame in range(scene.frames):
        for integrator, (equations, state) in zip(integrators, runs, strict=True):
            integrator.advance(equations, state, frame * PERIOD, PERIOD)
        growth.append(largest_distance(runs[0][1].x, kicked.x) / KICK)
    return growth


def run(options: argparse.Namespace) -> Report:
    """Measure the selected scenes."""
    table = Table(
        "Amplification of a perturbation of 1e-9 m",
        ["scene", "horizon s", "at half", "at the horizon", "largest", "pointwise"],
    )
    for name in options.scenes:
        scene = problem(name)
        kicks = [amplification(scene, seed=seed) for seed in range(options.kicks)]
        worst = np.max(kicks, axis=0)
        verdict = "yes" if worst.max() < CHAOTIC else "no"
        row = [name, scene.duration, float(worst[len(worst) // 2]), float(worst[-1]), float(worst.max()), verdict]
        table.rows.append(row)
    return Report("Conditioning", "python -m validation conditioning", tables=[table])
