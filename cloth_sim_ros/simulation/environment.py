# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Software and machine of a recording, as text."""

from __future__ import annotations

import functools
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

from cloth_sim_ros.engine import NUMERICS, __version__

#: Metadata keys that decide about bits within one arithmetic, and their names in a reported difference.
_REPRODUCIBILITY_KEYS = {"source": "its code"}
#: Arithmetic of sessions without the key `numerics`: they are older than the engine.
_LEGACY_NUMERICS = 1


def environment() -> dict[str, str]:
    """Return versions and machine of this process as texts, by their names in a session's metadata.

    Bits depend on `numerics` and `source` alone; the other entries are informative.
    """
    from cloth_sim_ros.engine.binding import engine_name

    return {
        "version": __version__,
        "numerics": str(NUMERICS),
        "source": _source_digest(),
        "instructions": engine_name(),
        "python": platform.python_version(),
        "numpy": _numpy_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }


def differences(recorded: Mapping[str, str]) -> list[str]:
    """Return texts on differences between this package and a session's recorder that can change bits; empty if none.

    Each difference reads like ``its code 193821 -> 2c46fa``. Entries that the session lacks are not compared.
    """
    present = {"source": _source_digest()}
    return [
        f"{name} {recorded[key]} -> {present[key]}"
        for key, name in _REPRODUCIBILITY_KEYS.items()
        if key in recorded and recorded[key] != present[key]
    ]


def recorder_with_other_arithmetic(recorded: Mapping[str, str]) -> str:
    """Return a session's recorder, as ``cloth_sim_ros 0.1.0 (numba 0.68.1)``, if it rounds differently; else ""."""
    if recorded.get("numerics", str(_LEGACY_NUMERICS)) == str(NUMERICS):
        return ""
    name = f"cloth_sim_ros {recorded['version']}" if "version" in recorded else "another version of cloth_sim_ros"
    compiler = recorded.get("numba")
    return f"{name} (numba {compiler})" if compiler else name


@functools.cache
def _source_digest() -> str:
    """Return the digest of the package's code that determines a run's bits; read once and cached.

    The version alone does not identify code between releases.
    """
    import xxhash

    root = Path(__file__).parent.parent
    patterns = ("physics/**/*.py", "scene/**/*.py", "simulation/**/*.py", "engine/**/*.py", "engine/**/*.?pp")
    hasher = xxhash.xxh3_64()
    for path in sorted(path for pattern in patterns for path in root.glob(pattern)):
        hasher.update(path.relative_to(root).as_posix().encode())
        hasher.update(path.read_bytes())
    return str(hasher.hexdigest())


def _numpy_version() -> str:
    import numpy as np

    return np.__version__


def _processor() -> str:
    """Return the processor's name."""
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
