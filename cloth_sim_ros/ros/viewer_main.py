# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_viewer`, which shows a running cloth in Rerun.

Two processes share the work: this one subscribes, the other one draws. Rerun wants a newer numpy than the messages of
ROS in Ubuntu 24.04, so the second may run in an environment of its own.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cloth_sim_ros.ros.process.stopping import StopSignals
from cloth_sim_ros.session.command_runner import exit_on_signal


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `cloth_viewer`: show a running cloth until a signal or its end; return the exit status.

    Returns:
        Exit status: 0 at the end; 1 if it cannot be shown; 130 if a signal came while starting.
    """
    argv = list(sys.argv if arguments is None else ["cloth_viewer", *arguments])
    with exit_on_signal("cloth_viewer"):
        from cloth_sim_ros.ros.client.viewer_drawing import read_options, start_drawing

        options = read_options(argv)
        try:
            drawing = start_drawing(options)
        except OSError as error:
            print(f"cloth_viewer: {error}", file=sys.stderr)
            return 1
        from cloth_sim_ros.ros.client.viewer_run import run

        signals = StopSignals()
    signals.install()
    return run(argv, options.node, drawing, signals)


if __name__ == "__main__":
    sys.exit(main())
