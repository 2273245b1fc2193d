# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ensures that there is a C++ compiler: installs it with apt-get as root, otherwise prints the remedy."""

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
    """Load the engine's build.py by its path, because the package can't be imported before it is installed."""
    return SimpleNamespace(**runpy.run_path(str(ENGINE / "build.py")))


def report(text: str) -> None:
    """Print at once, also into a pipe."""
    print(text, flush=True)


def ensure() -> bool:
    """Install a compiler if there is none; return whether there is one now. Reports its progress."""
    build = load_build()
    try:
        build.find_compiler()
    except build.NoCompilerError as error:
        # A missing compiler that CXX names is not replaced.
        if os.environ.get("CXX", "").strip() or os.geteuid() != 0 or not shutil.which("apt-get"):
            report(str(error))
            return False
    else:
        return True
    report(f"cloth_sim_ros: its engine is C++ and there is no compiler; installing {PACKAGE} with apt-get ...")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", PACKAGE]):
        # The progress of each package is discarded; errors are on the other stream.
        done = subprocess.run(["apt-get", *command], env=environment, check=False, stdout=subprocess.DEVNULL)
        if done.returncode:
            report(
                f"cloth_sim_ros: apt-get {command[0]} ended with status {done.returncode} (see above);"
                f" install {PACKAGE} by hand, then run make again."
            )
            return False
    return True
