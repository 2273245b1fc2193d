# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""User functions that a study names: `file.py:name` or `module:name`.

The text of `file.py` is stored with the study. Workers import `module`.
"""

from __future__ import annotations

import hashlib
import importlib
import sys
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.scene import input_file
from cloth_sim_ros.studies.errors import StudyError

#: Exceptions of user code. An uncaught `sys.exit` would end a worker silently, and the study would wait for another.
USER_ERRORS = (Exception, SystemExit)


@attrs.frozen(kw_only=True)
class FunctionSource:
    """Reference to a user's function, and the text of its file."""

    #: Reference in the study, ``file.py:name`` or ``module:name``.
    reference: str
    #: Text of the file; empty for a module, which every worker must be able to import.
    text: str = ""


@attrs.frozen(kw_only=True)
class Observation:
    """Observation of a frame's beginning for a user's policy: time, particles, wrenches, values, generator."""

    #: Simulated time [s].
    time: float
    #: Index of the frame, from 0.
    frame: int
    #: Particle positions [m], shape (n, 3).
    positions: NDArray[np.float64]
    #: Particle velocities [m/s], shape (n, 3).
    velocities: NDArray[np.float64]
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over the previous frame, shape (grippers, 6).
    wrenches: NDArray[np.float64]
    #: Values of the policy's factors in this run, by name without `policy.`; other factors by full name.
    values: dict[str, Any]
    #: Random generator of this run; its seed follows from the study's seed and the run's index.
    rng: np.random.Generator


@attrs.frozen(kw_only=True)
class Finished:
    """Frames and final state of a run that a user's outcome function receives."""

    #: Simulated time of each frame's end [s], shape (frames,).
    times: NDArray[np.float64]
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over each frame, shape (frames, grippers, 6).
    wrenches: NDArray[np.float64]
    #: Initial and final particle positions [m], shape (n, 3).
    initial: NDArray[np.float64]
    positions: NDArray[np.float64]
    #: Final particle velocities [m/s], shape (n, 3).
    velocities: NDArray[np.float64]
    #: Values of all factors in this run, by full name.
    values: dict[str, Any]


def read_source(reference: Any, role: str, folder: Path) -> FunctionSource:
    """Return the source of a user's function from a reference such as ``file.py:name``. Raises StudyError.

    Args:
        reference: ``file.py:name`` or ``module:name``.
        role: role of the function, for the error text.
        folder: folder of relative file names.

    Raises:
        StudyError: if the reference is invalid, or the file can't be read.
    """
    location, _, name = reference.rpartition(":") if isinstance(reference, str) else ("", "", "")
    if not location or not name.isidentifier():
        raise StudyError(f"{role} is {reference!r}; give file.py:name or package.module:name")
    if not location.endswith(".py"):
        return FunctionSource(reference=reference)
    try:
        text = input_file.read_text(folder / location)
    except (OSError, ValueError) as error:
        raise StudyError(f"{role}: cannot read '{folder / location}': {error}") from error
    return FunctionSource(reference=reference, text=text)


def load_function(source: FunctionSource, role: str) -> Callable[..., Any]:
    """Import a user's module, which runs its code, and return the function or class. Raises StudyError.

    Args:
        source: source of the function.
        role: role of the function, for the error text.

    Raises:
        StudyError: if the import raises, or the module lacks the name.
    """
    location, _, name = source.reference.rpartition(":")
    try:
        module = _module(location, source.text) if location.endswith(".py") else importlib.import_module(location)
    except USER_ERRORS as error:
        raise StudyError(f"{role} '{source.reference}' can't be imported: {format_error(error)}") from error
    function = getattr(module, name, None)
    if not callable(function):
        known = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise StudyError(f"{role}: '{location}' has no function '{name}'; it has {', '.join(known) or 'none'}")
    return function  # type: ignore[no-any-return]


def format_error(error: BaseException) -> str:
    """Return an exception as one line: type, message, and the innermost line of the user's file."""
    message = " ".join(str(error).split())
    trace, line = error.__traceback__, ""
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not file.startswith("<") and "cloth_sim_ros" not in Path(file).parts:
            line = f" ({Path(file).name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return f"{type(error).__name__}: {message}{line}" if message else f"{type(error).__name__}{line}"


def as_events(answer: Any) -> Sequence[Any]:
    """Return a policy's answer as a sequence of events: None gives none, a single event a list of one."""
    if answer is None:
        return []
    if isinstance(answer, list | tuple):
        return answer
    return [answer]


def _module(location: str, text: str) -> types.ModuleType:
    name = f"cloth_sim_ros_study_{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}"
    if name in sys.modules:
        return sys.modules[name]
    module = types.ModuleType(name)
    module.__file__ = location
    sys.modules[name] = module
    try:
        exec(compile(text, location, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module
