# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Entry point of the command `cloth_drape`; it imports the command."""

from __future__ import annotations

from collections.abc import Sequence

from cloth_sim_ros.session.command_runner import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Import and run the command `cloth_drape`; return its exit status."""
    return run_command("cloth_drape", "cloth_sim_ros.laboratory.drape_main", arguments)
