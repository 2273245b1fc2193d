# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Policy for a study: grasps the cloth's lower right corner and lifts it at the run's speed."""

from cloth_sim_ros import Grasp, Target
from cloth_sim_ros.studies.user_code import Finished, Observation


class Lift:
    """Called at the beginning of each frame; each run has its own object."""

    def __init__(self) -> None:
        self.corner = None

    def __call__(self, observation: Observation) -> list[Target | Grasp]:
        """Return the events of the frame."""
        if self.corner is None:
            self.corner = observation.positions[-1]
            return [Target("gripper", self.corner), Grasp("gripper", True)]
        shake = 1e-3 * observation.rng.normal(size=3)  # the run's own random numbers
        shake[2] += observation.values["speed"] * observation.time
        return [Target("gripper", self.corner + shake)]


def lifted(run: Finished) -> float:
    """Return the height by which the corner was lifted [m]: an outcome, a column of the index."""
    return float(run.positions[-1, 2] - run.initial[-1, 2])
