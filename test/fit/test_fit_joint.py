# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Differences of residuals: smooth ones, and those of motions with folds that come and go."""

import numpy as np
import pytest

from cloth_sim_ros.fit.difference_steps import roughness
from cloth_sim_ros.fit.joint import Derivatives
from cloth_sim_ros.fit.short_waves import missing_information, motion_weights, smooth_shares

STEPS = np.array([0.1, 0.4])


def differences(residual):
    """Central differences of a function of one logarithm, for each step: one recording with one cloud."""
    slopes, curvatures = [], []
    for step in STEPS:
        up, down, centre = residual(step), residual(-step), residual(0.0)
        slopes.append([(up - down) / (2.0 * step)])
        curvatures.append([0.5 * (up + down) - centre])
    return Derivatives(slopes=[slopes], curvatures=[curvatures], steps=STEPS)


def test_smooth_residuals_are_not_rough():
    rng = np.random.default_rng(1)
    slope, bow = rng.normal(size=(2, 50, 3))
    shares = roughness(differences(lambda change: slope * change + 0.2 * bow * change**2))
    assert shares.max() < 0.01


def test_longer_steps_average_over_short_waves():
    rng = np.random.default_rng(2)
    slope = rng.normal(size=(500, 3))
    # Each simulation has its own deviation, however small the step.
    shares = roughness(differences(lambda change: slope * change + 0.1 * rng.normal(size=slope.shape)))
    deviation, signal = 0.1**2, 2.0 * STEPS**2
    assert shares == pytest.approx(deviation / (deviation + signal), rel=0.15)
    assert roughness(differences(lambda _: rng.normal(size=slope.shape))) == pytest.approx([1.0, 1.0], abs=0.1)


def test_parameter_without_effect_has_no_roughness():
    assert roughness(differences(lambda _: np.ones((5, 3)))).tolist() == [0.0, 0.0]


def test_products_above_a_tenth_of_the_square_lack_nothing():
    square = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.5], [0.0, 0.5, 1.0]])
    assert np.abs(missing_information(0.2 * square, square, 2)).max() < 1e-12


def test_information_of_short_waves_alone_keeps_a_tenth():
    square, product = np.diag([4.0, 9.0, 1.0]), np.diag([3.0, -2.0, 1.0])
    product[1, 2] = product[2, 1] = square[1, 2] = square[2, 1] = 0.5
    complete = product.copy()
    complete[:2, :2] += missing_information(product, square, 2)
    # Without the third unknown, 9 - 0.25 remain of the square.
    reduced = complete[:2, :2] - np.outer(complete[:2, 2], complete[2, :2])
    assert reduced == pytest.approx(np.diag([3.0, 0.1 * 8.75]))


def test_motions_of_short_waves_alone_have_no_weight():
    square = np.diag([4.0, 9.0])
    squares = np.stack([square, square, square])
    shares = smooth_shares(np.stack([square, 0.25 * square, -0.1 * square]), squares)
    assert shares == pytest.approx([1.0, 0.25, 0.0])
    # Shares do not depend on the parameters' units.
    scale = np.diag([1e3, 1.0])
    scaled = smooth_shares(scale @ np.stack([square, 0.25 * square, -0.1 * square]) @ scale, scale @ squares @ scale)
    assert scaled == pytest.approx(shares)


def test_shares_as_weights_give_the_smallest_variance():
    rng = np.random.default_rng(5)
    smooth, waves = rng.uniform(0.5, 2.0, size=6), rng.uniform(0.0, 5.0, size=6)
    squares = smooth + waves

    def variance(weights: np.ndarray) -> float:
        return float(weights**2 @ squares) / float(weights @ smooth) ** 2

    shares = smooth_shares(smooth[:, None, None], squares[:, None, None])
    best = variance(shares)
    assert best < 0.9 * variance(np.ones(6))
    for k in range(6):
        for factor in (0.8, 1.25):
            assert variance(np.where(np.arange(6) == k, factor, 1.0) * shares) > best


def test_motion_with_far_gradient_gets_small_weight():
    rng = np.random.default_rng(6)
    information = np.stack([np.diag([4.0, 9.0, 1.0])] * 40)
    gradient = rng.normal(size=(40, 3)) * np.sqrt([4.0, 9.0, 1.0])
    gradient[7] *= 10.0
    weights = motion_weights(information, gradient)
    assert weights[7] < 0.1
    assert np.delete(weights, 7).mean() == pytest.approx(1.0, abs=0.3)


def test_weights_of_unpredictable_motions_are_positive():
    # Products of slopes whose short waves are independent may be negative.
    information = np.array([1.0, 1.0, 1.0, 1.0, -3.9]).reshape(5, 1, 1)
    weights = motion_weights(information, np.ones((5, 1)))
    assert (weights > 0.0).all()


def test_single_motion_keeps_its_weight():
    # Its gradient vanishes at the minimum, whatever the noise.
    assert motion_weights(np.diag([4.0, 9.0])[None], np.zeros((1, 2))) == pytest.approx([1.0])
    # A direction without information counts neither way.
    assert motion_weights(np.diag([4.0, 0.0])[None], np.zeros((1, 2))) == pytest.approx([1.0])
