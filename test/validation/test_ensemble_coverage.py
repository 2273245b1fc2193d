# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Coverage of ensembles by cloths with random parameters."""

from __future__ import annotations

import numpy as np
import pytest

from validation.ensemble.coverage import measure_coverage, probability_within


def test_probability_within_two_deviations_is_that_of_theory() -> None:
    axes = np.eye(3)
    line, isotropic = np.stack([axes[:1], -axes[:1]]), np.concatenate([axes, -axes])
    # A normal number within two deviations; a chi-squared number of three degrees of freedom below 12.
    along_line, in_all_directions = probability_within(line), probability_within(isotropic[:, None])
    assert [*along_line, *in_all_directions] == pytest.approx([0.9545, 0.9926], abs=0.006)


@pytest.mark.parametrize("name", ["swing from a corner", "carried corner"])
def test_random_cloths_are_covered_as_predicted(name: str) -> None:
    rows = measure_coverage(name, resolution=5, cloths=60, seconds=1.0, seed=4, scale=0.5)
    assert len(rows) == 4
    for row in rows:
        # The standard error of 60 cloths is 0.02 at most.
        assert abs(row.measured - row.predicted) < 0.06
        # The sample's deviation has a relative standard error of 1 / sqrt(2 * 60) for a single direction.
        assert row.sample_deviation == pytest.approx(row.deviation, rel=4.0 / 120**0.5)
