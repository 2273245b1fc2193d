# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `conditioning`: amplification of a small perturbation in each scene.

A pointwise error is meaningful in scenes with a small amplification only.
"""

from __future__ import annotations

import argparse

import numpy as np
from support.problems import MORE_PROBLEMS, PERIOD, PROBLEMS, Problem, problem

from cloth_sim_ros import Extrapolated
from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from validation.report import Report, Table

#: Largest perturbation of a particle's position [m].
PERTURBATION = 1e-9
#: Amplification above which a pointwise error is not meaningful.
CHAOTIC_AMPLIFICATION = 1e3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    known, usual = [*PROBLEMS, *MORE_PROBLEMS], [*PROBLEMS, "corners16"]
    scenes = f"of {', '.join(known)}"
    parser.add_argument("--scenes", nargs="+", choices=known, metavar="SCENE", default=usual, help=scenes)
    parser.add_argument("--kicks", type=int, default=2, help="number of random perturbations; the worst counts")


def measure_amplification(scene: Problem, *, seed: int) -> list[float]:
    """Return the amplification of a random perturbation at the end of each frame."""
    runs = [scene.build(), scene.build()]
    plan, perturbed_state = runs[1]
    perturbation = np.random.default_rng(seed).normal(size=perturbed_state.x.shape)
    # A closed-form scene is a line: the perturbation is along it.
    perturbation[1:] *= 0.0 if scene.exact is not None else 1.0
    perturbation /= np.sqrt((perturbation * perturbation).sum(axis=0).max())
    perturbed_state.x += PERTURBATION * perturbation * (plan.model.inverse_masses > 0.0)
    integrators = [Extrapolated(n_runs=3), Extrapolated(n_runs=3)]
    amplifications = []
    for frame in range(scene.frames):
        for integrator, (equations, state) in zip(integrators, runs, strict=True):
            integrator.advance(equations, state, frame * PERIOD, PERIOD)
        amplifications.append(largest_distance(runs[0][1].x, perturbed_state.x) / PERTURBATION)
    return amplifications


def run(options: argparse.Namespace) -> Report:
    """Measure the selected scenes."""
    columns = ["scene", "horizon s", "at half", "at the horizon", "largest", "pointwise"]
    table = Table("Amplification of a perturbation of 1e-9 m", columns)
    for name in options.scenes:
        scene = problem(name)
        amplifications = [measure_amplification(scene, seed=seed) for seed in range(options.kicks)]
        worst = np.max(amplifications, axis=0)
        is_pointwise = "yes" if worst.max() < CHAOTIC_AMPLIFICATION else "no"
        row = [name, scene.duration, float(worst[len(worst) // 2]), float(worst[-1]), float(worst.max()), is_pointwise]
        table.rows.append(row)
    return Report("Conditioning", tables=[table])
