# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covariance of a fit to several motions: each motion is a cluster of correlated clouds."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.joint import JointProblem
from cloth_sim_ros.fit.joint_solver import JointSolution
from cloth_sim_ros.physics.model.forces.force import Array

#: Least number of motions of intervals by motion.
MIN_MOTIONS = 5
#: Variance of a logarithm above which the clouds say nothing about the parameter.
_MAX_VARIANCE = 100.0


@attrs.frozen(kw_only=True, eq=False)
class Covariance:
    """Covariance of the fitted parameters' logarithms; standard deviations of these and of the alignment's unknowns."""

    #: Shape (p, p).
    matrix: Array
    #: Standard deviation of each logarithm, shape (p,); infinite if the clouds do not depend on the parameter.
    deviations: Array
    #: Standard deviations of the alignment's unknowns, shape (unknowns,).
    alignment_deviations: Array
    #: Degrees of freedom of Student's distribution of each logarithm, shape (p,); None for a normal one.
    freedoms: Array | None
    #: True if intervals may be stated: by motions, or of the noise of a single motion.
    has_intervals: bool
    #: Change of all unknowns if a motion is left out, for each motion, shape (motions, unknowns); None without it.
    without: Array | None = None


def jackknife_covariance(problem: JointProblem, solution: JointSolution, selected: Sequence[int]) -> Covariance:
    """Return the covariance of the parameters' logarithms by leaving out each of the `selected` motions in turn.

    Motions are independent; clouds of a motion may be correlated in any way, and the model may be wrong. Unknowns
    of one motion alone are eliminated before. Deviations are infinite of parameters about which the clouds say nothing
    without one of the motions; the matrix holds the inverse information of these parameters.
    """
    information, gradient, keep, back = _reduced_equations(problem, solution)
    prior_information, _ = problem.prior(solution.point)
    total = information.sum(axis=0) + np.diag(prior_information[keep])
    count, p = len(selected), len(problem.parameters)
    changes = np.zeros((count, p + len(solution.point.eta)))
    changes[:, keep] = [np.linalg.solve(total - information[g], gradient[g]) for g in range(count)]
    # Intervals are of the clouds alone: with the search's prior, a parameter that they do not show would seem exact.
    weak = information.sum(axis=0) + np.diag(_weak_prior(prior_information, p)[keep])
    without = np.array([np.linalg.solve(weak - information[g], gradient[g]) for g in range(count)])
    centred = without - without.mean(axis=0)
    matrix = (count - 1) / count * centred.T @ centred
    variances = np.zeros(p + len(solution.point.eta))
    variances[keep] = np.diag(matrix)
    variances[back] = np.nan
    deviations = np.sqrt(np.diag(matrix)[:p])
    remaining = np.array([np.diag(np.linalg.inv(weak - part))[:p] for part in information])
    is_known = np.all((remaining > 0.0) & (remaining < _MAX_VARIANCE), axis=0)
    is_known_pair = is_known[:, None] & is_known
    by_noise = np.where(is_known[:, None] | is_known, 0.0, np.linalg.inv(weak)[:p, :p])
    return Covariance(
        matrix=np.where(is_known_pair, matrix[:p, :p], by_noise),
        deviations=np.where(is_known, deviations, np.inf),
        alignment_deviations=np.sqrt(variances[p:]),
        freedoms=effective_freedoms(information, weak, p),
        has_intervals=True,
        without=changes,
    )


def effective_freedoms(information: Array, total: Array, n_parameters: int) -> Array:
    """Return the degrees of freedom of each parameter's jackknife variance, (p,), by Satterthwaite's moments.

    They are one less than the motions if all motions inform alike, and fewer if some dominate.

    Args:
        information: information of each motion, shape (motions, n, n).
        total: information of all motions and of the prior, shape (n, n).
        n_parameters: number of parameters.
    """
    count = len(information)
    slopes = np.array([np.linalg.inv(total - part)[:n_parameters] for part in information])
    scores = np.einsum("gpi,gij->gpj", slopes, information)
    covariances = -np.einsum("gpi,ij,hpj->pgh", scores, np.linalg.inv(total), scores)
    places = np.arange(count)
    covariances[:, places, places] += np.einsum("gpi,gpi->pg", scores, slopes)
    centring = np.eye(count) - 1.0 / count
    quadratic = centring @ covariances @ centring
    squares = np.einsum("pgh,phg->p", quadratic, quadratic)
    freedoms = np.trace(quadratic, axis1=1, axis2=2) ** 2 / np.maximum(squares, np.finfo(float).tiny)
    return np.asarray(np.clip(freedoms, 1.0, count - 1.0))


def noise_covariance(problem: JointProblem, solution: JointSolution, selected: Sequence[int]) -> Covariance:
    """Return the inverse information as covariance: right if the model is, and clouds are independent."""
    prior_information, _ = problem.prior(solution.point)
    p = len(problem.parameters)
    total = solution.equations.information.sum(axis=0) + np.diag(_weak_prior(prior_information, p))
    matrix = np.linalg.inv(total)
    deviations = np.sqrt(np.diag(matrix))
    return Covariance(
        matrix=matrix[:p, :p],
        deviations=_mark_unidentified(deviations[:p], total),
        alignment_deviations=deviations[p:],
        freedoms=None,
        has_intervals=len(selected) == 1,
    )


def _weak_prior(prior_information: Array, n_parameters: int) -> Array:
    """Return the prior's information with a negligible part of that of the parameters, which keeps sums regular."""
    weak = prior_information.copy()
    weak[:n_parameters] *= 1e-6
    return weak


def _mark_unidentified(deviations: Array, information: Array) -> Array:
    """Return the standard deviations, set to infinity if a parameter has negligible information."""
    diagonal = np.diag(information)[: len(deviations)]
    return np.where(diagonal > 1.0 / _MAX_VARIANCE, deviations, np.inf)


def _reduced_equations(
    problem: JointProblem, solution: JointSolution
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return information and gradient of each motion after elimination of the unknowns that it alone has.

    Returns:
        Information (motions, n, n), gradient (motions, n), indices of the n kept unknowns, and of the eliminated ones.
    """
    p = len(problem.parameters)
    is_shared = np.concatenate([np.ones(p, dtype=bool), problem.alignment.shared_mask()])
    equations, (prior_information, prior_gradient) = solution.equations, problem.prior(solution.point)
    keep, alone = np.flatnonzero(is_shared), np.flatnonzero(~is_shared)
    information, gradient = equations.information[:, keep[:, None], keep], equations.gradient[:, keep]
    if not len(alone):
        return information, gradient, keep, alone
    reduced, reduced_gradient = information.copy(), gradient.copy()
    for g in range(len(information)):
        matrix = equations.information[g]
        block = alone[np.diag(matrix)[alone] > 0.0]
        if not len(block):
            continue
        inner = matrix[np.ix_(block, block)] + np.diag(prior_information[block])
        cross = matrix[np.ix_(keep, block)]
        solved = np.linalg.solve(
            inner, np.column_stack([cross.T, equations.gradient[g, block] + prior_gradient[block]])
        )
        reduced[g] -= cross @ solved[:, :-1]
        reduced_gradient[g] -= cross @ solved[:, -1]
    return reduced, reduced_gradient, keep, alone
