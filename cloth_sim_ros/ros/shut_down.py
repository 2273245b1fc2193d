# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is said while the context may be shut down: rclpy's own signal handlers do so at any moment."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.node import Node


@contextmanager
def unless_shut_down(node: Node) -> Iterator[None]:
    """Let errors of the middleware pass where the context was shut down meanwhile: nobody is left to be told."""
    try:
        yield
    except RuntimeError:
        if node.context.ok():
            raise
