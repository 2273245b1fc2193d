# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ctypes binding of the engine, which runs without the interpreter lock."""

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

#: Number of the C interface that this file binds.
ABI = 31
#: Errors by the status of a call.
_ERRORS = {1: "the engine failed", 2: "there is not enough memory"}
NOT_FINITE, _BUSY = 4, 5
#: Error text of a plan that is not re-entrant.
REENTRY_REFUSAL = (
    "the plan is not re-entrant: another call is running, of another thread or of the force that this call evaluates; "
    "compile the model once per thread"
)
#: Maximum number of runs of one frame; see plan/frame_request.hpp.
MAX_RUNS = 8
#: Numbers of the summary of a frame; see `FrameRequest::summary` in plan/frame_request.hpp.
SUMMARY_NUMBERS = 11
#: Numbers of a gripper's path, and of its record of wrench and work; see plan/grips.hpp.
PATH_NUMBERS, RECORD_NUMBERS = 26, 8
#: Shapes of obstacles; see contact/shapes.hpp. Numbers of the contact summary of a run; see plan/frame_request.hpp.
SHAPES = {"plane": 0, "box": 1, "sphere": 2, "capsule": 3, "cylinder": 4, "mesh": 5}
CONTACT_SUMMARY_NUMBERS = 7
#: Numbers of an anchor of friction; see laws/friction.hpp.
ANCHOR_NUMBERS = 4
#: Numbers of the state of a gripper's jaws, and of their drive; see contact/parallel_jaw.hpp and api/cloth_sim.hpp.
JAW_NUMBERS, DRIVE_NUMBERS = 2, 8
#: Kinds of listed elements with their particles and parameters; see mesh/elements.hpp.
KINDS = {
    "spring": (0, 2, 3),
    "joint": (1, 2, 2),
    "crossed": (2, 4, 3),
    "altitude": (3, 4, 3),
    "triangle": (4, 3, 0),
    "quad": (5, 4, 0),
    "edge_edge": (6, 4, 3),
    "point_face": (7, 4, 3),
    "membrane": (8, 3, 6),
    "mass_triangle": (9, 3, 0),
    "mass_quad": (10, 4, 0),
    "quadratic": (11, 4, 4),
    "stiffening_membrane": (12, 3, 6),
    "bending_friction": (13, 4, 3),
    "coupling": (14, 2, 1),
}
#: Families of a grid's springs in the engine's order; see grid/row.hpp.
FAMILIES = ("right", "down", "diagonal", "antidiagonal", "right2", "down2")
#: Callback of forces in Python, called with t, x, v, f and powers (or null). It returns `CALLED_WELL`. Another number,
#: which ctypes returns after an uncaught exception, ends the run.
CALLED_WELL = 1611516433
CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, *(ctypes.POINTER(ctypes.c_double),) * 4)


class EngineError(RuntimeError):
    """Error: the engine's library is missing or can't be loaded, or a call of it failed."""


class FrameRequest(ctypes.Structure):
    """Argument of `cloth_frame`: values and array pointers of leapfrog runs; the C struct of plan/frame_request.hpp."""

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
        ("activities", ctypes.c_void_p),
        ("previous_v0", ctypes.c_void_p),
        ("previous_ratio", ctypes.c_double),
        ("plastic_lengths", ctypes.c_void_p),
    )


#: Packs a `FrameRequest` in one call.
FRAME = struct.Struct(
    "@" + "".join({ctypes.c_double: "d", ctypes.c_int64: "q"}.get(kind, "P") for _, kind in FrameRequest._fields_)
)

