# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Full dynamic state of a cloth and its digest."""

from __future__ import annotations

import functools
import io
import operator
import struct
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.old_names import with_old_names
from cloth_sim_ros.physics.state import memory as state_memory
from cloth_sim_ros.physics.state import npz
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_KEY, LEGACY_KEYS, PLASTIC_LENGTHS_KEY

_FRAME = "frame"
_POSITION = "position"
_VELOCITY = "velocity"
_MEMORY = "memory."
#: In state files, but not in the digest: constant while a cloth exists.
_CLOTH = "cloth"
#: In state files, but not in the digest: the contact thickness in use.
_THICKNESS = "contact_thickness"
#: In state files, but not in the digest: names of grippers and obstacles, in the order of the memory's arrays.
_BODIES = ("grippers", "obstacles")
#: Largest frame number: files hold an int64.
_MAX_FRAME = 2**63 - 1


@with_old_names(become="assign", go_back="restore_motion", share="shallow_copy")
class State:
    """Full state of a cloth: positions, velocities, frame number, and named memory of controllers and contact.

    Args:
        positions: particle positions [m], shape (particle_count, 3).
        velocities: particle velocities [m/s], shape (particle_count, 3); the default is rest.
        memory: further arrays by name, float64, int64 or bool; each is part of the state and of its digest.
        frame: frame number of the state.
        cloth: identity of the cloth: rows, columns (1 and the particle count if it is no grid) and a fingerprint of its
            connections (0 for a grid); None if unknown.

    Raises:
        ValueError: for shapes that do not fit, entries that are not finite, or memory of other types.
    """

    def __init__(
        self,
        positions: ArrayLike,
        velocities: ArrayLike | None = None,
        *,
        memory: dict[str, np.ndarray] | None = None,
        frame: int = 0,
        cloth: tuple[int, int, int] | None = None,
    ) -> None:
        position = _numbers("positions", positions)
        if position.ndim != 2 or position.shape[1] != 3 or len(position) == 0:
            raise ValueError(f"positions have shape {position.shape}; they must be (particle_count, 3)")
        velocity = np.zeros_like(position) if velocities is None else _numbers("velocities", velocities)
        if velocity.shape != position.shape:
            raise ValueError(f"velocities have shape {velocity.shape}; positions have {position.shape}")
        for quantity, array in (("position", position), ("velocity", velocity)):
            wrong = np.flatnonzero(~np.isfinite(array).all(axis=1))
            if wrong.size:
                raise ValueError(f"{quantity} of particle {wrong[0]} is {array[wrong[0]].tolist()}; it must be finite")
        #: Positions [m], component-major, shape (3, particle_count).
        self.x: Array = np.array(position.T, order="C")
        #: Velocities [m/s], component-major, shape (3, particle_count).
        # Zeros need no memory from the system until they are written.
        self.v: Array = np.zeros(self.x.shape) if velocities is None else np.array(velocity.T, order="C")
        try:
            self.frame = operator.index(frame)
        except TypeError:
            self.frame = -1
        if not 0 <= self.frame <= _MAX_FRAME:
            raise ValueError(f"frame is {frame!r}; it must be a whole number of frames, from 0 to {_MAX_FRAME}")
        self.memory: dict[str, np.ndarray] = dict(memory or {})
        for name, array in self.memory.items():
            _check_memory(name, array)
        self.cloth = cloth
        #: `contact.thickness` of the simulation that made the state [m]; None without contact, or if unknown.
        self.thickness: float | None = None
        #: Names of grippers, and of obstacles, of the simulation that made the state; None if unknown.
        self.bodies: tuple[tuple[str, ...], ...] | None = None
        #: Names of memory of older versions in the state file; the state lacks it, and its rules start afresh.
        self.dropped_memory: tuple[str, ...] = ()

    @property
    def particle_count(self) -> int:
        """Number of particles."""
        return int(self.x.shape[1])

    @property
    def positions(self) -> Array:
        """Particle positions [m], a copy of shape (particle_count, 3)."""
        return np.ascontiguousarray(self.x.T)

    @property
    def velocities(self) -> Array:
        """Particle velocities [m/s], a copy of shape (particle_count, 3)."""
        return np.ascontiguousarray(self.v.T)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays of the state by name, uncopied, in the fixed order of the digest."""
        arrays = {_FRAME: np.array(self.frame, dtype=np.int64), _POSITION: self.x, _VELOCITY: self.v}
        for name in sorted(self.memory):
            arrays[_MEMORY + name] = self.memory[name]
        return arrays

    def copy(self) -> State:
        """Return an independent copy of all fields, arrays included."""
        twin = self.shallow_copy()
        twin.x, twin.v = self.x.copy(), self.v.copy()
        twin.memory = {name: array.copy() for name, array in self.memory.items()}
        return twin

    #: `copy.copy` must not share `memory` with the original.
    __copy__ = copy

    def shallow_copy(self) -> State:
        """Return a copy that shares all arrays, those of its memory included.

        Code that moves a state replaces its arrays and never writes into them.
        """
        twin = object.__new__(State)
        twin.assign(self)
        return twin

    def assign(self, source: State) -> None:
        """Take over all fields of another state, sharing its arrays; `restore` copies them."""
        self.x, self.v = source.x, source.v
        self.frame, self.cloth, self.dropped_memory = source.frame, source.cloth, source.dropped_memory
        self.thickness, self.bodies = source.thickness, source.bodies
        self.memory = dict(source.memory)

    def restore_motion(self, start: State) -> None:
        """Take over positions, velocities, anchors, jaws and plastic lengths of another state, sharing its arrays."""
        self.x, self.v = start.x, start.v
        for name in (ANCHORS_KEY, JAWS_KEY, PLASTIC_LENGTHS_KEY):
            self.memory.pop(name, None)
            if name in start.memory:
                self.memory[name] = start.memory[name]

    def restore(self, source: State) -> None:
        """Copy positions, velocities, frame number and memory from another state into this one."""
        self.x = source.x.copy()
        self.v = source.v.copy()
        self.frame = source.frame
        self.memory = {name: array.copy() for name, array in source.memory.items()}

    def digest(self) -> str:
        """Return the xxh3-128 digest, 32 hexadecimal digits, of every array's name, type, shape and bytes."""
        import xxhash

        hashed, memory = xxhash.xxh3_128(), self.memory
        # Accepts arrays directly; before Python 3.12 no type describes that.
        update: Any = hashed.update
        update(_FRAME_HEADER + _pack_frame(self.frame))
        # The order of `arrays`, without building its dictionary: each recorded frame has a digest.
        for name, array in ((_POSITION, self.x), (_VELOCITY, self.v)):
            update(_array_header(name, array.dtype, array.shape))
            update(array if array.flags.c_contiguous else array.tobytes())
        for name in sorted(memory):
            array = memory[name]
            update(_memory_header(name, array.dtype, array.shape))
            update(array if array.flags.c_contiguous else array.tobytes())
        return str(hashed.hexdigest())

    def to_bytes(self) -> bytes:
        """Return the state as the bytes of an .npz file; the same state gives the same bytes."""
        buffer = io.BytesIO()
        arrays: dict[str, Any] = self.arrays()
        if self.cloth is not None:
            arrays[_CLOTH] = np.array(self.cloth, dtype=np.int64)
        if self.thickness is not None:
            arrays[_THICKNESS] = np.array(self.thickness)
        if self.bodies is not None:
            arrays |= {kind: np.array(names, dtype=np.str_) for kind, names in zip(_BODIES, self.bodies, strict=True)}
        # Without `allow_pickle`, which numpy 1.26 would store as one more array; no array contains objects.
        np.savez(buffer, **arrays)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> State:
        """Return the state of bytes from `to_bytes`; raise ValueError for invalid ones.

        Raises:
            ValueError: if the bytes are no state; the message names the array and the fault.
        """
        try:
            arrays = npz.read(data)
            for name in (_FRAME, _POSITION, _VELOCITY):
                if name not in arrays:
                    raise ValueError(f"array '{name}' is missing")
            frame, x, v = arrays.pop(_FRAME), arrays.pop(_POSITION), arrays.pop(_VELOCITY)
            _check_core(frame, x, v)
            cloth = _cloth(arrays.pop(_CLOTH, None), x.shape[1])
            thickness = _thickness(arrays.pop(_THICKNESS, None))
            bodies = _bodies([arrays.pop(kind, None) for kind in _BODIES])
            for name in arrays:
                if not name.startswith(_MEMORY):
                    raise ValueError(f"array '{name}' does not belong to a state")
            memory = {name.removeprefix(_MEMORY): array for name, array in arrays.items()}
            dropped_memory = tuple(name for name in LEGACY_KEYS if memory.pop(name, None) is not None)
            state_memory.check(memory, x.shape[1])
            state = cls(x.T, v.T, memory=memory, frame=int(frame), cloth=cloth)
            state.dropped_memory, state.thickness, state.bodies = dropped_memory, thickness, bodies
            return state
        except ValueError as error:
            raise ValueError(f"not a state file ({error}); one is written by ~/save_state") from error


