# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Guard against errors after a shutdown of the context.

rclpy's signal handlers may shut it down at any moment.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.node import Node


@contextmanager
def ignore_errors_after_shutdown(node: Node) -> Iterator[None]:
    """Suppress errors of the middleware if the context was shut down meanwhile."""
    try:
        yield
    except RuntimeError:
        if node.context.ok():
            raise
