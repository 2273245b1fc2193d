# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A chain hung by both ends, from plain arrays: the library without ROS."""

import numpy as np

from cloth_sim_ros import Drag, Gravity, Model, PairSprings, State, simulate

COUNT, LENGTH, MASS = 50, 1.0, 0.1  # particles, m, kg
STIFFNESS, DAMPING = 100.0, 0.1  # k_s, force per unit strain [N]; k_d0, dimensionless


def main() -> None:
    """Let the chain fall from a straight line for a second."""
    positions = np.zeros((COUNT, 3))
    positions[:, 0] = np.linspace(0.0, LENGTH, COUNT)
    pairs = np.stack([np.arange(COUNT - 1), np.arange(1, COUNT)], axis=1)
    rest_length, mass = LENGTH / (COUNT - 1), MASS / COUNT
    springs = PairSprings(pairs, rest_length, STIFFNESS, DAMPING * np.sqrt(STIFFNESS * mass / rest_length))
    forces = [springs, Gravity([0.0, 0.0, -9.81]), Drag(0.2)]
    model = Model(np.full(COUNT, mass), forces, anchors=[0, COUNT - 1])
    motion = simulate(model, State(positions), until=1.0, save_at=[0.25, 0.5, 1.0], tolerance=1e-5)
    for time, positions_at in zip(motion.times, motion.positions, strict=True):
        print(f"{time:.2f} s: lowest point {positions_at[:, 2].min():.4f} m")
    steps = sum(advance.steps for advance in motion.advances)
    print(f"{steps} steps by {motion.advances[-1].integrator}")


if __name__ == "__main__":
    main()
