# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights of recordings, and information that short waves of the cloth do not distort, from two sets of slopes."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array

#: Eigenvalue of the information below which a direction is unknown, relative to the largest.
_MIN_EIGENVALUE = 1e-6
#: Least share of the information that is not of short waves, in any direction of the unknowns.
_MIN_SHARE = 0.1
#: Degrees of freedom of the recordings' distribution.
_MOTION_FREEDOM = 4.0


def smooth_shares(products: Array, squares: Array) -> Array:
    """Return the share of each recording's information that is not of short waves, from 0 to 1, shape (recordings,).

    Weights of this size give the smallest variance: short waves add to the variance of a gradient, but not to the
    information. docs/derivations/fit_motions.md derives them.

    Args:
        products: information by products of two sets of slopes, shape (recordings, p, p).
        squares: information by the square of the mean of both sets, likewise.
    """
    inverse = np.linalg.pinv(squares.sum(axis=0), hermitian=True)
    total = np.einsum("ij,kij->k", inverse, squares)
    smooth = np.einsum("ij,kij->k", inverse, products)
    return np.clip(smooth / np.maximum(total, np.finfo(float).tiny), 0.0, 1.0)


def motion_weights(information: Array, gradient: Array) -> Array:
    """Return the weights of recordings under a multivariate Student distribution of their gradients, (recordings,).

    An unpredictable motion gets a small weight. The square of a gradient at the minimum lacks what its recording
    contributes to the minimum, therefore this part is added.

    Args:
        information: information of each recording, shape (recordings, unknowns, unknowns).
        gradient: gradient of each recording, shape (recordings, unknowns).
    """
    inverse = np.linalg.pinv(information.sum(axis=0), hermitian=True)
    weights = np.ones(len(information))
    for k, (matrix, vector) in enumerate(zip(information, gradient, strict=True)):
        values, vectors = np.linalg.eigh(matrix)
        known = values > _MIN_EIGENVALUE * max(float(values[-1]), np.finfo(float).tiny)
        square = float((np.square(vectors.T @ vector)[known] / values[known]).sum())
        # Products of two sets of slopes may be negative where their short waves exceed the rest.
        square += max(float(np.einsum("ij,ij", inverse, matrix)), 0.0)
        weights[k] = (_MOTION_FREEDOM + known.sum()) / (_MOTION_FREEDOM + square)
    return weights


def missing_information(product: Array, square: Array, p: int) -> Array:
    """Return the information to add to the product of two sets of slopes to reach a tenth of their square, (p, p).

    Args:
        product: information by the products and by the prior, shape (unknowns, unknowns).
        square: information by the square of the mean of both sets and by the prior, likewise.
        p: number of parameters; the other unknowns are eliminated.
    """
    reduced = [m[:p, :p] - m[:p, p:] @ np.linalg.solve(m[p:, p:], m[p:, :p]) for m in (product, square)]
    factor = np.linalg.cholesky(reduced[1])
    inverse = np.linalg.inv(factor)
    shares, directions = np.linalg.eigh(inverse @ reduced[0] @ inverse.T)
    lifted = factor @ directions
    return np.asarray((lifted * np.maximum(_MIN_SHARE - shares, 0.0)) @ lifted.T)
