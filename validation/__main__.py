# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command line of the validation."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from validation.command import run_command

#: Names: the module of each command, and a line about it.
COMMANDS = {
    "tolerance": ("validation.tolerance.bound", "the tolerance's error bound on random scenes, by a reference in C"),
    "tolerance-sweep": ("validation.tolerance.sweep", "achieved error against the tolerance asked for, scene by scene"),
    "work-precision": ("validation.tolerance.work_precision", "wall time against error, beside solvers of libraries"),
    "conditioning": ("validation.tolerance.conditioning", "growth of a perturbation of a nanometre, scene by scene"),
    "constants": ("validation.tolerance.constants", "effect of half and double of each tuned number of step control"),
    "stability": ("validation.stability.scan", "stress cases by the thousand; step limits found and predicted"),
    "mesh-moduli": ("validation.moduli.mesh", "moduli of sheets on irregular triangles, over random meshes"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    return run_command("validation", "Validates the physics of cloth_sim_ros.", COMMANDS, arguments)


if __name__ == "__main__":
    sys.exit(main())
