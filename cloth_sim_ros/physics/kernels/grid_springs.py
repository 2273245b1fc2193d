# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The springs of a regular sheet as data, and the padded tables that the row kernels read."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.grid_emit import BLOCK_BYTES
from cloth_sim_ros.physics.kernels.grid_rows import (
    FAMILIES,
    FIRST_WEIGHT_SLOT,
    FREE_SLOT,
    INVERSE_MASS_SLOT,
    TABLE_SLOTS,
    VALUE_COUNT,
    Shape,
    value_index,
)

Array = NDArray[np.float64]


class GridFamily(NamedTuple):
    """All springs of a sheet that point the same way.

    `name`: a key of `grid_rows.FAMILIES`; rows are counted downwards, columns to the right. `stiffness` k_s [N],
    force per strain; `rest_length` [m]; `damping` k_d [N s/m]. `border`: factor on k_s and k_d of the threads that
    run along the sheet's border. `parity`: 0 or 1 keeps only springs in cells of which row + column is even or odd,
    None keeps all. `weak`: may be evaluated every second step.
    """

    name: str
    stiffness: float
    rest_length: float
    damping: float = 0.0
    border: float = 1.0
    parity: int | None = None
    weak: bool = False


class GridSprings:
    """The spring families of a sheet of `rows` times `columns` particles, numbered row-major.

    Raises:
        ValueError: for a sheet without particles, an unknown or repeated family, or a property out of range.
    """

    def __init__(self, rows: int, columns: int, families: Sequence[GridFamily]) -> None:
        if rows < 1 or columns < 1:
            raise ValueError(f"a sheet of {rows} x {columns} particles; it needs at least 1 x 1")
        names = [family.name for family in families]
        for family in families:
            if family.name not in FAMILIES:
                raise ValueError(f"no spring family '{family.name}'; there are {', '.join(FAMILIES)}")
            if names.count(family.name) > 1:
                raise ValueError(f"family '{family.name}' is given {names.count(family.name)} times; give it once")
            if not (np.isfinite(family.rest_length) and family.rest_length > 0.0):
                raise ValueError(
                    f"rest length of '{family.name}' is {family.rest_length} m; it must be finite and above 0"
                )
            for what in ("stiffness", "damping", "border"):
                value = getattr(family, what)
                if not (np.isfinite(value) and value >= 0.0):
                    raise ValueError(f"{what} of '{family.name}' is {value}; it must be finite and not negative")
            if family.parity not in (None, 0, 1):
                raise ValueError(f"parity of '{family.name}' is {family.parity}; it must be 0, 1 or None")
        self.rows, self.columns = rows, columns
        # A fixed order fixes the order of the sums, whatever order the scene lists the families in.
        self.families = tuple(sorted(families, key=lambda family: list(FAMILIES).index(family.name)))

    @property
    def damped(self) -> bool:
        """Whether any spring is damped."""
        return any(family.damping > 0.0 for family in self.families)

    def spring_count(self) -> int:
        """Number of springs."""
        return sum(int(np.count_nonzero(self.weights(f, row))) for f in self.families for row in range(self.rows))

    def weights(self, family: GridFamily, row: int) -> Array:
        """Factors on k_s and k_d of the family's springs whose leftmost end is in each column, their upper end in
        `row`.

        Zero where the sheet has no such spring. Shape (columns,).
        """
        ends = FAMILIES[family.name]
        down = max(ends.first[0], ends.second[0])
        right = max(ends.first[1], ends.second[1])
        weights = np.zeros(self.columns)
        if row + down < self.rows:
            weights[: max(self.columns - right, 0)] = 1.0
        if family.parity is not None:
            weights[(row + np.arange(self.columns)) % 2 != family.parity] = 0.0
        if down == 0 and row in (0, self.rows - 1):
            weights *= family.border
        if right == 0:
            weights[[0, -1]] *= family.border
        return weights


class GridTables(NamedTuple):
    """What the row kernels read beside the particles: see `grid_rows`.

    `pitch`: numbers in a padded row. `table`: flat; `table_rows`: where each row's entry starts, shape (rows,). Rows
    with equal entries share one.
    """

    pitch: int
    table: NDArray[Any]
    table_rows: NDArray[np.intp]


