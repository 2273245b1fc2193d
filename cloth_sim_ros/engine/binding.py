# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The engine's library, loaded through ctypes: no interpreter lock is held while it works."""

from __future__ import annotations

import ctypes
import os
import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.instruction_set import libraries

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Number of the interface that this file is written against.
ABI = 15
#: What `cloth_engine` calls return.
_TROUBLES = {1: "the engine failed", 2: "there is not enough memory"}
NOT_FINITE, _BUSY = 4, 5
#: A plan that is at work serves no second call.
AT_WORK = (
    "this plan is at work already, for another thread or for a force that asks it while it is asked; compile the model "
    "once more for a second call at the same time"
)
#: Runs of one frame at most; see frame.hpp.
MAX_RUNS = 8
#: Numbers that a frame tells of its combination; see `told` in frame.hpp.
SUMMARY_NUMBERS = 9
#: Numbers of a gripper's path, and what is booked for each gripper; see held.hpp.
PATH_NUMBERS, BOOKED_NUMBERS = 26, 8
#: Shapes of obstacles; see contact_shapes.hpp. What a run tells of contact beside what it books; see contact.hpp.
SHAPES = {"plane": 0, "box": 1, "sphere": 2, "capsule": 3, "cylinder": 4, "mesh": 5}
CONTACT_SUMMARY_NUMBERS = 7
#: Numbers of an anchor of friction; see contact_friction.hpp.
ANCHOR_NUMBERS = 4
#: Numbers of where a gripper's pads are, and of what drives them; see contact_pinch.hpp and library.cpp.
PINCH_NUMBERS, DRIVE_NUMBERS = 2, 7
#: Kinds of listed elements with the particles and numbers of each; see list.hpp.
KINDS = {
    "spring": (0, 2, 3),
    "joint": (1, 2, 2),
    "crossed": (2, 4, 3),
    "altitude": (3, 4, 3),
    "triangle": (4, 3, 0),
    "quad": (5, 4, 0),
}
#: Families of a grid's springs in the engine's order; see grid_row.hpp.
FAMILIES = ("right", "down", "diagonal", "antidiagonal", "right2", "down2")
#: What a user's own force is called with: t, x, v, f and powers (or null); returns `CALLED_WELL`, or another number to
#: end the run. ctypes returns any number for an exception that nobody caught.
CALLED_WELL = 1611516433
CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, *(ctypes.POINTER(ctypes.c_double),) * 4)


class EngineError(RuntimeError):
    """The engine is not there, or failed."""


class Frame(ctypes.Structure):
    """A frame's request; the same layout as frame.hpp's."""

    _fields_ = (
        ("t", ctypes.c_double),
        ("duration", ctypes.c_double),
        ("runs", ctypes.c_int64),
        ("steps", ctypes.c_void_p),
        ("weights", ctypes.c_void_p),
        ("single_precision", ctypes.c_int64),
        ("bands", ctypes.c_int64),
        ("x0", ctypes.c_void_p),
        ("v0", ctypes.c_void_p),
        ("out", ctypes.c_void_p),
        ("result", ctypes.c_void_p),
        ("records", ctypes.c_void_p),
        ("record_powers", ctypes.c_int64),
        ("summary", ctypes.c_void_p),
        ("bounds_level", ctypes.c_int64),
        ("record_obstacles", ctypes.c_int64),
        ("anchors", ctypes.c_void_p),
        ("jaw_states", ctypes.c_void_p),
        ("multirate", ctypes.c_int64),
        ("combined", ctypes.c_int64),
        ("concurrency", ctypes.c_int64),
    )


#: The same, written in one go.
FRAME = struct.Struct(
    "@" + "".join({ctypes.c_double: "d", ctypes.c_int64: "q"}.get(kind, "P") for _, kind in Frame._fields_)
)

