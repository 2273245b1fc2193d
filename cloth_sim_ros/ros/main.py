# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_sim`.

It imports little and installs the signal handlers first. Therefore a signal during the slow imports of rclpy and numpy
ends the process in order.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

# First: between the next import and the installation of the handlers a signal would leave a traceback.
import cloth_sim_ros.session.command_runner as command_loading
from cloth_sim_ros.ros.process.stopping import StopSignals


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `cloth_sim`: the node, or with `--check` the check of a parameter file; return the exit status.

    Returns:
        Exit status: 0 if a signal stopped the node; 1 if it could not start, its recording could not be closed, or a
        frame failed and `on_failure` is `exit`.
    """
    argv = list(sys.argv if arguments is None else ["cloth_sim", *arguments])
    if any(argument == "--check" or argument.startswith("--check=") for argument in argv):
        with command_loading.exit_on_signal("cloth_sim"):
            from cloth_sim_ros.ros.check.check import main as check
        return check(argv[1:])
    signals = StopSignals()
    signals.install()
    with signals.exiting_at_once():
        from cloth_sim_ros.ros.process.process import run
    return run(argv, signals)


if __name__ == "__main__":
    sys.exit(main())
