# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A sheet advanced frame by frame: grasp a corner, move it, read the force on the gripper."""

from pathlib import Path

import numpy as np

from cloth_sim_ros import Grasp, Scene, Simulation, Target

CONFIG = Path(__file__).resolve().parent.parent / "config" / "cloth_sim.yaml"


def main() -> None:
    """Lift a corner for a second, then run the same frames again from the saved state."""
    simulation = Simulation(Scene.from_file(CONFIG))
    corner = simulation.positions[-1]
    simulation.advance([Target("gripper", corner), Grasp("gripper", True)])
    start = simulation.state.copy()
    digests = []
    for current in (simulation, Simulation(simulation.scene, start)):
        for k in range(60):
            frame = current.advance([Target("gripper", corner + np.array([0.0, -0.005 * k, 0.01 * k]))])
        force = frame.wrenches[0, :3]
        print(f"{frame.time:.2f} s: force of the cloth on the gripper {np.round(force, 2)} N")
        digests.append(current.state.digest())
    print("the same to the last bit" if digests[0] == digests[1] else "they differ")


if __name__ == "__main__":
    main()
