# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Least squares of several recordings at once: parameters, time offset and camera pose.

Derivatives by the parameters are differences of simulations. Derivatives by the alignment need no simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.alignment import AlignmentModel, alignment_derivatives, cloud_residuals
from cloth_sim_ros.fit.noise import NoiseModel, initial_noise, smooth_modes
from cloth_sim_ros.fit.parameters import FitError, FitParameter, acts_at_rest
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.fit.short_waves import missing_information, motion_weights, smooth_shares
from cloth_sim_ros.fit.solver import PRIOR_SIGMA
from cloth_sim_ros.fit.trajectory import SimulatedMotion, TrajectoryPool, trajectory_run
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State

#: Steps of the noise model's estimate after each linearization.
_NOISE_STEPS = 4


@attrs.define(kw_only=True, eq=False)
class Point:
    """Parameters and alignment of one simulation of the recordings, with its motions and residuals."""

    #: Logarithms of the parameters, shape (p,), and unknowns of the alignment, shape (q,).
    theta: Array
    eta: Array
    #: Simulated motion of each selected recording.
    trajectories: list[SimulatedMotion]
    #: Residuals of each selected recording and used cloud [m], shape (n, d) each.
    residuals: list[list[Array]]


@attrs.define(kw_only=True, eq=False)
class Derivatives:
    """Derivatives of the residuals by the parameters' logarithms, listed by recording, parameter and used cloud."""

    #: For each selected recording, parameter and used cloud: shape (n, d) [m].
    slopes: list[list[list[Array]]]
    #: Half the second differences over the squared steps, likewise; empty for one-sided differences.
    curvatures: list[list[list[Array]]]
    #: Difference steps, shape (p,).
    steps: Array
    #: Slopes by other simulations, whose short waves are independent; empty without.
    other_slopes: list[list[list[Array]]] = attrs.field(factory=list)

    def first_clouds(self, counts: Sequence[int]) -> Derivatives:
        """Return the derivatives of only the first `counts` clouds of each recording."""
        slopes, curvatures, other_slopes = (
            [[by_cloud[:n] for by_cloud in motion] for motion, n in zip(parts, counts, strict=bool(parts))]
            for parts in (self.slopes, self.curvatures, self.other_slopes)
        )
        return attrs.evolve(self, slopes=slopes, curvatures=curvatures, other_slopes=other_slopes)


@attrs.define(kw_only=True, eq=False)
class NormalEquations:
    """Gauss-Newton normal equations of each recording, about all unknowns: parameters, then alignment."""

    #: Information matrix of each recording, shape (recordings, unknowns, unknowns).
    information: Array
    #: Gradient of each recording, shape (recordings, unknowns).
    gradient: Array
    #: Loss of each recording, shape (recordings,).
    loss: Array
    #: Weight of each recording in information and gradient, shape (recordings,).
    weights: Array


