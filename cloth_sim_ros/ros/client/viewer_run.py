# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_viewer` after ROS is loaded."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from cloth_sim_ros.ros.client.viewer_drawing import finish_drawing
from cloth_sim_ros.ros.client.viewer_feed import ViewerFeed
from cloth_sim_ros.ros.process.arguments import ArgumentsError, check_environment, error_text
from cloth_sim_ros.ros.process.stopping import StopSignals
from cloth_sim_ros.session.message_pipe import pack

_POLL = 0.1


def run(argv: Sequence[str], target: str, drawing: subprocess.Popen[bytes], signals: StopSignals) -> int:
    """Forward a node's messages to the drawing process until it ends or a signal comes; end it; return the exit status.

    Args:
        argv: the command line, the program's name first.
        target: full name of the cloth's node.
        drawing: the drawing process; it is ended.
        signals: the installed signal handlers.

    Returns:
        The exit status, see `viewer_main.main`.
    """
    try:
        check_environment(os.environ, argv)
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
        _forward(drawing, target, lambda: signals.requested is None and drawing.poll() is None)
    except ArgumentsError as error:
        return _refuse(str(error))
    except (ValueError, RuntimeError) as error:
        return _refuse(error_text(error))
    except ExternalShutdownException:
        pass
    finally:
        finish_drawing(drawing)
        rclpy.try_shutdown()
    return 0 if signals.requested else drawing.returncode


def _forward(drawing: subprocess.Popen[bytes], target: str, should_continue: Callable[[], bool]) -> None:
    """Spin a node that forwards another node's messages to the drawing process while `should_continue` is true."""
    assert drawing.stdin is not None
    pipe = drawing.stdin.fileno()
    os.set_blocking(pipe, False)

    def send(topic: str, data: bytes) -> None:
        unsent = memoryview(pack(topic, data))
        # A slow viewer makes this wait. Meanwhile the middleware keeps the newest cloud alone.
        while unsent and should_continue():
            if select.select([], [pipe], [], _POLL)[1]:
                try:
                    unsent = unsent[os.write(pipe, unsent) :]
                except BlockingIOError:
                    continue
                except BrokenPipeError:
                    return

    node = Node("cloth_viewer")
    try:
        ViewerFeed(node, target, send)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while should_continue():
            executor.spin_once(timeout_sec=_POLL)
    finally:
        node.destroy_node()


def _refuse(reason: str) -> int:
    print(f"cloth_viewer: {reason}", file=sys.stderr)
    return 1
