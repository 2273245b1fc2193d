# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Symmetric band matrices of 3x3 blocks, an order that keeps them narrow, and sums in a fixed order (core/band.hpp).

A matrix is an array made by `zeros`. Block row I holds the blocks J = I ... I + width of the upper half.
The entry (3 I + r, 3 J + c) is ``rows[I, r, 3 (J - I) + c]``. The padding stays zero.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import library

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FLOAT, _INDEX = np.dtype(np.float64), np.dtype(np.int64)

#: Status of a call.
_OK, _NOT_POSITIVE, _NO_MEMORY, _CHOSEN, _PAIRS, _PLACES = range(6)
#: Arguments of its functions: p is an array, i a number.
_FUNCTIONS = {
    "cloth_band_assemble": "piipippiipi",
    "cloth_band_assemble_diagonal": "piipipp",
    "cloth_band_factor": "piii",
    "cloth_band_forward": "piiip",
    "cloth_band_backward": "piiip",
    "cloth_band_join": "pipiiiipii",
    "cloth_cuthill_mckee": "ipip",
    "cloth_sum": "pip",
}


def zeros(count: int, width: int) -> Array:
    """Return a zero symmetric band matrix: ``count`` rows of 3x3 blocks, each with ``width`` blocks above the diagonal.

    Raises:
        ValueError: if one of them is negative.
    """
    for name, value in (("count", count), ("width", width)):
        if value < 0:
            raise ValueError(f"{name} is {value}: a band matrix has no fewer than 0 of them")
    return np.zeros((count, 3, 3 * (width + 1) + _padding()))


def assemble(rows: Array, places: Index, pairs: Index, blocks: Array, chosen: Index) -> None:
    """Add 3x3 blocks B of chosen pairs to the matrix ``rows``: sym(B) to both diagonal blocks, -B to the pair's block.

    Args:
        rows: the matrix.
        places: block row of each particle, negative for those that do not move, shape (n,).
        pairs: particles of each pair, shape (m, 2).
        blocks: xx, yy, zz, xy, xz, yz of each pair, shape (m, 6); or all entries by rows, shape (m, 9).
        chosen: indices of pairs.

    Raises:
        ValueError: if an argument does not fit the others. Pairs before the wrong one have then been added.
    """
    listed = _address("pairs", pairs, _INDEX, (None, 2))
    m, numbers = len(pairs), 9 if getattr(blocks, "shape", ())[1:] == (9,) else 6
    status = _function("cloth_band_assemble")(
        *_matrix("rows", rows),
        _address("places", places, _INDEX, (None,)),
        len(places),
        listed,
        _address("blocks", blocks, _FLOAT, (m, numbers)),
        numbers,
        m,
        _address("chosen", chosen, _INDEX, (None,)),
        len(chosen),
    )
    if status == _CHOSEN:
        raise ValueError(f"chosen has {_outside(chosen, m)}: there are {m} pairs, counted from 0")
    if status == _PAIRS:
        wrong = _outside(pairs[chosen], len(places))
        raise ValueError(f"pairs have particle {wrong}: places has {len(places)} particles, counted from 0")
    if status == _PLACES:
        _refuse_places(places, len(rows))
        raise ValueError(
            "places of two particles of a pair are equal, or further apart than rows has blocks: choose pairs within"
            " the band"
        )


def assemble_diagonal(rows: Array, places: Index, masses: Array, blocks: Array) -> None:
    """Add masses (n,) and blocks (6, n: xx, yy, zz, xy, xz, yz) to diagonal blocks at ``places`` (n,), unless negative.

    Raises:
        ValueError: if an argument does not fit the others.
    """
    status = _function("cloth_band_assemble_diagonal")(
        *_matrix("rows", rows),
        _address("places", places, _INDEX, (None,)),
        len(places),
        _address("masses", masses, _FLOAT, places.shape),
        _address("blocks", blocks, _FLOAT, (6, len(places))),
    )
    if status == _PLACES:
        _refuse_places(places, len(rows))


def factor(rows: Array, inner: int) -> bool:
    """Eliminate the first ``inner`` block rows in place by Cholesky; false, half done, if not positive definite.

    They are replaced by their rows of the Cholesky factor U (A = U'U), diagonals inverted; the others by their Schur
    complement. With all block rows that is the whole factorisation.

    Raises:
        ValueError: if an argument does not fit the others.
    """
    matrix = _matrix("rows", rows)
    _check_inner("inner", inner, len(rows))
    return bool(_function("cloth_band_factor")(*matrix, inner) == _OK)


def forward(rows: Array, inner: int, y: Array) -> None:
    """Substitute forward in y (block rows, 3), in place, by rows from `factor`: eliminate the first ``inner`` unknowns.

    Raises:
        ValueError: if an argument does not fit the others.
    """
    _substitute("cloth_band_forward", rows, inner, y)


def backward(rows: Array, inner: int, y: Array) -> None:
    """Substitute backward in y (block rows, 3), in place: solve its first ``inner`` unknowns by rows from `factor`.

    The other unknowns of y are solved already, and stay.

    Raises:
        ValueError: if an argument does not fit the others.
    """
    _substitute("cloth_band_backward", rows, inner, y)


