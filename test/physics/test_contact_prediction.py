# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact prediction: an obstacle that one check skips is out of reach of each particle."""

import numpy as np
import pytest
from support.contact_scenes import SHAPES, contact, flat_sheet, moving

from cloth_sim_ros.physics.plan.plan import compile


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("push", [0.0, 1.0])
def test_distant_obstacle_is_skipped_as_for_each_particle(shape, push):
    """An anchored particle has no contact; if it is far away, the sphere around the cloth reaches every obstacle."""
    rng, seen = np.random.default_rng(7), set()
    model, places = flat_sheet(5, 6, contact(shape), size=0.4, gravity=push > 0.0, anchors=[0])
    plan = compile(model)
    for seed in range(400):
        path = moving(seed)
        path[1:4] *= rng.choice([0.2, 1.0, 5.0])
        path[4:13] *= rng.choice([0.0, 1e-2, 1.0])
        path[17:26] *= rng.choice([0.0, 1.0])
        plan.contact.force.set_paths(path[None])
        x = np.ascontiguousarray(places.T)
        v = np.ascontiguousarray(rng.choice([0.0, 0.1, 10.0]) * rng.normal(size=x.shape))
        v[:, 0] = 0.0
        duration, t = float(rng.choice([0.0, 1e-3, 1.0 / 60.0])), float(rng.uniform(0.0, 0.1))
        together = plan.contact.predict_energy(t, duration, x, v, memory={})
        x[:, 0] = rng.choice([-1.0, 1.0], 3) * 1e4
        apart = plan.contact.predict_energy(t, duration, x, v, memory={})
        assert together == apart
        seen.add("far" if together == 0.0 else "inside" if together == np.inf else "near")
    assert {"far", "near"} <= seen


@pytest.mark.parametrize("shape", SHAPES)
def test_nan_position_is_near_every_obstacle(shape):
    model, places = flat_sheet(5, 6, contact(shape), size=0.4, anchors=[0])
    plan, rng = compile(model), np.random.default_rng(3)
    for seed in range(100):
        path = moving(seed)
        path[1:4] *= 50.0
        path[4:13] = path[17:26] = 0.0
        plan.contact.force.set_paths(path[None])
        x = np.ascontiguousarray(places.T)
        x[rng.integers(3), rng.integers(1, x.shape[1])] = np.nan
        together = plan.contact.predict_energy(0.0, 0.01, x, np.zeros_like(x), memory={})
        x[:, 0] = 1e4
        assert np.array_equal(
            together, plan.contact.predict_energy(0.0, 0.01, x, np.zeros_like(x), memory={}), equal_nan=True
        )
