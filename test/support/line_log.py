# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A logger that stores its lines."""

from __future__ import annotations


class LineLog:
    """A stub of rclpy's logger."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def is_enabled_for(self, _level: object) -> bool:
        return False

    def warning(self, text: str) -> None:
        self.lines.append(text)

    info = error = warning
