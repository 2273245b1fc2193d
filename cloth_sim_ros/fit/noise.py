# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Noise of clouds: smooth errors of a whole cloud, white errors of its points, outliers of both.

Residuals of a cloud: r = B m + e. Columns of B are smooth modes over the sheet, m has independent normal coefficients,
e is white. A cloud has a multivariate Student distribution, therefore a bad cloud gets a small weight. A bad point gets
a small weight by its loss.
"""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.physics.model.forces.force import Array

#: Losses of a point's residual: quadratic, linear or logarithmic beyond the scale.
SQUARE, HUBER, CAUCHY = "square", "huber", "cauchy"
#: Scale of a loss [standard deviations], by the number of coordinates of a residual.
#: A normal residual exceeds it in 10 % of the points of a matched cloud, and in 18 % of bare points.
LOSS_SCALES = {3: 2.5, 1: 1.345}
#: Iterations of the weights of points.
_WEIGHT_STEPS = 5
#: Degrees of freedom of the clouds' distribution.
_CLOUD_FREEDOM = 4.0
#: Largest degree of the polynomials in each direction of the sheet.
_MODE_DEGREE = 3
#: Least standard deviation [m], and least variance of a mode relative to the white variance.
_MIN_SIGMA, _MIN_MODE = 1e-7, 1e-6


def smooth_modes(rest_shape: Array) -> Array:
    """Return smooth displacement shapes of a sheet, orthogonal and of unit mean square, shape (particles, modes).

    They are the products of polynomials in the two main directions of the rest shape, up to degree 3 in all.
    """
    centred = rest_shape - rest_shape.mean(axis=0)
    plane = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
    plane = plane / max(float(np.abs(plane).max()), 1e-12)
    columns = [
        plane[:, 0] ** i * plane[:, 1] ** j
        for degree in range(_MODE_DEGREE + 1)
        for i, j in ((degree - k, k) for k in range(degree + 1))
    ]
    modes, values, _ = np.linalg.svd(np.column_stack(columns), full_matrices=False)
    # The polynomials of high degree depend on each other on a sheet of few particles.
    return np.asarray(modes[:, values > 1e-6 * values[0]] * np.sqrt(len(rest_shape)))


@attrs.frozen(kw_only=True, eq=False)
class CloudWeight:
    """Inverse noise covariance of one cloud's residuals, in factored form."""

    #: Rows of the smooth modes of the cloud's points, shape (n, modes).
    modes: Array
    #: Weight of each point [1/m²], shape (n,).
    points: Array
    #: Covariance of the modes' coefficients, given the residuals [m²], shape (modes, modes).
    posterior: Array
    #: Weight of the whole cloud.
    scale: float
    #: Value of the loss: half the negative logarithm of the likelihood.
    loss: float

    def apply(self, r: Array) -> Array:
        """Return the inverse noise covariance times residuals, shape (..., n, d), by Woodbury's identity."""
        weighted = r * self.points[:, None]
        smooth = self.modes @ (self.posterior @ (self.modes.T @ weighted))
        return np.asarray(self.scale * (weighted - smooth * self.points[:, None]))