_P, _I, _D, _INT = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_int
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "cloth_plan_free": (None, _P),
    "cloth_plan_new": (_P, _I, _P, _P),
    "cloth_plan_grid": (_INT, _P, _I, _I, _P),
    "cloth_plan_list": (_INT, _P, _INT, _I, _P, _P, _P),
    "cloth_plan_uniform": (_INT, _P, _P, _P, _D),
    "cloth_plan_air": (_INT, _P, _P),
    "cloth_plan_order": (_INT, _P, _P),
    "cloth_plan_callback": (_INT, _P, CALLBACK),
    "cloth_plan_grips": (_INT, _P, _I, _I, _P, _P, _P, _P, _P),
    "cloth_plan_gripper_paths": (_INT, _P, _P),
    "cloth_plan_contact": (_INT, _P, _I, _P, _P, _P, _P, _P, _D, _D, _D),
    "cloth_plan_contact_paths": (_INT, _P, _P),
    "cloth_plan_jaws": (_INT, _P, _I, _P, _P),
    "cloth_plan_jaw_states": (_INT, _P, _P),
    "cloth_jaw_accelerations": (_INT, _P, _D, _P, _P, _P),
    "cloth_frame": (_INT, _P, ctypes.POINTER(Frame)),
    "cloth_accelerations": (_INT, _P, _D, _P, _P, _P),
    "cloth_energy": (_INT, _P, _D, _P, _P, _P),
    "cloth_powers": (_INT, _P, _D, _P, _P, _P),
    "cloth_grip_wrenches": (_INT, _P, _D, _P, _P, _D, _P),
    "cloth_contact_wrenches": (_INT, _P, _D, _P, _P, _D, _P),
    "cloth_contact_gaps": (_INT, _P, _D, _P, _P),
    "cloth_contact_bounds": (_INT, _P, _D, _P, _P, _P),
    "cloth_predict_obstacle_contact": (_INT, _P, _D, _D, _P, _P, _P),
    "cloth_contact_anchors": (_INT, _P, _P),
    "cloth_combine_anchors": (_INT, _P, _D, _P, _P, _I, _P, _P, _P),
    "cloth_ccd_obstacles": (_INT, _P, _D, _D, _P, _P, _P),
    "cloth_contact_thickness": (_INT, _P, _P, _P, _D),
    "cloth_contact_gap_rows": (_INT, _P, _D, _P, _P),
    "cloth_contact_growth_power": (_INT, _P, _D, _P, _P, _P),
    "cloth_contact_limits": (_INT, _P, _D, _P),
    "cloth_plan_mesh": (_INT, _P, _I, _I, _P, _I, _P),
    "cloth_plan_faces": (_INT, _P, _I, _P, _D),
    "cloth_plan_features": (_INT, _P, _I, _I, _P, _I, _P, _D),
    "cloth_features_culled": (_INT, _P, _D, _D, _P, _P, _P),
    "cloth_predict_contact": (_INT, _P, _D, _D, _D, _D, _P, _P, _P),
    "cloth_predict_surface_contact": (_INT, _P, _D, _D, _D, _P, _P, _P),
    "cloth_ccd_features": (_INT, _P, _D, _D, _P, _P, _P),
    "cloth_ccd_jaws": (_INT, _P, _D, _P, _P, _P),
    "cloth_feature_intersection": (_INT, _P, _D, _P, _P),
    "cloth_plan_self": (_INT, _P, _I, _P, _D),
    "cloth_self_friction": (_INT, _P, _D, _D),
    "cloth_self_friction_power": (_INT, _P, _D, _P, _P, _P),
    "cloth_self_cache_pairs": (_INT, _P, _I),
    "cloth_self_bounds": (_INT, _P, _D, _P, _P, _P),
    "cloth_self_gaps": (_INT, _P, _P, _P),
    "cloth_self_intersection": (_INT, _P, _P, _P),
    "cloth_self_culled": (_INT, _P, _D, _P, _P, _P),
    "cloth_ccd_self": (_INT, _P, _P, _P, _P),
    "cloth_spectral_bounds": (_INT, _P, _P, _P, _P, _I, _P),
    "cloth_bounds": (_INT, _P, _P, _P, _P),
    "cloth_eigenvalues": (_INT, _P, _I, _P),
    "cloth_derivative_product": (_INT, _P, _D, _P, _P, _P, _P, _P),
    "cloth_pair_blocks": (_INT, _P, _I, _P, _D, _D, _P),
    "cloth_paths": (_INT, _I, _D, _D, *(_P,) * 8),
    "cloth_rotation_vector": (_INT, _P, _P, _P),
    "cloth_pose": (_INT, _P, _D, _P),
    "cloth_hinge_lengths": (_INT, _INT, _I, _P, _P, _I, _P, _P),
    "cloth_combine": (_INT, _I, _P, _P, _I, _P),
    "cloth_distance": (_INT, _P, _P, _I, _P),
    "cloth_weighted_dot": (_INT, _P, _P, _P, _I, _P),
}


#: Calls that take a microsecond: to give the interpreter lock away for them would cost more, and let other threads that
#: step cloths wait for it once more.
_BRIEF = frozenset(
    (
        "cloth_paths",
        "cloth_plan_gripper_paths",
        "cloth_plan_grips",
        "cloth_rotation_vector",
        "cloth_pose",
        "cloth_plan_contact_paths",
    )
)


@cache
def library() -> ctypes.CDLL:
    """Load the library for this machine's widest vectors; every one of them gives the same bits.

    The environment variable CLOTH_SIM_ROS_ENGINE names another one: an instruction set, or a path.

    Raises:
        EngineError: if there is none that this machine can run; the message says how to build it.
    """
    wanted = os.environ.get("CLOTH_SIM_ROS_ENGINE", "")
    folder = Path(__file__).parent
    if "/" in wanted:
        candidates = [Path(wanted)]
    else:
        candidates = [folder / f"_{name}.so" for name in ([wanted] if wanted else libraries())]
    for path in candidates:
        if path.exists():
            return _prepared(path)
    names = ", ".join(str(path) for path in candidates)
    raise EngineError(
        f"the engine is not built: there is no {names}; build it with `make engine`, or `pip install` or `colcon "
        "build` the package, which need a C++ compiler (Debian and Ubuntu: g++)"
    )


