# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the bits of a run depend on beside its scene and events: the versions and the machine, as text."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

#: Packages whose version can change the last bit of a run.
PACKAGES = ("cloth_sim_ros", "numpy", "scipy", "numba", "llvmlite")
VERSION = "version."
MACHINE = "machine."


def environment() -> dict[str, str]:
    """The versions and the machine that this process runs on; a session's metadata holds the recording's."""
    found = {f"{VERSION}python": platform.python_version()}
    for package in PACKAGES:
        found[f"{VERSION}{package}"] = _version(package)
    found[f"{MACHINE}architecture"] = platform.machine()
    found[f"{MACHINE}processor"] = _processor()
    found[f"{MACHINE}system"] = f"{platform.system()} {platform.libc_ver()[0]} {platform.libc_ver()[1]}".strip()
    return found


def differences(recorded: Mapping[str, str], present: Mapping[str, str]) -> list[str]:
    """What of the environment differs, as ``version.numba 0.67 (recorded) 0.68 (here)``; sorted.

    Entries that the recording lacks count as different: nothing is known of them.
    """
    return [
        f"{key.split('.', 1)[1]} {recorded.get(key, 'unknown')} then, {value} now"
        for key, value in sorted(present.items())
        if recorded.get(key) != value
    ]


def _version(package: str) -> str:
    if package == "cloth_sim_ros":
        from cloth_sim_ros import __version__

        return __version__
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def _processor() -> str:
    """The processor's name: compiled kernels use what it has."""
    if sys.platform.startswith("linux"):
        try:
            lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            lines = []
        for line in lines:
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or "unknown"
