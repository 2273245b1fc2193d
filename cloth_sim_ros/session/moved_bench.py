# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stub of the old command `cloth_bench`, kept for one release; it names the new command.

The module imports nothing of the package, so that it starts fast.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence

#: Targets of make, and the name of each old subcommand there.
MOVED = {
    "bench": {
        "speed": "speed",
        "peers": "peers",
        "peers-contact": "peers-contact",
        "scale": "scale",
        "contact": "contact",
        "batch": "batch",
        "studies": "studies",
        "adds": "feature-cost",
        "skip": "feature-cost",
    },
    "validate": {
        "promise": "tolerance",
        "tolerance": "tolerance-sweep",
        "work-precision": "work-precision",
        "conditioning": "conditioning",
        "constants": "constants",
        "stability": "stability",
        "mesh-moduli": "mesh-moduli",
    },
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the command that replaces the old `cloth_bench` on standard error; return exit status 2."""
    name, *options = (sys.argv[1:] if arguments is None else arguments) or [""]
    commands = []
    for target, names in MOVED.items():
        if name in names:
            commands.append(f"make {target} ARGS={shlex.quote(shlex.join([names[name], *options]))}")
    if name == "engine":
        advice = "its comparison with trees from before the engine is deleted"
    else:
        advice = f"run {' or '.join(f'`{command}`' for command in commands or ['make bench', 'make validate'])}"
        advice += " in a clone of the repository"
    sys.stderr.write(f"cloth_bench has left the package: {advice}\n")
    return 2
