# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Second differences of combined runs from piece to piece."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.physics.control.run_differences import RunDifferences
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.state import State

LENGTH, COUNTS = 0.01, (4, 5)


def tableaus(count: int) -> list[ExtrapolationTableau]:
    """Return the runs of some successive pieces of a particle that swings on a joint."""
    plan = compile(Model([1.0, 1.0], [PairSprings([[0, 1]], 0.0, 100.0)], anchors=[0]))
    state, pieces = State(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([[0.0] * 3, [0.0, 5.0, 0.0]])), []
    for k in range(count):
        pieces.append(ExtrapolationTableau(plan, state.shallow_copy(), k * LENGTH, LENGTH, COUNTS))
        pieces[-1].commit(2, state)
    return pieces


def test_second_differences_are_those_of_three_pieces() -> None:
    differences, pieces = RunDifferences(State(np.zeros((2, 3)))), tableaus(3)
    for piece in pieces[:2]:
        assert differences.second_differences(piece, 2) is None
        assert differences.accept(piece, 2) is None
    a, b, c = (piece.combine(2)[0] - piece.combine(1)[0] for piece in pieces)
    second = differences.second_differences(pieces[2], 2)
    assert second is not None
    assert second[0] == pytest.approx(np.linalg.norm(a - 2.0 * b + c, axis=0) / 6.0**0.5, rel=1e-6)
    # They are smaller by the square of angular frequency times length.
    assert second[0].max() < 0.02 * np.linalg.norm(c, axis=0).max()


def test_rejected_piece_changes_nothing() -> None:
    differences, pieces = RunDifferences(State(np.zeros((2, 3)))), tableaus(4)
    for piece in pieces[:2]:
        differences.second_differences(piece, 2)
        differences.accept(piece, 2)
    differences.second_differences(pieces[3], 2)
    second = differences.second_differences(pieces[2], 2)
    assert second is not None
    # Other runs than those of the last call are not known.
    assert differences.accept(pieces[3], 2) is None
    assert differences.second_differences(pieces[2], 2) is None


def test_stored_differences_continue_in_the_next_frame() -> None:
    state, pieces = State(np.zeros((2, 3))), tableaus(3)
    for piece in pieces[:2]:
        differences = RunDifferences(state)
        differences.second_differences(piece, 2)
        differences.accept(piece, 2)
        differences.store(state, is_known=True)
    differences = RunDifferences(state)
    second = differences.second_differences(pieces[2], 2)
    assert second is not None
    differences.accept(pieces[2], 2)
    # A frame that starts again has the pieces of its start.
    differences.restart()
    again = differences.second_differences(pieces[2], 2)
    assert again is not None
    assert (again == second).all()
    differences.store(state, is_known=False)
    assert RunDifferences(state).second_differences(pieces[2], 2) is None
