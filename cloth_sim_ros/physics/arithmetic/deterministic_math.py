# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Deterministic powers, roots, sums, exponentials and logarithms.

They use basic arithmetic alone: a library's pow differs between machines, and Python's sum between versions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import reduce
from operator import add

import numpy as np

_LOGARITHM_OF_TWO = 0.6931471805599453


def power(base: float, exponent: int) -> float:
    """Return base to a whole exponent of at least 0, by repeated multiplication."""
    product = 1.0
    for _ in range(exponent):
        product *= base
    return product


def ordered_sum(numbers: Iterable[float], start: float = 0.0) -> float:
    """Return the sum of a start value and numbers, added one after the other.

    The built-in ``sum`` of floats compensates rounding errors from Python 3.12 on. Its bits depend on the version.
    """
    return reduce(add, numbers, start)


def integer_sum(numbers: Iterable[int]) -> int:
    """Return the exact sum of whole numbers of any size."""
    return reduce(add, numbers, 0)


def row_sum(rows: np.ndarray) -> np.ndarray:
    """Return the sum of an array over its first axis, added row after row; zeros without rows.

    numpy's own sum of many rows is pairwise, in blocks that depend on its version.
    """
    return reduce(add, rows, np.zeros(rows.shape[1:]))


def dot_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products of vectors (..., 3) with others: x x + y y + z z, added in that order, shape (...)."""
    first, second, third = (a[..., k] * b[..., k] for k in range(3))
    return np.asarray(first + second + third)


def root(value: float, degree: int) -> float:
    """Return the `degree`-th root of a number of at least 0, accurate to a few roundings; infinity stays.

    Newton's iteration from above decreases until rounding stops it.

    Args:
        value: the number, at least 0.
        degree: degree of the root, at least 1.
    """
    if degree == 1 or value in (0.0, math.inf):
        return value
    if degree == 2:
        return math.sqrt(value)
    # Split, so that no power overflows: value = scaled 2^(degree quotient), scaled from 1/2 to below 2^degree.
    mantissa, exponent = math.frexp(value)
    quotient, remainder = divmod(exponent, degree)
    scaled, guess = math.ldexp(mantissa, remainder), 2.0
    while True:
        next_guess = guess - (guess - scaled / power(guess, degree - 1)) / degree
        if not next_guess < guess:
            return math.ldexp(guess, quotient)
        guess = next_guess


def exponential(value: float) -> float:
    """Return e to a power of at most 700, accurate to a few hundred roundings.

    Taylor's series of a small fraction of the power, squared as often as it was halved.
    """
    halvings = 0
    while abs(value) > 0.5:
        value, halvings = 0.5 * value, halvings + 1
    total = term = 1.0
    for k in range(1, 18):
        term *= value / k
        total += term
    for _ in range(halvings):
        total *= total
    return total


def logarithm(value: float) -> float:
    """Return the natural logarithm of a positive number, accurate to a few roundings.

    The series 2 artanh(y) with y = (m - 1) / (m + 1), for a mantissa m from 2/3 to 4/3.
    """
    mantissa, exponent = math.frexp(value)
    if 3.0 * mantissa < 2.0:
        mantissa, exponent = 2.0 * mantissa, exponent - 1
    y = (mantissa - 1.0) / (mantissa + 1.0)
    total, term = 0.0, y
    for k in range(1, 24, 2):
        total += term / k
        term *= y * y
    return 2.0 * total + exponent * _LOGARITHM_OF_TWO
