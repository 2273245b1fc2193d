# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Installation of a missing C++ compiler.

As root with apt-get the compiler is installed. Otherwise one sentence gives the remedy.
"""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

PACKAGE = "g++"
ENGINE = Path(__file__).resolve().parent.parent / "cloth_sim_ros" / "engine"


def load_build() -> SimpleNamespace:
    """Load engine/build.py by its path, because the package can't be imported before it is installed."""
    return SimpleNamespace(**runpy.run_path(str(ENGINE / "build.py")))


def say(text: str) -> None:
    """Print a line at once, also through a pipe."""
    print(text, flush=True)


def ensure() -> bool:
    """Return True if a compiler exists, after an attempt to install a missing one."""
    build = load_build()
    try:
        build.find_compiler()
    except build.NoCompilerError as error:
        # A compiler that CXX names is not replaced, even if it is missing.
        if os.environ.get("CXX", "").strip() or os.geteuid() != 0 or not shutil.which("apt-get"):
            report(str(error))
            return False
    else:
        return True
    report(f"cloth_sim_ros: its engine is C++ and there is no compiler; installing {PACKAGE} with apt-get ...")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", PACKAGE]):
        # The list of unpacked packages is of no use; errors go to the other stream.
        done = subprocess.run(["apt-get", *command], env=environment, check=False, stdout=subprocess.DEVNULL)
        if done.returncode:
            report(
                f"cloth_sim_ros: apt-get {command[0]} ended with status {done.returncode} (see above);"
                f" install {PACKAGE} by hand, then run make again."
            )
            return False
    return True