def _numbers(name: str, values: ArrayLike) -> Array:
    """Convert values to a float64 array; ValueError for complex numbers, masked entries, and what is no number.

    Raises:
        ValueError: naming the array.
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind != "c" and not (isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values)):
            return np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} are {values!r:.80}; they must be numbers") from error
    fault = "complex" if array.dtype.kind == "c" else "masked"
    raise ValueError(f"{name} have {fault} entries; give real numbers")


def _check_memory(name: str, array: Any) -> None:
    """Raise ValueError for memory that is no float64, int64 or bool array, or not finite.

    Raises:
        ValueError: naming the array.
    """
    if not isinstance(array, np.ndarray) or array.dtype not in (np.float64, np.int64, np.bool_):
        kind = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"memory '{name}' is of type {kind}; it must be an array of float64, int64 or bool")
    if array.dtype == np.float64 and not np.isfinite(array).all():
        raise ValueError(f"memory '{name}' holds {array[~np.isfinite(array)][0]}; it must be finite")


def _check_core(frame: np.ndarray, x: np.ndarray, v: np.ndarray) -> None:
    """Raise ValueError for wrong type or shape of a file's frame number, positions or velocities; ignore entries."""
    if frame.dtype != np.int64 or frame.shape != ():
        raise ValueError(
            f"array '{_FRAME}' is of type {frame.dtype} and shape {frame.shape}; it must be a single int64"
        )
    if frame < 0:
        raise ValueError(f"array '{_FRAME}' is {int(frame)}; it must be at least 0")
    for name, array in ((_POSITION, x), (_VELOCITY, v)):
        if array.dtype != np.float64:
            raise ValueError(f"array '{name}' is of type {array.dtype}; it must be float64")
        if array.ndim != 2 or array.shape[0] != 3 or array.shape[1] == 0:
            raise ValueError(f"array '{name}' has shape {array.shape}; it must be (3, particle_count)")
    if v.shape != x.shape:
        raise ValueError(f"array '{_VELOCITY}' has shape {v.shape}; '{_POSITION}' has {x.shape}")