@attrs.define(kw_only=True, eq=False)
class JointProblem:
    """Least-squares problem of several recordings: used clouds, parameters, alignment and prior."""

    recordings: Sequence[FitRecording]
    #: Indices of the used clouds of each recording.
    used: list[NDArray[np.int64]]
    parameters: Sequence[FitParameter]
    alignment: AlignmentModel
    pool: TrajectoryPool
    on_progress: Callable[[int], None] = lambda _runs: None
    #: Smallest and largest time offset [s].
    offsets: tuple[float, float] = attrs.field()
    #: Rest state of each recording at similar parameters.
    rest_states: dict[int, State] = attrs.field(factory=dict)
    _modes: Array = attrs.field(init=False)

    @offsets.default
    def _default_offsets(self) -> tuple[float, float]:
        return -self.alignment.max_offset, self.alignment.max_offset

    def __attrs_post_init__(self) -> None:
        self._modes = smooth_modes(self.recordings[0].scene.sheet.positions())

    @property
    def pivot(self) -> Array:
        """Centre of the camera's rotation [m], shape (3,)."""
        return np.array(self.alignment.pivot)

    @property
    def start(self) -> Array:
        """Logarithms of the starting values, shape (p,)."""
        return np.log([parameter.start for parameter in self.parameters])

    def clamp(self, theta: Array) -> Array:
        """Return the parameters' logarithms clamped to their limits."""
        lower, upper = np.log([p.minimum for p in self.parameters]), np.log([p.maximum for p in self.parameters])
        return np.clip(theta, lower, upper)

    def simulate(
        self,
        jobs: Sequence[tuple[int, Array]],
        tolerance: float,
        *,
        rest_states: Sequence[State | None] | None = None,
        are_at_rest: Sequence[bool] | None = None,
    ) -> list[SimulatedMotion | str]:
        """Simulate (index of recording, logarithms) pairs in parallel; return each motion, or its error's text.

        Args:
            jobs: the pairs.
            tolerance: tolerance of the simulations [m].
            rest_states: rest state of each pair from which the cloth settles; default: the recordings' `rest_states`.
            are_at_rest: for each pair, true if the rest state is that of its parameters, so that nothing settles.
        """
        states = rest_states if rest_states is not None else [self.rest_states.get(index) for index, _ in jobs]
        are_at_rest = [False] * len(jobs) if are_at_rest is None else are_at_rest
        runs = [
            trajectory_run(
                self.recordings[index],
                self.parameters,
                np.exp(theta).tolist(),
                tolerance=tolerance,
                offsets=self.offsets,
                rest_state=state,
                is_at_rest=is_at_rest,
            )
            for (index, theta), state, is_at_rest in zip(jobs, states, are_at_rest, strict=True)
        ]
        results = self.pool.simulate(runs)
        self.on_progress(len(runs))
        return results

    def residuals(self, index: int, trajectory: SimulatedMotion, eta: Array) -> list[Array]:
        """Return the residuals of one recording's used clouds, an array (n, d) [m] for each, without simulating."""
        alignment = self.alignment.alignment(eta, index)
        return cloud_residuals(self.recordings[index], trajectory, alignment, self.pivot, self.used[index])

    def evaluate(self, theta: Array, eta: Array, selected: Sequence[int], tolerance: float) -> Point | str:
        """Simulate recordings at a point, and store new rest states; return it with residuals, or an error's text."""
        cold = [k for k in selected if k not in self.rest_states]
        results = self.simulate([(k, theta) for k in selected], tolerance)
        trajectories = []
        for k, result in zip(selected, results, strict=True):
            if isinstance(result, str):
                return f"{self.recordings[k].name}: {result}"
            if k in cold and result.rest_state is not None:
                self.rest_states[k] = result.rest_state
            trajectories.append(result)
        residuals = [self.residuals(k, t, eta) for k, t in zip(selected, trajectories, strict=True)]
        return Point(theta=theta, eta=eta, trajectories=trajectories, residuals=residuals)

    def replace_rest_states(self, point: Point, selected: Sequence[int]) -> None:
        """Store a point's rest states in `rest_states`; later simulations settle from them. Simulates nothing."""
        for k, trajectory in zip(selected, point.trajectories, strict=True):
            if trajectory.rest_state is not None:
                self.rest_states[k] = trajectory.rest_state

    def differentiate(
        self, point: Point, selected: Sequence[int], steps: Array, tolerance: float, *, central: bool
    ) -> Derivatives:
        """Return difference quotients of the residuals by the logarithms, from simulations. Raises FitError.

        Raises:
            FitError: if a simulation at a neighbouring point fails.
        """
        signs = (1.0, -1.0) if central else (1.0,)
        p = len(steps)
        places = [(row, i, sign) for row in range(len(selected)) for i in range(p) for sign in signs]
        jobs = [(selected[row], self.clamp(point.theta + sign * steps[i] * np.eye(p)[i])) for row, i, sign in places]
        # Parameters of the motion alone do not change the rest state: such runs begin where the point's run began.
        begins = [point.trajectories[row].rest_state for row, _, _ in places]
        are_at_rest = [
            begin is not None and not acts_at_rest(self.recordings[selected[row]].scene, self.parameters[i])
            for begin, (row, i, _) in zip(begins, places, strict=True)
        ]
        states = [
            begin if is_at_rest else self.rest_states.get(k)
            for begin, is_at_rest, (k, _) in zip(begins, are_at_rest, jobs, strict=True)
        ]
        results = self.simulate(jobs, tolerance, rest_states=states, are_at_rest=are_at_rest)
        slopes, curvatures = list[list[list[Array]]](), list[list[list[Array]]]()
        at = 0
        for row, k in enumerate(selected):
            base = point.residuals[row]
            slopes.append([])
            curvatures.append([])
            for i in range(p):
                sides = []
                for _ in signs:
                    result, theta = results[at], jobs[at][1]
                    at += 1
                    if isinstance(result, str):
                        name = self.parameters[i].name
                        raise FitError(
                            f"{self.recordings[k].name} can't be simulated with {name} = {np.exp(theta[i]):.3g}, near "
                            f"the result: {'; '.join(result.splitlines())}"
                        )
                    sides.append((float(theta[i] - point.theta[i]), self.residuals(k, result, point.eta)))
                if not central or sides[0][0] == 0.0 or sides[1][0] == 0.0:
                    step, moved = max(sides, key=lambda side: abs(side[0]))
                    slopes[-1].append([(a - b) / step for a, b in zip(moved, base, strict=True)])
                    curvatures[-1].append([np.zeros_like(b) for b in base])
                    continue
                (step_up, up), (step_down, down) = sides
                slopes[-1].append([(a - b) / (step_up - step_down) for a, b in zip(up, down, strict=True)])
                curvatures[-1].append([0.5 * (a + b) - c for a, b, c in zip(up, down, base, strict=True)])
        return Derivatives(slopes=slopes, curvatures=curvatures, steps=steps)

    def residuals_and_modes(self, point: Point, selected: Sequence[int]) -> list[tuple[Array, Array]]:
        """Return, for each used cloud with points, its residuals (n, d) [m] and smooth modes (n, modes) there."""
        pairs = []
        for k, residuals in zip(selected, point.residuals, strict=True):
            for cloud, r in zip(self.used[k], residuals, strict=True):
                if len(r):
                    pairs.append((r, self.mode_rows(k, int(cloud))))
        return pairs

    def mode_rows(self, index: int, cloud: int) -> Array:
        """Return the smooth modes at a cloud's visible points, shape (n, modes); no modes for bare points."""
        recording = self.recordings[index]
        if not recording.matched:
            return np.zeros((int(visible_mask(recording.clouds[cloud]).sum()), 0))
        return np.asarray(self._modes[visible_mask(recording.clouds[cloud])])

    def white_noise(self, point: Point, loss: str) -> NoiseModel:
        """Return a noise model without smooth errors, of the residuals of a point."""
        return initial_noise([r for part in point.residuals for r in part], loss, 0)

    def smooth_noise(self, point: Point, selected: Sequence[int], loss: str) -> NoiseModel:
        """Return a noise model with smooth errors and weights of clouds, estimated from the residuals of a point."""
        n_modes = self._modes.shape[1] if self.recordings[0].matched else 0
        noise = initial_noise([r for part in point.residuals for r in part], loss, n_modes)
        noise = attrs.evolve(noise, has_cloud_weights=True)
        return self.update_noise(noise, point, selected, 4 * _NOISE_STEPS)

    def update_noise(
        self, noise: NoiseModel, point: Point, selected: Sequence[int], steps: int = _NOISE_STEPS
    ) -> NoiseModel:
        """Return the noise model after some steps of its estimation (expectation-maximization)."""
        clouds = self.residuals_and_modes(point, selected)
        for _ in range(steps):
            noise = noise.updated(clouds)
        return noise

    def loss(self, point: Point, selected: Sequence[int], noise: NoiseModel) -> float:
        """Return the robust loss of all used clouds plus that of the prior, without unit."""
        total = sum(noise.weigh(r, modes).loss for r, modes in self.residuals_and_modes(point, selected))
        distance = (point.theta - self.start) / PRIOR_SIGMA
        aligned = point.eta / self.alignment.prior_sigmas()
        return float(total + 0.5 * distance @ distance + 0.5 * aligned @ aligned)

    def normal_equations(
        self,
        point: Point,
        derivatives: Derivatives,
        selected: Sequence[int],
        noise: NoiseModel,
        weights: Array | None = None,
    ) -> NormalEquations:
        """Return the normal equations of each selected recording, without the prior.

        Two sets of slopes have independent short waves. Their products contain no square of these, which would make
        the information too large.

        Args:
            point: parameters and residuals.
            derivatives: slopes of the residuals.
            selected: indices of the recordings.
            noise: noise model.
            weights: weight of each recording, shape (recordings,); by default, that of its gradient if there are two
                sets of slopes.
        """
        p, q = len(point.theta), len(point.eta)
        information, squares = np.zeros((2, len(selected), p + q, p + q))
        sets = (derivatives.slopes, derivatives.other_slopes or derivatives.slopes)
        gradient = np.zeros((len(selected), p + q))
        loss = np.zeros(len(selected))
        for row, k in enumerate(selected):
            components, places = self.alignment.columns(k)
            alignment = self.alignment.alignment(point.eta, k)
            by_alignment = alignment_derivatives(
                self.recordings[k], point.trajectories[row], alignment, self.pivot, self.used[k], components.tolist()
            )
            columns = np.concatenate([np.arange(p), p + places])
            for c, cloud in enumerate(self.used[k]):
                r = point.residuals[row][c]
                if not len(r):
                    continue
                weight = noise.weigh(r, self.mode_rows(k, int(cloud)))
                first, second = (np.array([slope[c] for slope in (*by[row], *by_alignment)]) for by in sets)
                mean = 0.5 * (first + second)
                weighted, difference = weight.apply(mean), 0.5 * (first - second)
                square = np.einsum("ind,jnd->ij", mean, weighted)
                # The symmetric part of the product of both: the square of the mean minus that of half the difference.
                product = square - np.einsum("ind,jnd->ij", difference, weight.apply(difference))
                squares[row][np.ix_(columns, columns)] += square
                information[row][np.ix_(columns, columns)] += product
                gradient[row][columns] += np.einsum("ind,nd->i", weighted, r)
                loss[row] += weight.loss
        if derivatives.other_slopes:
            if weights is None:
                shares = smooth_shares(information[:, :p, :p], squares[:, :p, :p])
                weights = shares * motion_weights(shares[:, None, None] * information, shares[:, None] * gradient)
            information *= weights[:, None, None]
            squares *= weights[:, None, None]
            gradient *= weights[:, None]
            prior = np.diag(self.prior(point)[0])
            missing = missing_information(information.sum(axis=0) + prior, squares.sum(axis=0) + prior, p)
            information[:, :p, :p] += missing / len(selected)
        weights = np.ones(len(selected)) if weights is None else weights
        return NormalEquations(information=information, gradient=gradient, loss=loss, weights=weights)

    def prior(self, point: Point) -> tuple[Array, Array]:
        """Return the diagonal of the prior's information and its gradient, shape (unknowns,) each."""
        sigmas = np.concatenate([np.full(len(point.theta), PRIOR_SIGMA), self.alignment.prior_sigmas()])
        distance = np.concatenate([point.theta - self.start, point.eta])
        return 1.0 / sigmas**2, distance / sigmas**2
