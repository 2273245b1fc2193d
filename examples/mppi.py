# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A sampling planner (MPPI) swings a hung cloth's corner to a goal, with rollouts on all cores."""

import numpy as np

from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.learning import rollouts

GOAL = np.array([0.3, 0.3, 0.7])  # [m]
N_ROLLOUTS, HORIZON, SPREAD, INVERSE_TEMPERATURE = 16, 8, 0.005, 100.0  # samples, frames, m a frame, 1/m
SCENE = {"cloth.resolution": [7, 7], "tolerance": 1e-3, "rate": 30.0, "gripper.radius": 0.06}


def main() -> None:
    """Grasp the lower edge next to the corner; let a planner bring the free corner to the goal."""
    simulation = Simulation(Scene.from_parameters(SCENE))
    corner, grasped = simulation.model.masses.size - 1, simulation.model.masses.size - 2
    position = simulation.positions[grasped]
    simulation.advance([Target("gripper", position), Grasp("gripper", True)])
    random, plan = np.random.default_rng(0), np.zeros((HORIZON, 3))  # gripper displacements per frame [m]
    for frame in range(45):
        knots = random.normal(0.0, SPREAD, (N_ROLLOUTS, HORIZON // 4, 3))  # smooth: a gripper does not jitter
        displacements = plan + knots.repeat(4, axis=1)
        displacements[0] = plan
        actions = np.ones((N_ROLLOUTS, HORIZON, 1, 4))  # target and grasp, which stays closed
        actions[:, :, 0, :3] = position + displacements.cumsum(axis=1)
        results = rollouts(simulation.snapshot(), actions, particles=[corner])
        distances = np.linalg.norm(results.positions[:, :, 0] - GOAL, axis=2)
        cost = distances.mean(axis=1) + distances[:, -1] + 10.0 * (displacements**2).sum(axis=(1, 2))
        weight = np.exp(-INVERSE_TEMPERATURE * (cost - cost.min()))
        plan = np.tensordot(weight / weight.sum(), displacements, axes=1)
        position = position + plan[0]
        simulation.advance([Target("gripper", position)])
        plan = np.vstack([plan[1:], 0.5 * plan[-1:]])
        if frame % 15 == 14:
            distance = float(np.linalg.norm(simulation.positions[corner] - GOAL))
            print(f"{simulation.time:.1f} s: the corner is {distance:.3f} m from the mark")


if __name__ == "__main__":
    main()
