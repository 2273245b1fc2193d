# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command line of the validation."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from validation.command import run_command

#: Module and one-line description of each command, by name.
COMMANDS = {
    "tolerance": ("validation.tolerance.bound", "the error bound on random scenes, and a search for violations"),
    "tolerance-sweep": ("validation.tolerance.sweep", "achieved error against the requested tolerance, scene by scene"),
    "work-precision": ("validation.tolerance.work_precision", "wall time against error, compared with library solvers"),
    "conditioning": ("validation.tolerance.conditioning", "amplification of a perturbation of a nanometre, by scene"),
    "constants": ("validation.tolerance.constants", "effect of halving and doubling each constant of step control"),
    "stability": ("validation.stability.scan", "thousands of stress cases; measured and predicted step limits"),
    "coupling": ("validation.stability.coupling", "delays with which a wrist in another simulator stays stable"),
    "ensemble-coverage": ("validation.ensemble.coverage", "share of random cloths within two deviations of a mean"),
    "reality": ("validation.reality.command", "fits to a synthetic copy of recorded swings of a real cloth"),
    "mesh-moduli": ("validation.moduli.mesh", "moduli of sheets on irregular triangles, over random meshes"),
    "fabric-moduli": ("validation.moduli.fabric", "strips cut at angles to the warp against laminate theory"),
    "drapes": ("validation.reality.drapes", "six woven fabrics against their real drape coefficients"),
    "presets": ("validation.reality.presets", "the package's fabrics: drapes over meshes, and cantilevers"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    return run_command("validation", "Validates the physics of cloth_sim_ros.", COMMANDS, arguments)


if __name__ == "__main__":
    sys.exit(main())