def _prepared(path: Path) -> ctypes.CDLL:
    try:
        # Each instruction set's templates stay its own: RTLD_LOCAL, ctypes' default.
        loaded = ctypes.CDLL(str(path))
        found = int(loaded.cloth_engine_abi())
    except (OSError, AttributeError) as error:
        raise EngineError(f"{path} is no engine that this machine can load: {error}; build it again") from error
    if found != ABI:
        raise EngineError(f"{path} has interface {found}, this package needs {ABI}; build it again with `make engine`")
    loaded.cloth_engine_name.restype = ctypes.c_char_p
    held = ctypes.PyDLL(str(path), handle=loaded._handle)
    for name, (result, *arguments) in _SIGNATURES.items():
        if name in _BRIEF:
            setattr(loaded, name, getattr(held, name))
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


def engine_name() -> str:
    """Name of the instruction set in use."""
    return str(library().cloth_engine_name().decode())


def check(status: int) -> None:
    """Raise what a call's status says.

    Raises:
        MemoryError: where memory did not suffice.
        RuntimeError: where the plan is at work for another call.
        EngineError: for any other trouble.
    """
    if status == _BUSY:
        raise RuntimeError(AT_WORK)
    if status == 2:
        raise MemoryError("the engine could not get the memory that this cloth needs")
    if status:
        raise EngineError(_TROUBLES.get(status, f"the engine answered {status}"))


_DOUBLE, _ARRAY = np.dtype(np.float64), np.ndarray
# Together a third of what `array.ctypes.data` takes.
_addressof, _from_buffer = ctypes.addressof, ctypes.c_char.from_buffer


def address(array: Any) -> int:
    """Return where the numbers of an array are that is C-contiguous, can be written and has some."""
    return _addressof(_from_buffer(array))


def doubles(name: str, array: Array, shape: tuple[int, ...]) -> int:
    """Return the address of an array that the engine may read or write.

    Raises:
        ValueError: for another shape or type, or an array that is not C-contiguous or not aligned.
    """
    # What nearly every call hands over, told by the fewest questions: `carray` is contiguous, aligned and writeable.
    if type(array) is _ARRAY and array.dtype is _DOUBLE and array.shape == shape and array.flags.carray and array.size:
        return address(array)
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name} is of type {type(array).__name__}; it must be an array of shape {shape}")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; it must be {shape}")
    if array.dtype != _DOUBLE or not array.flags.c_contiguous:
        layout = "" if array.flags.c_contiguous else ", not C-contiguous"
        raise ValueError(f"{name} is {array.dtype}{layout}; it must be C-contiguous float64")
    if not array.flags.aligned:
        raise ValueError(f"{name} begins at an address that is no multiple of {array.itemsize}; give a copy of it")
    return int(array.ctypes.data)


def writable(name: str, array: Array, shape: tuple[int, ...]) -> int:
    """Return the address of an array that the engine may write.

    Raises:
        ValueError: as `doubles` does, and for an array that is read-only.
    """
    place = doubles(name, array, shape)
    if not array.flags.writeable:
        raise ValueError(f"{name} is read-only; results are written to it, so give another one")
    return place


def finite(name: str, value: Any, shape: tuple[int, ...], *, least: float = -np.inf, one_for_all: bool = True) -> Array:
    """Return numbers as the engine takes them, one number standing for all unless said otherwise.

    Raises:
        ValueError: for another shape, or a number that is not finite or below the least.
    """
    try:
        given = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} is {value!r:.80}; it must be numbers") from error
    if given.shape != shape and (given.ndim or not one_for_all):
        single = ", or one number" if shape and one_for_all else ""
        raise ValueError(f"{name} has shape {given.shape}; it must be {shape or 'one number'}{single}")
    array = np.ascontiguousarray(np.broadcast_to(given, shape)).reshape(shape)
    wrong = np.argwhere(~(np.isfinite(array) & (array >= least)))
    # The place of a single number is empty, and yet it is one.
    if len(wrong):
        place = tuple(int(i) for i in wrong[0])
        limit = "finite" if least == -np.inf else f"finite and at least {least:g}"
        raise ValueError(f"{name}{list(place) if place else ''} is {array[place]}; it must be {limit}")
    return array


def indices(name: str, value: Any, columns: int, most: int) -> Indices:
    """Return particle numbers as the engine takes them, shape (m, columns).

    Raises:
        ValueError: for another shape, numbers that are not whole, or one that is not from 0 to below `most`.
    """
    try:
        given = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} has rows of different lengths; it must be (m, {columns})") from error
    if given.size and given.dtype.kind not in "iu":
        raise ValueError(f"{name} is of type {given.dtype}; particles are counted by whole numbers")
    if given.ndim != 2 and not given.size:
        given = given.reshape(0, columns)
    if given.ndim != 2 or given.shape[1] != columns:
        raise ValueError(f"{name} has shape {given.shape}; it must be (m, {columns})")
    array = np.ascontiguousarray(given, dtype=np.int64)
    wrong = np.argwhere((array < 0) | (array >= most))
    if wrong.size:
        row, column = wrong[0]
        known = f"there are {most}," if most < np.iinfo(np.int64).max else "they are"
        raise ValueError(f"row {row} of {name} names particle {given[row, column]}; {known} counted from 0")
    return array
