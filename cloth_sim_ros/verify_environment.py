# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the bits of a run depend on beside its scene and events: the versions and the machine, as text."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

#: Packages, beside this one, whose version can change the last bit of a run.
_PACKAGES = ("numpy", "scipy", "numba", "llvmlite")


def environment() -> dict[str, str]:
    """Versions and machine of this process, under the names that they have in a session's metadata."""
    from cloth_sim_ros import __version__

    return {
        "version": __version__,
        "python": platform.python_version(),
        **{package: _version(package) for package in _PACKAGES},
        "machine": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }


def differences(recorded: Mapping[str, str]) -> list[str]:
    """What differs from the environment that a session's metadata tells of, as ``numba 0.67 -> 0.68``.

    What the recording does not tell is not compared.
    """
    return [
        f"{'cloth_sim_ros' if key == 'version' else key} {recorded[key]} -> {value}"
        for key, value in environment().items()
        if key in recorded and recorded[key] != value
    ]


def _version(package: str) -> str:
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
