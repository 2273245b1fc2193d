# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A user-defined force in numpy: a soft floor at z = 0 that pushes particles out."""

import numpy as np

from cloth_sim_ros import Drag, Force, Gravity, Model, PairSprings, State, simulate


class SoftFloor(Force):
    """f_z = k d - c s v_z on particles at depth d = -z > 0; k [N/m], c [N s/m].

    The fraction s rises from 0 to 1 over the first centimetre: a jump would reduce every integrator's order.
    """

    name = "floor"
    damped = True

    def __init__(self, stiffness: float, damping: float) -> None:
        """Store the coefficients."""
        self.k, self.c = stiffness, damping

    def add_force(self, t, x, v, f):
        """Add the force [N] to f; all arrays are (3, n)."""
        f[2] += self.k * np.maximum(-x[2], 0.0) - self.c * np.clip(-x[2] / 0.01, 0.0, 1.0) * v[2]

    def energy(self, t, x):
        """Return the energy whose negative gradient is the elastic part of the force."""
        return float(0.5 * self.k * (np.maximum(-x[2], 0.0) ** 2).sum())

    def dissipation(self, t, x, v):
        """Return the power that the damping dissipates [W]."""
        return float(self.c * (np.clip(-x[2] / 0.01, 0.0, 1.0) * v[2] ** 2).sum())

    def add_stiffness(self, x, blocks):
        """Add the stiffness, which limits the step; row 2 of the six is zz."""
        blocks[2] += np.where(x[2] < 0.05, self.k, 0.0)  # also just above: a particle may reach the floor within a step

    def add_damping(self, x, blocks):
        """Add the damping, which limits the step."""
        blocks[2] += np.where(x[2] < 0.05, self.c, 0.0)


def main() -> None:
    """Drop a string of beads on the floor."""
    count, mass = 20, 0.01
    x = np.zeros((count, 3))
    x[:, 0], x[:, 2] = np.linspace(0.0, 1.0, count), 0.3
    springs = PairSprings(np.stack([np.arange(count - 1), np.arange(1, count)], axis=1), 1.0 / (count - 1), 50.0, 0.02)
    floor = SoftFloor(stiffness=20.0, damping=0.3)
    model = Model(np.full(count, mass), [springs, Gravity([0.0, 0.0, -9.81]), Drag(0.2), floor])
    motion = simulate(model, State(x), until=2.0, save_at=[0.2, 0.3, 2.0])
    for time, at in zip(motion.times, motion.positions, strict=True):
        print(f"{time:.1f} s: lowest bead {at[:, 2].min() * 1e3:.2f} mm")
    print(f"at rest it should sink by m g / k = {mass * 9.81 / floor.k * 1e3:.2f} mm")


if __name__ == "__main__":
    main()
