# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Entries of compiled functions: one for each key, there when its number is given out."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import numba

from cloth_sim_ros.physics.kernels.prepared import Prepared


class Compiler:
    """Stands for a compiled function; while it compiles, somebody may come."""

    def __init__(self, meanwhile: Callable[[], None] = lambda: None) -> None:
        self.compiled: list[Any] = []
        self._meanwhile = meanwhile

    def compile(self, kinds: Any) -> Callable[..., Any]:
        self.compiled.append(kinds)
        self._meanwhile()
        return lambda *arguments: arguments


def test_each_key_is_compiled_once() -> None:
    compiler = Compiler()
    prepared = Prepared(compiler)
    numbers = [prepared.number(key, arguments) for key, arguments in (("i", (1, 2.0)), ("i", (3, 4.0)), ("f", (1.0,)))]
    assert numbers == [0, 0, 1]
    assert len(prepared.entries) == 2
    assert compiler.compiled == [(numba.int64, numba.float64), (numba.float64,)]


def test_who_asks_while_another_thread_compiles_gets_an_entry_that_is_there() -> None:
    asked: list[Future[bool]] = []

    def ask() -> bool:
        return prepared.number("i", (1, 2.0)) < len(prepared.entries)

    def another_comes() -> None:
        asked.append(pool.submit(ask))
        wait(asked, timeout=0.1)

    compiler = Compiler(another_comes)
    prepared = Prepared(compiler)
    with ThreadPoolExecutor(1) as pool:
        assert ask()
        assert asked[0].result()
    assert len(compiler.compiled) == 1
