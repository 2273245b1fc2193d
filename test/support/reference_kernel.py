# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bar for the engine: the same spring forces in hand-vectorised C, built in the run where a compiler exists."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import FAMILIES, float64_address
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.grid_springs import FAMILY_ENDS, GridSprings
from cloth_sim_ros.physics.model.parts import GridFamily

FLAGS = ("-O3", "-march=native", "-ffast-math", "-std=c11", "-fPIC")
"""Flags of the compiler, those of the measurements that the engine is held against."""

_SOURCE = Path(__file__).with_name("reference_kernel.c")
_BLOCK_BYTES = 64


def find_compiler() -> str | None:
    """Path of the C compiler: $CC, else cc, gcc or clang; None without one."""
    for name in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        if name and (path := shutil.which(name)):
            return path
    return None


class ReferenceKernel:
    """Spring forces of a sheet with all six families, computed by C.

    Args:
        springs: the sheet.
        dtype: float32 or float64.
        compiler: path of a C compiler that takes gcc's flags and vector extensions.

    Raises:
        ValueError: if the sheet has not all six families.
        RuntimeError: if the compiler fails, with what it said.
    """

    def __init__(self, springs: GridSprings, dtype: Any, *, compiler: str) -> None:
        missing = set(FAMILIES) - {family.name for family in springs.families}
        if missing:
            raise ValueError(
                f"the sheet has no springs {', '.join(sorted(missing))}; the C kernel computes all six families"
            )
        self.springs = springs
        self._dtype = np.dtype(dtype)
        self._function = _build(compiler, self._dtype)
        lanes = _BLOCK_BYTES // self._dtype.itemsize
        self._pitch = -(-springs.columns // lanes) * lanes
        self._size = (springs.rows + 2) * self._pitch + 2 * lanes
        self._x, self._v, self._f = (_zeros(3 * self._size, dtype) for _ in range(3))
        self._weights = _zeros(len(FAMILIES) * springs.rows * self._pitch, dtype)
        self._constants = np.zeros(3 * len(FAMILIES), dtype=dtype)
        self._buffer = _zeros(3 * self._pitch, dtype)
        self._set_constants()

    def _set_constants(self) -> None:
        weights = self._weights.reshape(len(FAMILIES), self.springs.rows, self._pitch)
        for family in self.springs.families:
            family_index = FAMILIES.index(family.name)
            for row in range(self.springs.rows):
                # Here the antidiagonal belongs to its upper end, one column to the right.
                shift = 1 if family.name == "antidiagonal" else 0
                weights[family_index, row, : self.springs.columns] = np.roll(_weights(self.springs, family, row), shift)
            constants = family.stiffness, family.stiffness / family.rest_length, family.damping
            self._constants[3 * family_index : 3 * family_index + 3] = constants

    def set_state(self, x: Array, v: Array) -> None:
        """Copy in positions [m] and velocities [m/s], both (3, rows * columns) float64."""
        rows, columns = self.springs.rows, self.springs.columns
        for name, array, target in (("x", x, self._x), ("v", v, self._v)):
            float64_address(name, array, (3, rows * columns))
            for c in range(3):
                padded = target[c * self._size : c * self._size + rows * self._pitch].reshape(rows, self._pitch)
                padded[:, :columns] = array[c].reshape(rows, columns)

    def evaluate(self, repeats: int) -> None:
        """Compute the forces `repeats` times, in one call."""
        arrays = (self._x, self._v, self._weights, self._constants, self._buffer, self._f)
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
        self._function(self.springs.rows, self._pitch, repeats, *pointers)

    def forces(self) -> Array:
        """Forces [N] of the last evaluation, (3, rows * columns) float64."""
        rows, columns = self.springs.rows, self.springs.columns
        padded: NDArray[Any] = self._f.reshape(3, self._size)[:, : rows * self._pitch].reshape(3, rows, self._pitch)
        return padded[:, :, :columns].reshape(3, -1).astype(np.float64)


def _weights(springs: GridSprings, family: GridFamily, row: int) -> Array:
    """Factors on k_s and k_d of the family's springs whose leftmost end is in each column, their upper end in `row`.

    Zero where the sheet has no such spring. Shape (columns,).
    """
    first, second = FAMILY_ENDS[family.name]
    down, right = max(first[0], second[0]), max(first[1], second[1])
    weights = np.zeros(springs.columns)
    if row + down < springs.rows:
        weights[: max(springs.columns - right, 0)] = 1.0
    if family.parity is not None:
        weights[(row + np.arange(springs.columns)) % 2 != family.parity] = 0.0
    if down == 0 and row in (0, springs.rows - 1):
        weights *= family.border
    if right == 0:
        weights[[0, -1]] *= family.border
    return weights


def _zeros(size: int, dtype: Any) -> NDArray[Any]:
    """A flat array of zeros that starts on a block, with a block of zeros to spare behind its end."""
    kind = np.dtype(dtype)
    raw = np.zeros(size * kind.itemsize + 2 * _BLOCK_BYTES, dtype=np.uint8)
    start = -raw.ctypes.data % _BLOCK_BYTES
    return raw[start : start + size * kind.itemsize].view(kind)


def _build(compiler: str, dtype: np.dtype[Any]) -> Any:
    real = {4: "float", 8: "double"}[dtype.itemsize]
    function = compiled(_SOURCE, [*FLAGS, f"-DREAL={real}"], compiler=compiler).family_forces
    function.argtypes = [ctypes.c_ssize_t] * 3 + [ctypes.c_void_p] * 6
    function.restype = None
    return function


def compiled(source: Path, flags: Sequence[str], *, compiler: str) -> ctypes.CDLL:
    """Compile a C file and load it.

    Raises:
        RuntimeError: if the compiler fails, with what it said.
    """
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, f"{source.stem}.so")
        unit = Path(folder, f"{source.stem}.o")
        # Linked apart, without -ffast-math: with it gcc links a start-up file that makes the whole process flush
        # subnormal numbers to zero, other kernels and the tests included.
        for command in (
            [compiler, *flags, "-c", str(source), "-o", str(unit)],
            [compiler, "-shared", str(unit), "-o", str(library), "-lm"],
        ):
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode != 0:
                raise RuntimeError(f"{' '.join(command)} failed with status {result.returncode}:\n{result.stderr}")
        # Once mapped, the file itself is no longer needed.
        return ctypes.CDLL(str(library))
