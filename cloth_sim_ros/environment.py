# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the bits of a run depend on beside its scene and events: the versions and the machine, as text."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

_NAMES = {"version": "cloth_sim_ros", "source": "its code"}
#: Packages, beside this one, whose version can change the last bit of a run.
_PACKAGES = ("numpy", "scipy", "numba", "llvmlite")


def environment() -> dict[str, str]:
    """Versions and machine of this process, under the names that they have in a session's metadata."""
    from cloth_sim_ros import __version__

    return {
        "version": __version__,
        "source": _source(),
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
        f"{_NAMES.get(key, key)} {recorded[key]} -> {value}"
        for key, value in environment().items()
        if key in recorded and recorded[key] != value
    ]


@functools.cache
def _source() -> str:
    """Digest of the code that a run's bits come from: between two releases the version alone does not tell."""
    import xxhash

    root = Path(__file__).parent
    hasher = xxhash.xxh3_64()
    for path in sorted([*root.glob("*.py"), *root.glob("physics/**/*.py")]):
        hasher.update(path.relative_to(root).as_posix().encode())
        hasher.update(path.read_bytes())
    return str(hasher.hexdigest())


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