@attrs.frozen(kw_only=True, eq=False)
class NoiseModel:
    """Model of a cloud's noise: white errors of points, smooth errors of the whole cloud, and a robust loss."""

    #: Standard deviation of the white part of a coordinate [m].
    sigma: float
    #: Variances of the coefficients of the smooth modes [m²], shape (modes,); empty without smooth errors.
    variances: Array
    #: SQUARE, HUBER or CAUCHY.
    loss: str
    #: True if a cloud with large residuals gets a small weight as a whole.
    has_cloud_weights: bool = True

    def weigh(self, r: Array, modes: Array) -> CloudWeight:
        """Return the inverse noise covariance and the loss of a cloud, by its residuals.

        Args:
            r: residuals [m], shape (n, d).
            modes: rows of the smooth modes, shape (n, modes).
        """
        weight, _, _ = self._split(r, modes)
        return weight

    def _split(self, r: Array, modes: Array) -> tuple[CloudWeight, Array, Array]:
        """Return the cloud's weight, coefficients of the smooth modes (modes, d), and remaining residuals (n, d)."""
        n, d = r.shape
        point_weights, scale = np.ones(n), 1.0
        white, k = self.sigma**2, len(self.variances)
        used = modes[:, :k]
        for _ in range(_WEIGHT_STEPS):
            points = point_weights / white
            posterior = np.asarray(
                np.linalg.inv(np.diag(1.0 / self.variances) + (used.T * points) @ used), dtype=np.float64
            )
            coefficients = posterior @ (used.T @ (r * points[:, None]))
            remainder = r - used @ coefficients
            squares = np.square(remainder).sum(axis=1) / white
            point_weights = point_weight(squares, self.loss, d)
        # The coefficients minimize this sum, therefore its derivatives by r are the weighted residuals.
        distance = 2.0 * float(point_loss(squares, self.loss, d).sum())
        distance += float((np.square(coefficients).T / self.variances).sum())
        loss = 0.5 * distance
        if self.has_cloud_weights:
            scale = (_CLOUD_FREEDOM + n * d) / (_CLOUD_FREEDOM + distance)
            loss = 0.5 * (_CLOUD_FREEDOM + n * d) * float(np.log1p(distance / _CLOUD_FREEDOM))
        weight = CloudWeight(modes=used, points=points, posterior=posterior, scale=scale, loss=loss)
        return weight, coefficients, remainder

    def updated(self, clouds: Iterable[tuple[Array, Array]]) -> NoiseModel:
        """Return the model after one step of expectation-maximization on the residuals of clouds.

        The sums are divided by the weights, as in the algorithm with an expanded parameter (Liu, Rubin, Wu 1998).
        It has the same limit and converges in a few steps.

        Args:
            clouds: residuals [m], shape (n, d), and rows of the smooth modes, of each cloud.
        """
        squares, count, variances, n_vectors = 0.0, 0.0, np.zeros(len(self.variances)), 0.0
        for r, modes in clouds:
            weight, coefficients, remainder = self._split(r, modes)
            d = r.shape[1]
            point_weights = weight.points * self.sigma**2
            squares += weight.scale * float(point_weights @ np.square(remainder).sum(axis=1))
            # The expected squares include the uncertainty of the coefficients.
            spread = (weight.modes @ weight.posterior * weight.modes).sum(axis=1)
            squares += d * float(point_weights @ spread)
            count += weight.scale * d * float(point_weights.sum())
            variances += weight.scale * np.square(coefficients).sum(axis=1) + d * np.diag(weight.posterior)
            n_vectors += weight.scale * d
        sigma = max(float(np.sqrt(squares / max(count, 1e-12))), _MIN_SIGMA)
        floor = _MIN_MODE * sigma**2
        return attrs.evolve(self, sigma=sigma, variances=np.maximum(variances / max(n_vectors, 1e-12), floor))


def initial_noise(residuals: Iterable[Array], loss: str, n_modes: int) -> NoiseModel:
    """Return a noise model by the residuals' median: white, with `n_modes` smooth modes. Raises FitError for the loss.

    Args:
        residuals: residuals of each cloud [m], shape (n, d).
        loss: SQUARE, HUBER or CAUCHY.
        n_modes: number of smooth modes; 0 for white noise, with a weight of 1 for each cloud.
    """
    if loss not in (SQUARE, HUBER, CAUCHY):
        raise FitError(f"loss is '{loss}'; it must be {SQUARE}, {HUBER} or {CAUCHY}")
    sigma = max(median_deviation(np.concatenate([r.ravel() for r in residuals])), _MIN_SIGMA)
    variances = np.full(n_modes, 0.1 * sigma**2)
    return NoiseModel(sigma=sigma, variances=variances, loss=loss, has_cloud_weights=n_modes > 0)


def median_deviation(r: Array) -> float:
    """Return the robust standard deviation of residuals: that of normal numbers with the same median |r|."""
    return float(np.median(np.abs(r))) / 0.6745 if r.size else 0.0


def point_weight(squares: Array, loss: str, d: int) -> NDArray[np.float64]:
    """Return the robust weights of points by their squared residuals [standard deviations²], shape (n,)."""
    limit = LOSS_SCALES[d] ** 2
    if loss == HUBER:
        return np.sqrt(limit / np.maximum(squares, limit))
    if loss == CAUCHY:
        return np.asarray(1.0 / (1.0 + squares / limit))
    return np.ones(len(squares))


def point_loss(squares: Array, loss: str, d: int) -> NDArray[np.float64]:
    """Return the robust losses of points by their squared residuals [standard deviations²], shape (n,)."""
    limit = LOSS_SCALES[d] ** 2
    if loss == HUBER:
        return np.where(squares <= limit, 0.5 * squares, np.sqrt(limit * squares) - 0.5 * limit)
    if loss == CAUCHY:
        return np.asarray(0.5 * limit * np.log1p(squares / limit))
    return 0.5 * squares
