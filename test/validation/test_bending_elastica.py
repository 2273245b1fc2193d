# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A clamped strip under its weight against the heavy elastica, for S8, S9 and quadratic hinges."""

import math

import numpy as np
import pytest

from validation.bending.elastica import hanging_strip, heavy_elastica


def deviation(model, exact, columns, **options):
    strip = hanging_strip(model, exact, columns=columns, **options)
    assert strip.max_lateral_offset < 1e-9
    return np.linalg.norm(strip.curve - exact.at(strip.arc), axis=1).max()


def test_a_slight_elastica_is_the_cantilever_of_the_textbook():
    # small slopes: tip slope b/6, tip depth b/8
    exact = heavy_elastica(1e-3)
    assert exact.slope_at_tip == pytest.approx(exact.load / 6, rel=1e-6)
    assert exact.curve[-1] == pytest.approx([1.0, exact.load / 8], rel=1e-6)


@pytest.mark.parametrize("model", ["crossed", "altitude", "quadratic"])
@pytest.mark.parametrize("degrees", [5, 40, 80])
def test_a_strip_hangs_as_the_elastica_does(model, degrees):
    exact = heavy_elastica(math.radians(degrees))
    coarse, fine = deviation(model, exact, 20), deviation(model, exact, 40)
    assert fine < 0.005
    assert 1.8 < math.log2(coarse / fine) < 2.4  # second order


@pytest.mark.parametrize("model", ["crossed", "altitude", "quadratic"])
def test_a_wider_strip_hangs_the_same(model):
    # the grid's hinges have no Poisson's ratio, therefore the width does not matter
    exact = heavy_elastica(math.radians(40))
    assert deviation(model, exact, 20, rows=5) == pytest.approx(deviation(model, exact, 20, rows=2), rel=0.05)