_P, _I, _D, _INT = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_int
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "cloth_plan_free": (None, _P),
    "cloth_plan_new": (_P, _I, _P, _P),
    "cloth_plan_grid": (_INT, _P, _I, _I, _P),
    "cloth_plan_list": (_INT, _P, _INT, _I, _P, _P, _P),
    "cloth_plan_uniform": (_INT, _P, _P, _P, _D),
    "cloth_plan_air": (_INT, _P, _P),
    "cloth_plan_plastic_lengths": (_INT, _P, _P),
    "cloth_plan_order": (_INT, _P, _P),
    "cloth_plan_callback": (_INT, _P, CALLBACK),
    "cloth_plan_grips": (_INT, _P, _I, _I, _P, _P, _P, _P, _P, _P),
    "cloth_plan_gripper_paths": (_INT, _P, _P),
    "cloth_plan_contact": (_INT, _P, _I, _P, _P, _P, _P, _P, _D, _D, _D),
    "cloth_plan_contact_paths": (_INT, _P, _P),
    "cloth_plan_jaws": (_INT, _P, _I, _P, _P),
    "cloth_plan_jaw_states": (_INT, _P, _P),
    "cloth_jaw_accelerations": (_INT, _P, _D, _P, _P, _P),
    "cloth_frame": (_INT, _P, ctypes.POINTER(FrameRequest)),
    "cloth_accelerations": (_INT, _P, _D, _P, _P, _P),
    "cloth_energy": (_INT, _P, _D, _P, _P, _P),
    "cloth_mass_blocks": (_INT, _P, _P, _P),
    "cloth_powers": (_INT, _P, _D, _P, _P, _P),
    "cloth_grip_wrenches": (_INT, _P, _D, _P, _P, _D, _P),
    "cloth_prescribe": (_INT, _P, _D, _P, _P, _P),
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
    "cloth_hinge_jerk": (_INT, _P, _P, _P, _P),
    "cloth_kink_velocities": (_INT, _P, _P, _P, _P, _P, _P, _P, _D, _D, _P),
    "cloth_contact_jerk_change": (_INT, _P, _D, _D, _P, _P, _P, _P, _P),
    "cloth_friction_change": (_INT, _P, _D, _D, _P, _P, _P, _P, _P),
    "cloth_stretch_difference": (_INT, _P, _D, _P, _P, _P, _P),
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
    "cloth_self_joints": (_INT, _P, _P),
    "cloth_self_friction": (_INT, _P, _D, _D),
    "cloth_self_friction_power": (_INT, _P, _D, _P, _P, _P),
    "cloth_self_cache_pairs": (_INT, _P, _I),
    "cloth_self_bounds": (_INT, _P, _D, _P, _P, _P),
    "cloth_self_gaps": (_INT, _P, _P, _P),
    "cloth_self_intersection": (_INT, _P, _P, _P),
    "cloth_self_culled": (_INT, _P, _D, _P, _P, _P),
    "cloth_ccd_self": (_INT, _P, _P, _P, _P),
    "cloth_velocity_displacement": (_INT, _P, _D, _P, _P, _D, _P),
    "cloth_spectral_bounds": (_INT, _P, _P, _P, _P, _I, _P),
    "cloth_turn_in_step": (_INT, _P, _P, _P, _I, _I, _P),
    "cloth_bounds": (_INT, _P, _P, _P, _P),
    "cloth_eigenvalues": (_INT, _P, _I, _P),
    "cloth_derivative_product": (_INT, _P, _D, _P, _P, _P, _P, _P),
    "cloth_pair_blocks": (_INT, _P, _I, _P, _D, _D, _P),
    "cloth_membrane_blocks": (_INT, _P, _I, _P, _D, _D, _P),
    "cloth_paths": (_INT, _I, _D, _D, *(_P,) * 8),
    "cloth_rotation_vector": (_INT, _P, _P, _P),
    "cloth_pose": (_INT, _P, _D, _P),
    "cloth_hinge_lengths": (_INT, _INT, _I, _P, _P, _I, _P, _P),
    "cloth_combine_plastic_lengths": (_INT, _P, _P, _I, _P, _P, _P, _P),
    "cloth_combine": (_INT, _I, _P, _P, _I, _P),
    "cloth_distance": (_INT, _P, _P, _I, _P),
    "cloth_weighted_dot": (_INT, _P, _P, _P, _I, _P),
    "cloth_draw_triangles": (_INT, _I, _I, _P, _P, _I, _P, _I, _P, _I, _I, _P, _P),
    "cloth_draw_solid": (_INT, _I, _I, _P, _P, _I, _P, _D, _I, _P, _P),
}


#: Calls of about a microsecond: they keep the interpreter lock, because releasing it would cost more.
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
    """Return the engine's library, loaded once: of the widest vectors here, or the choice of CLOTH_SIM_ROS_ENGINE.

    The environment variable names an instruction set, or a path. All libraries give the same bits.

    Raises:
        EngineError: if there is none that this machine can run; the message says how to build it.
    """
    choice = os.environ.get("CLOTH_SIM_ROS_ENGINE", "")
    folder = Path(__file__).parent
    if "/" in choice:
        candidates = [Path(choice)]
    else:
        candidates = [folder / f"_{name}.so" for name in ([choice] if choice else libraries())]
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
        abi = int(loaded.cloth_engine_abi())
    except (OSError, AttributeError) as error:
        raise EngineError(f"{path} is no engine that this machine can load: {error}; build it again") from error
    if abi != ABI:
        raise EngineError(f"{path} has interface {abi}, this package needs {ABI}; build it again with `make engine`")
    loaded.cloth_engine_name.restype = ctypes.c_char_p
    locking = ctypes.PyDLL(str(path), handle=loaded._handle)
    for name, (result, *arguments) in _SIGNATURES.items():
        if name in _BRIEF:
            setattr(loaded, name, getattr(locking, name))
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


