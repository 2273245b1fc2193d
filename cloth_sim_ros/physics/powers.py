# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Powers, roots and sums by arithmetic alone: a library's pow differs in the last bit from machine to machine, and
Python's sum from version to version.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import reduce
from operator import add

import numpy as np


def power(base: float, exponent: int) -> float:
    """Return base to a whole exponent of at least 0, by as many multiplications."""
    product = 1.0
    for _ in range(exponent):
        product *= base
    return product


def in_order(numbers: Iterable[float], start: float = 0.0) -> float:
    """Return the sum of numbers, each added to what those before came to.

    The built-in ``sum`` of floats carries rounding errors along from Python 3.12 on, so that its bits depend on the
    version.
    """
    return reduce(add, numbers, start)


def whole_sum(numbers: Iterable[int]) -> int:
    """Return the sum of whole numbers, exact at any size."""
    return reduce(add, numbers, 0)


def in_rows(rows: np.ndarray) -> np.ndarray:
    """Return the sum of the rows of an array, each added to what those before came to: numpy's own sum of many rows
    goes pairwise, in blocks that depend on its version.
    """
    return reduce(add, rows, np.zeros(rows.shape[1:]))


def scalar_products(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return the products of vectors (..., 3) with others, (...): x x + y y + z z, added in that order."""
    first, second, third = (one[..., k] * two[..., k] for k in range(3))
    return np.asarray(first + second + third)


def root(value: float, degree: int) -> float:
    """Return the root of a value of at least 0, to a few roundings; infinity stays.

    Newton's iteration from above falls until rounding stops it.

    Args:
        value: what to take the root of.
        degree: of the root, at least 1.
    """
    if degree == 1 or value in (0.0, math.inf):
        return value
    if degree == 2:
        return math.sqrt(value)
    # Taken apart, so that no power overflows: value = scaled 2^(degree whole), scaled from 1/2 to below 2^degree.
    mantissa, exponent = math.frexp(value)
    whole, rest = divmod(exponent, degree)
    scaled, guess = math.ldexp(mantissa, rest), 2.0
    while True:
        better = guess - (guess - scaled / power(guess, degree - 1)) / degree
        if not better < guess:
            return math.ldexp(guess, whole)
        guess = better