def padded_columns(columns: int, dtype: Any) -> int:
    """Length of a padded row: `columns` rounded up to whole blocks."""
    lanes = BLOCK_BYTES // np.dtype(dtype).itemsize
    return -(-columns // lanes) * lanes


def aligned_zeros(size: int, dtype: Any) -> NDArray[Any]:
    """A flat array of zeros that starts on a block, with a block of zeros to spare behind its end."""
    kind = np.dtype(dtype)
    raw = np.zeros((size + 2 * (BLOCK_BYTES // kind.itemsize)) * kind.itemsize, dtype=np.uint8)
    start = -raw.ctypes.data % BLOCK_BYTES
    return raw[start : start + size * kind.itemsize].view(kind)


_DOUBLE = np.dtype(np.float64)


def check_array(name: str, array: Array, shape: tuple[int, ...]) -> None:
    """Refuse what a kernel would misread.

    Raises:
        ValueError: for another shape or type, or an array that is not C-contiguous.
    """
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; this sheet needs {shape}")
    # Asked first what is quickly told.
    if (array.dtype is not _DOUBLE and array.dtype != _DOUBLE) or not array.flags.c_contiguous:
        layout = "" if array.flags.c_contiguous else ", not C-contiguous"
        raise ValueError(f"{name} is {array.dtype}{layout}; it must be C-contiguous float64")


def grid_tables(springs: GridSprings, inverse_masses: Array, dtype: Any) -> GridTables:
    """Build the tables of a sheet; `inverse_masses` [1/kg], shape (rows * columns,), zero for anchored particles."""
    pitch = padded_columns(springs.columns, dtype)
    starts: dict[tuple[int, bytes], int] = {}
    table_rows = np.empty(springs.rows, dtype=np.intp)
    entries: list[NDArray[Any]] = []
    weights: dict[int, list[Array]] = {}
    slots = [FIRST_WEIGHT_SLOT + list(FAMILIES).index(family.name) for family in springs.families]
    parity = any(family.parity is not None for family in springs.families)
    for row in range(springs.rows):
        inverse = inverse_masses[row * springs.columns : (row + 1) * springs.columns]
        # Springs reach two rows down at most; in between rows differ by parity alone.
        alike = row if row == 0 or row + 2 >= springs.rows else 1 + ((row + 1) % 2 if parity else 0)
        if alike not in weights:
            weights[alike] = [springs.weights(family, alike) for family in springs.families]
        key = alike, inverse.tobytes()
        if key not in starts:
            entry = np.zeros((TABLE_SLOTS, pitch), dtype=dtype)
            entry[INVERSE_MASS_SLOT, : springs.columns] = inverse
            entry[FREE_SLOT, : springs.columns] = inverse > 0.0
            for slot, weight in zip(slots, weights[alike], strict=True):
                entry[slot, : springs.columns] = weight
            starts[key] = len(entries) * TABLE_SLOTS * pitch
            entries.append(entry)
        table_rows[row] = starts[key]
    table = aligned_zeros(len(entries) * TABLE_SLOTS * pitch, dtype)
    table[:] = np.concatenate(entries).ravel()
    return GridTables(pitch, table, table_rows)


@cache
def _stamp() -> tuple[int | None, ...]:
    """Sixteen bits of a digest of the sources that others are compiled from, as a type.

    Numba's disk cache looks at the file of the compiled function alone, not at those of the emitters that it calls.
    This keeps it from serving kernels that older emitters made.
    """
    from cloth_sim_ros.physics.kernels import grid_copy, grid_emit, grid_load, grid_row_bounds, grid_rows, grid_sync
    from cloth_sim_ros.physics.kernels import held_points as held

    modules = (grid_copy, grid_emit, grid_load, grid_row_bounds, grid_rows, grid_sync, held)
    sources = b"".join(Path(str(module.__file__)).read_bytes() for module in modules)
    number = int.from_bytes(hashlib.blake2b(sources, digest_size=2).digest())
    return tuple(1 if number >> bit & 1 else None for bit in range(16))


class Constants(NamedTuple):
    """`shape`: what a step consists of, see `grid_rows`. `values`: its constants. Tuples of None and numbers stand for
    the options because numba's names of kernels for records do not survive its disk cache: two processes give them in
    different order.
    """

    shape: Shape
    values: NDArray[Any]


def constants(
    springs: GridSprings,
    factors: dict[bool, float],
    dtype: Any,
    *,
    step: float = 0.0,
    drag: float = 0.0,
    gravity: Array | None = None,
    predicted: bool = False,
) -> Constants:
    """Constants of a step of `step` [s] with the families whose `weak` is a key of `factors`, multiplied by its value.

    `drag` [1/s], 0 for none; `gravity` [m/s^2], shape (3,); `predicted`: whether forces depend on velocity.
    """
    values = np.zeros(VALUE_COUNT, dtype=dtype)
    present: dict[str, int | float | None] = dict.fromkeys(FAMILIES)
    for family in springs.families:
        if family.weak in factors:
            factor = factors[family.weak]
            present[family.name] = 1.0 if family.damping > 0.0 else 1
            values[value_index(family.name, "k")] = factor * family.stiffness
            values[value_index(family.name, "l")] = factor * family.stiffness / family.rest_length
            values[value_index(family.name, "d")] = factor * family.damping
    values[value_index("step")] = step
    values[value_index("half")] = 0.5 * step
    values[value_index("quarter")] = 0.25 * step
    values[value_index("drag")] = drag
    if gravity is not None:
        values[value_index("gravity_0") : value_index("gravity_2") + 1] = gravity
    shape = Shape(
        **present,
        drag=1 if drag > 0.0 else None,
        gravity=None if gravity is None else 1,
        predicted=1 if predicted else None,
        carry=1 if np.dtype(dtype) == np.float32 else None,
        stamp=_stamp(),
    )
    return Constants(shape, values)
