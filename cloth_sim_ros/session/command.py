# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Entry point of the command `cloth_session`; imports the command's module."""

from __future__ import annotations

from collections.abc import Sequence

from cloth_sim_ros.session.command_runner import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `cloth_session` (its entry point); return its exit status, 130 after an interruption."""
    return run_command("cloth_session", "cloth_sim_ros.session.main", arguments)
