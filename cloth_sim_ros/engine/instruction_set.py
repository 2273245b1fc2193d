# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the engine's libraries that this machine can run, widest vectors first."""

from __future__ import annotations

import platform
from pathlib import Path

__all__ = ["libraries"]

# The flags that Linux reports for x86-64-v3 and v4 (x86-64 psABI, "Micro-Architecture Levels"), beyond those that every
# processor with AVX2 has. Linux leaves out what the kernel does not save, and calls lzcnt abm.
V3 = frozenset({"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"})
V4 = V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


def libraries(*, machine: str | None = None, cpuinfo: Path = Path("/proc/cpuinfo")) -> list[str]:
    """Return the names of the libraries that this machine can run, preferred first; empty on an unknown processor.

    Args:
        machine: as `uname -m` names it; this machine if None.
        cpuinfo: what Linux says of the processors. Where it can't be read, only what all have is named.
    """
    machine = machine or platform.machine()
    if machine == "aarch64":
        return ["neon"]
    if machine != "x86_64":
        return []
    flags = common_flags(cpuinfo)
    return [*["avx512"] * (flags >= V4), *["avx2"] * (flags >= V3), "baseline"]


def common_flags(cpuinfo: Path) -> frozenset[str]:
    """Return the CPU feature flags that all processors in a cpuinfo file have; empty if it can't be read."""
    try:
        lines = cpuinfo.read_text(errors="replace").splitlines()
    except OSError:
        return frozenset()
    sets = [frozenset(line.partition(":")[2].split()) for line in lines if line.split(":")[0].strip() == "flags"]
    return frozenset.intersection(*sets) if sets else frozenset()
