# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory that the process holds without using it."""

from __future__ import annotations


def give_back() -> None:
    """Give what is free within the process back to the system, where the C library can: as much as the process needs
    for itself is taken for a while when a large sheet is built, in pieces, and would stay. What refers to itself, such
    as the equations that were in force before, goes first.
    """
    import ctypes
    import gc

    gc.collect()
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return
    trim(ctypes.c_size_t(0))