def engine_name() -> str:
    """Return the instruction set of the engine's library, such as avx2; loads the library if necessary."""
    return str(library().cloth_engine_name().decode())


def check(status: int) -> None:
    """Raise MemoryError, RuntimeError or EngineError for an engine function's status code; do nothing for status 0.

    Raises:
        MemoryError: if there is not enough memory.
        RuntimeError: if another call of the plan is running.
        EngineError: for any other error.
    """
    if status == _BUSY:
        raise RuntimeError(REENTRY_REFUSAL)
    if status == 2:
        raise MemoryError("the engine could not get the memory that this cloth needs")
    if status:
        raise EngineError(_ERRORS.get(status, f"the engine answered {status}"))


_DOUBLE, _ARRAY = np.dtype(np.float64), np.ndarray
# Together a third of what `array.ctypes.data` takes.
_addressof, _from_buffer = ctypes.addressof, ctypes.c_char.from_buffer


def address(array: Any) -> int:
    """Return the memory address of a writable, C-contiguous, non-empty array; TypeError or ValueError for others."""
    return _addressof(_from_buffer(array))


def float64_address(name: str, array: Array, shape: tuple[int, ...]) -> int:
    """Return the address of a C-contiguous float64 array of a shape; ValueError, with the name, for another array.

    Raises:
        ValueError: for another shape or type, or an array that is not C-contiguous or not aligned.
    """
    # Fast path of nearly every call: `carray` means contiguous, aligned and writable.
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


def writable_address(name: str, array: Array, shape: tuple[int, ...]) -> int:
    """Return the address of a writable, C-contiguous float64 array of a shape; ValueError, with the name, for others.

    Raises:
        ValueError: as `float64_address` does, and for an array that is read-only.
    """
    pointer = float64_address(name, array, shape)
    if not array.flags.writeable:
        raise ValueError(f"{name} is read-only; results are written to it, so give another one")
    return pointer


def checked_floats(
    name: str, value: Any, shape: tuple[int, ...], *, lower: float = -np.inf, one_for_all: bool = True
) -> Array:
    """Convert a value, or a scalar for all, to a float64 array, perhaps a read-only view; ValueError unless finite.

    Raises:
        ValueError: for another shape, or a number that is not finite or below `lower`.
    """
    try:
        values = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} is {value!r:.80}; it must be numbers") from error
    if values.shape != shape and (values.ndim or not one_for_all):
        single = ", or one number" if shape and one_for_all else ""
        raise ValueError(f"{name} has shape {values.shape}; it must be {shape or 'one number'}{single}")
    array = np.ascontiguousarray(np.broadcast_to(values, shape)).reshape(shape)
    wrong = np.argwhere(~(np.isfinite(array) & (array >= lower)))
    # The index of a scalar is empty.
    if len(wrong):
        index = tuple(int(i) for i in wrong[0])
        limit = "finite" if lower == -np.inf else f"finite and at least {lower:g}"
        raise ValueError(f"{name}{list(index) if index else ''} is {array[index]}; it must be {limit}")
    return array


def checked_indices(name: str, value: Any, columns: int, stop: int) -> Indices:
    """Convert a value to int64 particle indices (m, columns), perhaps itself; ValueError outside 0 ... stop - 1.

    Raises:
        ValueError: for another shape, numbers that are not whole, or one that is not from 0 to below `stop`.
    """
    try:
        values = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} has rows of different lengths; it must be (m, {columns})") from error
    if values.size and values.dtype.kind not in "iu":
        raise ValueError(f"{name} is of type {values.dtype}; particles are counted by whole numbers")
    if values.ndim != 2 and not values.size:
        values = values.reshape(0, columns)
    if values.ndim != 2 or values.shape[1] != columns:
        raise ValueError(f"{name} has shape {values.shape}; it must be (m, {columns})")
    array = np.ascontiguousarray(values, dtype=np.int64)
    wrong = np.argwhere((array < 0) | (array >= stop))
    if wrong.size:
        row, column = wrong[0]
        known = f"there are {stop}," if stop < np.iinfo(np.int64).max else "they are"
        raise ValueError(f"row {row} of {name} names particle {values[row, column]}; {known} counted from 0")
    return array
