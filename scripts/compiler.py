# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sees to it that there is a C++ compiler: as root with apt-get it is installed, else one sentence says what to do."""

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
    """What builds the engine, loaded by its path: the package itself can't be imported before it is installed."""
    return SimpleNamespace(**runpy.run_path(str(ENGINE / "build.py")))


def say(text: str) -> None:
    """Tell the user at once, also through a pipe."""
    print(text, flush=True)


def ensure() -> bool:
    """Whether there is a compiler, after the attempt to install one where there was none; says what it does."""
    build = load_build()
    try:
        build.find_compiler()
    except build.NoCompilerError as error:
        # A compiler that CXX names and that isn't there is not ours to replace.
        if os.environ.get("CXX", "").strip() or os.geteuid() != 0 or not shutil.which("apt-get"):
            say(str(error))
            return False
    else:
        return True
    say(f"cloth_sim_ros: its engine is C++ and there is no compiler; installing {PACKAGE} with apt-get ...")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", PACKAGE]):
        # Package by package what it unpacks is of no use here; what goes wrong is on the other stream.
        done = subprocess.run(["apt-get", *command], env=environment, check=False, stdout=subprocess.DEVNULL)
        if done.returncode:
            say(
                f"cloth_sim_ros: apt-get {command[0]} ended with status {done.returncode} (see above);"
                f" install {PACKAGE} by hand, then run make again."
            )
            return False
    return True