def _thickness(array: np.ndarray | None) -> float | None:
    if array is None:
        return None
    if array.dtype != np.float64 or array.shape != () or not 0.0 < array < np.inf:
        raise ValueError(f"array '{_THICKNESS}' is {array.tolist()}; it must be a single finite double above 0")
    return float(array)


def _bodies(arrays: list[np.ndarray | None]) -> tuple[tuple[str, ...], ...] | None:
    """Return the names of grippers and of obstacles in a file's arrays; None if it has none; refuse other arrays."""
    names = []
    for kind, array in zip(_BODIES, arrays, strict=True):
        if array is None:
            continue
        if array.dtype.kind != "U" or array.ndim != 1:
            raise ValueError(f"array '{kind}' is of type {array.dtype} and shape {array.shape}; it must be names")
        names.append(tuple(array.tolist()))
    return tuple(names) if len(names) == len(arrays) else None


def _cloth(array: np.ndarray | None, particle_count: int) -> tuple[int, int, int] | None:
    if array is None:
        return None
    if array.dtype != np.int64 or array.shape != (3,):
        raise ValueError(f"array '{_CLOTH}' is of type {array.dtype} and shape {array.shape}; it must be three int64")
    rows, columns, connections = (int(entry) for entry in array)
    if rows < 1 or columns < 1 or rows * columns != particle_count:
        raise ValueError(
            f"array '{_CLOTH}' has {rows} rows and {columns} columns; there are {particle_count} particles"
        )
    return rows, columns, connections


@functools.lru_cache(maxsize=1024)
def _array_header(name: str, kind: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return the digest's header of an array: name, type and shape."""
    return f"{name} {kind.str} {shape};".encode()


@functools.lru_cache(maxsize=1024)
def _memory_header(name: str, kind: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return the digest's header of an array of the memory: prefixed name, type and shape."""
    return _array_header(_MEMORY + name, kind, shape)


#: Digest of the frame number: header, and the number in an array's bytes.
_FRAME_HEADER, _pack_frame = _array_header(_FRAME, np.dtype(np.int64), ()), struct.Struct("=q").pack