def join(upper: Array, lower: Array, inner_upper: int, inner_lower: int, middle: Array) -> None:
    """Set ``middle`` to the sum of the Schur complements that `factor` left in ``upper`` and, reversed, ``lower``.

    Raises:
        ValueError: if an argument does not fit the others.
    """
    first, count_upper, width = _matrix("upper", upper)
    second, count_lower, width_lower = _matrix("lower", lower)
    third, shared, wide = _matrix("middle", middle)
    if width_lower != width:
        raise ValueError(f"lower has {width_lower} blocks beside the diagonal, upper {width}: make them equal")
    if shared > width + 1 or shared > wide + 1:
        raise ValueError(
            f"middle has {shared} block rows, with {wide} blocks beside the diagonal: upper has {width}, and the whole"
            f" of a Schur complement has to fit in both"
        )
    for name, count, inner in (("inner_upper", count_upper, inner_upper), ("inner_lower", count_lower, inner_lower)):
        _check_inner(name, inner, count)
        if count - inner != shared:
            raise ValueError(f"{name} is {inner} of {count} block rows: {shared} are to be left, those of middle")
    ends = (first, count_upper, second, count_lower, width, inner_upper, inner_lower)
    _function("cloth_band_join")(*ends, third, shared, wide)


def cuthill_mckee(count: int, pairs: Index) -> Index:
    """Return particles 0 ... count - 1 in reverse Cuthill-McKee order, which brings pairs together, shape (count,).

    Cuthill and McKee's, reversed, from the best of a few starts; it depends on the set of pairs alone.

    Args:
        count: number of particles.
        pairs: particles of each pair, shape (m, 2); any order, repeated ones too.

    Raises:
        ValueError: if the count is negative, or a particle is not there.
        MemoryError: if there is not enough memory.
    """
    if count < 0:
        raise ValueError(f"count is {count}: there are no fewer than 0 particles")
    address, order = _address("pairs", pairs, _INDEX, (None, 2)), np.empty(count, dtype=np.int64)
    output = _address("order", order, _INDEX, (count,), written=True)
    status = _function("cloth_cuthill_mckee")(count, address, len(pairs), output)
    if status == _PAIRS:
        raise ValueError(f"pairs have particle {_outside(pairs, count)}: there are {count}, counted from 0")
    if status == _NO_MEMORY:
        raise MemoryError(f"not enough memory to order {count} particles with {len(pairs)} pairs")
    return order


def fixed_sum(values: Array) -> float:
    """Return the sum of a contiguous float64 array, in an order that depends on its size alone: equal bits everywhere.

    Raises:
        ValueError: if it is not a contiguous array of float64.
    """
    address, total = _address("values", values, _FLOAT, (None,) * np.ndim(values)), ctypes.c_double()
    _function("cloth_sum")(address, values.size, ctypes.addressof(total))
    return total.value


def _substitute(name: str, rows: Array, inner: int, y: Array) -> None:
    matrix = _matrix("rows", rows)
    _check_inner("inner", inner, len(rows))
    _function(name)(*matrix, inner, _address("y", y, _FLOAT, (len(rows), 3), written=True))


@cache
def _function(name: str) -> Any:
    function = library()[name]
    kinds: dict[str, Any] = {"p": ctypes.c_void_p, "i": ctypes.c_int64}
    function.argtypes, function.restype = [kinds[kind] for kind in _FUNCTIONS[name]], ctypes.c_int
    return function


@cache
def _padding() -> int:
    """Return the number of padding float64 at the end of each row of a matrix."""
    stride = library()["cloth_band_stride"]
    stride.argtypes, stride.restype = [ctypes.c_int64], ctypes.c_int64
    return int(stride(0)) - 3


def _matrix(name: str, rows: Array) -> tuple[int, int, int]:
    """Return address, number of block rows, and blocks above the diagonal of a band matrix; ValueError for others."""
    address = _address(name, rows, _FLOAT, (None, 3, None), written=True)
    blocks, remainder = divmod(rows.shape[2] - _padding(), 3)
    if remainder or blocks < 1:
        raise ValueError(f"{name} has rows of {rows.shape[2]} numbers: make it with band.zeros()")
    return address, len(rows), blocks - 1


def _address(
    name: str, array: Any, kind: np.dtype[Any], shape: tuple[int | None, ...], *, written: bool = False
) -> int:
    """Return an array's address; ValueError for another type, shape (None: any size) or memory layout than expected."""
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name} is a {type(array).__name__}: it has to be an array of {kind}")
    sizes = array.shape
    if array.dtype != kind or len(sizes) != len(shape) or any(map(_differ, shape, sizes)):
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(
            f"{name} is an array of {array.dtype}, shape {sizes}: it has to be one of {kind}, shape ({expected})"
        )
    flags = array.flags
    if not (flags.carray or (flags.c_contiguous and flags.aligned and not written)):
        raise ValueError(f"{name} is not contiguous, aligned and, as an output, writeable: make a copy of it")
    return int(array.__array_interface__["data"][0])


def _differ(expected: int | None, size: int) -> bool:
    return expected is not None and expected != size


def _check_inner(name: str, inner: int, count: int) -> None:
    if not 0 <= inner <= count:
        raise ValueError(f"{name} is {inner}: it has to be from 0 to the number of block rows, {count}")


def _outside(indices: Index, count: int) -> int:
    return int(indices[(indices < 0) | (indices >= count)].flat[0])


def _refuse_places(places: Index, count: int) -> None:
    if places.max(initial=-1) >= count:
        raise ValueError(f"places has block row {places.max()}: the matrix has {count}, counted from 0")
