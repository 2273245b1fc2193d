# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bar for the compiled kernels: the same spring forces in hand-vectorised C, built in the run where a compiler
exists.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.grid_rows import FAMILIES
from cloth_sim_ros.physics.kernels.grid_springs import Array, GridSprings, aligned_zeros, check_array, padded_columns

FLAGS = ("-O3", "-march=native", "-ffast-math", "-std=c11", "-fPIC")
"""Flags of the compiler, those of the measurements that the kernels are held against."""

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
        self._pitch = padded_columns(springs.columns, dtype)
        self._size = (springs.rows + 2) * self._pitch + 2 * (_BLOCK_BYTES // self._dtype.itemsize)
        self._x, self._v, self._f = (aligned_zeros(3 * self._size, dtype) for _ in range(3))
        self._weights = aligned_zeros(len(FAMILIES) * springs.rows * self._pitch, dtype)
        self._constants = np.zeros(3 * len(FAMILIES), dtype=dtype)
        self._buffer = aligned_zeros(3 * self._pitch, dtype)
        self._set_constants()

    def _set_constants(self) -> None:
        weights = self._weights.reshape(len(FAMILIES), self.springs.rows, self._pitch)
        for family in self.springs.families:
            place = list(FAMILIES).index(family.name)
            for row in range(self.springs.rows):
                # Here the antidiagonal belongs to its upper end, one column to the right.
                shift = 1 if family.name == "antidiagonal" else 0
                weights[place, row, : self.springs.columns] = np.roll(self.springs.weights(family, row), shift)
            constants = family.stiffness, family.stiffness / family.rest_length, family.damping
            self._constants[3 * place : 3 * place + 3] = constants

    def set_state(self, x: Array, v: Array) -> None:
        """Copy in positions [m] and velocities [m/s], both (3, rows * columns) float64."""
        rows, columns = self.springs.rows, self.springs.columns
        for name, array, target in (("x", x, self._x), ("v", v, self._v)):
            check_array(name, array, (3, rows * columns))
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


def _build(compiler: str, dtype: np.dtype[Any]) -> Any:
    real = {4: "float", 8: "double"}[dtype.itemsize]
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, "reference_kernel.so")
        compiled = Path(folder, "reference_kernel.o")
        # Linked apart, without -ffast-math: with it gcc links a start-up file that makes the whole process flush
        # subnormal numbers to zero, other kernels and the tests included.
        for command in (
            [compiler, *FLAGS, f"-DREAL={real}", "-c", str(_SOURCE), "-o", str(compiled)],
            [compiler, "-shared", str(compiled), "-o", str(library), "-lm"],
        ):
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode != 0:
                raise RuntimeError(f"{' '.join(command)} failed with status {result.returncode}:\n{result.stderr}")
        # Once mapped, the file itself is no longer needed.
        function = ctypes.CDLL(str(library)).family_forces
    function.argtypes = [ctypes.c_ssize_t] * 3 + [ctypes.c_void_p] * 6
    function.restype = None
    return function
