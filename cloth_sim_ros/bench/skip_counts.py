# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Proof that what a scene does not use is not run: compiled calls, memory and modules, counted."""

from __future__ import annotations

import contextlib
import gc
import json
import subprocess
import sys
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from numba.core.dispatcher import Dispatcher

from cloth_sim_ros.physics.kernels.prepared import Prepared
from cloth_sim_ros.simulation import Simulation


class _Counted:
    """Stands for a compiled function and counts its calls."""

    def __init__(self, name: str, function: Callable[..., Any], calls: Counter[str]) -> None:
        self._name, self._function, self._calls = name, function, calls

    def __call__(self, *arguments: Any) -> Any:
        self._calls[self._name] += 1
        return self._function(*arguments)


class _CountedEntries:
    """Stands for the entries of a compiled function, which are one after another asked for by number."""

    def __init__(self, prepared: Prepared, calls: Counter[str]) -> None:
        self._prepared, self._calls = prepared, calls
        self.entries, self.number = self, prepared.number

    def __getitem__(self, number: int) -> _Counted:
        return _Counted(self._prepared.function.py_func.__name__, self._prepared.entries[number], self._calls)


@contextlib.contextmanager
def counted_calls() -> Iterator[Counter[str]]:
    """Count the calls from Python into compiled functions of the package, by name, while the context lasts.

    What is called must have been compiled before: compiled code can't be made that refers to a counter.
    """
    calls: Counter[str] = Counter()
    replaced: list[tuple[dict[str, Any], str, Dispatcher | Prepared]] = []
    for name, module in list(sys.modules.items()):
        if name.startswith("cloth_sim_ros."):
            for what, value in list(vars(module).items()):
                if isinstance(value, Dispatcher):
                    replaced.append((vars(module), what, value))
                    vars(module)[what] = _Counted(value.py_func.__name__, value, calls)
                elif isinstance(value, Prepared):
                    replaced.append((vars(module), what, value))
                    vars(module)[what] = _CountedEntries(value, calls)
    try:
        yield calls
    finally:
        for namespace, what, value in replaced:
            namespace[what] = value


def calls_of_a_frame(simulation: Simulation, *, frames: int = 1) -> dict[str, int]:
    """Return the compiled calls of the next frames together, by name, after one that is not counted."""
    simulation.advance()
    with counted_calls() as calls:
        for _ in range(frames):
            simulation.advance()
    return dict(sorted(calls.items()))


def bytes_of_a_frame(simulation: Simulation) -> tuple[int, int]:
    """Return how much memory [B] the next frame needs at most beyond what there is, and how much it keeps.

    A frame before it is not counted: what is made once is made then.
    """
    simulation.advance()
    gc.collect()
    tracemalloc.start()
    try:
        frame = simulation.advance()
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        again = simulation.advance()
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    del frame, again
    return peak - before, after - before


def modules_of(values: Mapping[str, Any], *, frames: int = 2) -> set[str]:
    """Return the names of all modules that a fresh interpreter has loaded after some frames of a scene.

    Args:
        values: parameters of the scene.
        frames: how many frames are run.

    Raises:
        RuntimeError: if the scene can't be run.
    """
    script = (
        "import json, sys\n"
        "from cloth_sim_ros.scene import Scene\n"
        "from cloth_sim_ros.simulation import Simulation\n"
        f"simulation = Simulation(Scene.from_parameters(json.loads({json.dumps(dict(values))!r})))\n"
        f"for _ in range({frames}): simulation.advance()\n"
        "print(json.dumps(sorted(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the scene {dict(values)} can't be run: {done.stderr[-2000:]}")
    return set(json.loads(done.stdout.splitlines()[-1]))
