# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_gripper`, which plays scripted grasps into a cloth's command topics.

Like the node's command it imports little, so that a signal during the slow imports of rclpy ends it in order.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cloth_sim_ros.ros.process.stopping import StopSignals
from cloth_sim_ros.session.command_runner import exit_on_signal


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `cloth_gripper`: play scripted grasps to grippers of a running cloth; return the exit status.

    Returns:
        Exit status: 0 if the scripts were played; 1 on failure or if a grasp held nothing; 130 if a signal ended it.
    """
    argv = list(sys.argv if arguments is None else ["cloth_gripper", *arguments])
    with exit_on_signal("cloth_gripper"):
        from cloth_sim_ros.ros.client.gripper_run import run

        signals = StopSignals()
    signals.install()
    return run(argv, signals)


if __name__ == "__main__":
    sys.exit(main())
