# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled functions that are called again and again with arguments of the same types."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numba


class Prepared:
    """Entries of a compiled function, one for each list of argument types that was asked for.

    A call of the function itself finds out the types of its arguments each time, which takes longer than the call
    where they are nested tuples. An entry trusts its caller instead: what it gets has to be of the types that it was
    made for.

    Args:
        function: what numba compiles.
    """

    def __init__(self, function: Any) -> None:
        self.function = function
        #: What is called, by the number that `number` gave.
        self.entries: list[Callable[..., Any]] = []
        self._numbers: dict[Hashable, int] = {}
        # Sheets may be stepped by several threads.
        self._lock = threading.Lock()

    def number(self, key: Hashable, arguments: Sequence[Any]) -> int:
        """Return the number of the entry for arguments of the types of these; compiled, or loaded, if need be.

        Args:
            key: what decides these types: equal for equal ones alone. Finding out the types themselves takes long.
            arguments: any of them.
        """
        with self._lock:
            if key not in self._numbers:
                self.entries.append(self.function.compile(tuple(numba.typeof(argument) for argument in arguments)))
                self._numbers[key] = len(self.entries) - 1
            return self._numbers[key]
