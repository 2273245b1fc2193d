# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounded loops of tests: a condition that never holds fails, instead of hanging."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest


def rounds_until(condition: Callable[[], object], max_rounds: int = 600) -> Iterator[int]:
    """Yield the index of each round until a condition holds; fail after `max_rounds` rounds."""
    for index in range(max_rounds):
        if condition():
            return
        yield index
    pytest.fail(f"the condition does not hold after {max_rounds} rounds")
