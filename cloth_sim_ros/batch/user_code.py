# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Functions of the user's that a study names: `file.py:name`, whose text goes with the study, or `module:name`."""

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

from cloth_sim_ros.batch.errors import StudyError
from cloth_sim_ros.scene import input_file

#: What a user's code may raise. `sys.exit` would end a worker without a word, and the study would wait for another one.
USER_ERRORS = (Exception, SystemExit)


@attrs.frozen(kw_only=True)
class Source:
    """Where a function comes from."""

    #: As the study names it.
    reference: str
    #: Text of the file; empty for a module, which every worker must be able to import.
    text: str = ""


@attrs.frozen(kw_only=True)
class Observation:
    """What a policy is told at the beginning of a frame."""

    #: Simulated time [s].
    time: float
    #: Number of the frame, from 0.
    frame: int
    #: Particle positions [m], shape (n, 3).
    positions: NDArray[np.float64]
    #: Particle velocities [m/s], shape (n, 3).
    velocities: NDArray[np.float64]
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over the frame before, shape (grippers, 6).
    wrenches: NDArray[np.float64]
    #: What this run has for everything that varies, by name.
    values: dict[str, Any]
    #: Random numbers of this run alone: they follow from the study's seed and the run's number.
    rng: np.random.Generator


@attrs.frozen(kw_only=True)
class Finished:
    """What a user's outcome is made of, at the end of a run."""

    #: Simulated time of each frame's end [s], shape (frames,).
    times: NDArray[np.float64]
    #: Force [N] and torque [N m] of the cloth on each gripper, mean over each frame, shape (frames, grippers, 6).
    wrenches: NDArray[np.float64]
    #: Positions at the start and at the end [m], shape (n, 3).
    initial: NDArray[np.float64]
    positions: NDArray[np.float64]
    #: Velocities at the end [m/s], shape (n, 3).
    velocities: NDArray[np.float64]
    #: What this run has for everything that varies, by name.
    values: dict[str, Any]


def find(reference: Any, what: str, folder: Path) -> Source:
    """Read what a study names.

    Args:
        reference: ``file.py:name`` or ``module:name``.
        what: of the study's entry, for messages.
        folder: where file names start.

    Raises:
        StudyError: if it is no such reference, or the file can't be read.
    """
    place, _, name = reference.rpartition(":") if isinstance(reference, str) else ("", "", "")
    if not place or not name.isidentifier():
        raise StudyError(f"{what} is {reference!r}; write file.py:name or package.module:name")
    if not place.endswith(".py"):
        return Source(reference=reference)
    try:
        text = input_file.read_text(folder / place)
    except (OSError, ValueError) as error:
        raise StudyError(f"{what}: cannot read '{folder / place}': {error}") from error
    return Source(reference=reference, text=text)


def load(source: Source, what: str) -> Callable[..., Any]:
    """Import a function or class.

    Raises:
        StudyError: if the import raises, or there is no such name in it.
    """
    place, _, name = source.reference.rpartition(":")
    try:
        module = _module(place, source.text) if source.text else importlib.import_module(place)
    except USER_ERRORS as error:
        raise StudyError(f"{what} '{source.reference}' can't be imported: {in_words(error)}") from error
    found = getattr(module, name, None)
    if not callable(found):
        there = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise StudyError(f"{what}: '{place}' has no function '{name}'; it has {', '.join(there) or 'none'}")
    return found  # type: ignore[no-any-return]


def in_words(error: BaseException) -> str:
    """An exception in a line: its kind, its words, and the line of the user's file where it was raised."""
    words = " ".join(str(error).split())
    trace, line = error.__traceback__, ""
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not file.startswith("<") and "cloth_sim_ros" not in Path(file).parts:
            line = f" ({Path(file).name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return f"{type(error).__name__}: {words}{line}" if words else f"{type(error).__name__}{line}"


def events_of(answer: Any) -> Sequence[Any]:
    """What a policy returned, as a list: None is no event."""
    if answer is None:
        return []
    if isinstance(answer, list | tuple):
        return answer
    return [answer]


def _module(place: str, text: str) -> types.ModuleType:
    name = f"cloth_sim_ros_study_{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}"
    if name in sys.modules:
        return sys.modules[name]
    module = types.ModuleType(name)
    module.__file__ = place
    sys.modules[name] = module
    try:
        exec(compile(text, place, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module
