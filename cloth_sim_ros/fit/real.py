# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit to recordings of a real cloth: grasped particles, time offset, camera pose and parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import attrs

from cloth_sim_ros.fit.alignment import FIXED, MAX_OFFSET, SHARED
from cloth_sim_ros.fit.grasped import find_grasped_at_rest, parse_all_grasped
from cloth_sim_ros.fit.hypotheses import (
    ROUNDS,
    GraspChoice,
    Hypothesis,
    plausible_particles,
    score_hypotheses,
    selections,
)
from cloth_sim_ros.fit.motions import check_options, fit_motions, strongest_motions
from cloth_sim_ros.fit.motions_result import MotionFit
from cloth_sim_ros.fit.noise import HUBER
from cloth_sim_ros.fit.parameters import FitError, FitParameter, choose_parameters
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.recording import FitRecording
from cloth_sim_ros.fit.start import SETTLE_TIME, closed_grippers, motion_recording, start_time
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.fit.windows import IDENTIFIED_DEVIATION
from cloth_sim_ros.scene.scene import Scene


def fit_real(
    recordings: Sequence[Recording],
    scene: Scene,
    names: Sequence[str],
    *,
    grasped: Mapping[str, str] | Sequence[Mapping[str, str]] | None = None,
    start: Mapping[str, float] | None = None,
    settle_time: float = SETTLE_TIME,
    time_offset: str = SHARED,
    camera_pose: str = SHARED,
    loss: str = HUBER,
    held_out: int = 0,
    within: float = IDENTIFIED_DEVIATION,
    workers: int | None = None,
    on_progress: Callable[[int], None] = lambda _runs: None,
) -> MotionFit:
    """Fit parameters to a real cloth's recordings, and choose grasped particles; return the fit. Raises FitError.

    Its grippers hold the same particles in all of them, unless they are named for each.

    Args:
        recordings: clouds and gripper poses.
        scene: the cloth and its grippers.
        names: names of the parameters, short (`stretch`) or full (`material.stretch_modulus`).
        grasped: grasped particles by gripper, such as ``12,13`` or ``top_left``; by default, chosen by the motions.
            A sequence names those of each recording, for all closed grippers.
        start: starting values by name; the scene's by default.
        settle_time: settling time of the simulated cloth before the start [s].
        time_offset: offset between clouds and poses: ``no``, ``shared`` by all recordings, or for ``each``.
        camera_pose: error of the camera's pose, likewise.
        loss: loss of a point: ``square``, ``huber`` or ``cauchy``.
        held_out: number of recordings on which nothing is fitted.
        within: largest relative standard deviation of an identified parameter.
        workers: number of processes; one per core by default.
        on_progress: called with the number of simulations since the last call.

    Raises:
        FitError: if the fit is impossible; the text names cause and remedy.
    """
    check_options(len(recordings), time_offset, camera_pose, held_out, within, workers)
    by_recording = None
    if isinstance(grasped, Sequence):
        if len(grasped) != len(recordings):
            raise FitError(f"grasped particles are named for {len(grasped)} of {len(recordings)} recordings")
        by_recording = [parse_all_grasped(scene, texts) for texts in grasped]
    named = {} if isinstance(grasped, Sequence) else parse_all_grasped(scene, grasped or {})
    parameters = choose_parameters(scene, names, start)
    max_offset = 0.0 if time_offset == FIXED else MAX_OFFSET
    with TrajectoryPool(workers) as pool:
        choose = _GraspChooser(
            recordings=recordings,
            scene=scene,
            parameters=parameters,
            settle_time=settle_time,
            variations=(time_offset, camera_pose),
            pool=pool,
            on_progress=on_progress,
        )
        choice = choose.initial_choice(named, max_offset) if by_recording is None else None
        while True:
            if by_recording is None:
                prepared = _prepare(recordings, scene, choice, named, settle_time, max_offset)
            else:
                prepared = _prepare_named(recordings, scene, by_recording, settle_time, max_offset)
            fit = fit_motions(
                prepared,
                names,
                start=start,
                time_offset=time_offset,
                camera_pose=camera_pose,
                loss=loss,
                held_out=held_out,
                within=within,
                on_progress=on_progress,
                pool=pool,
            )
            if choice is None or len(choice.hypotheses) < 2:
                return attrs.evolve(fit, n_runs=pool.n_runs, grasp=choice)
            # The starting values may have misled the first choice.
            again = choose.repeated_choice(choice, list(fit.values.values()))
            if again.best.particles == choice.best.particles or choice.is_final:
                return _with_choice(
                    fit, again if again.best.particles == choice.best.particles else choice, pool.n_runs
                )
            choice = attrs.evolve(again, is_final=True)


def _with_choice(fit: MotionFit, choice: GraspChoice, n_runs: int) -> MotionFit:
    """Return a fit with the choice of grasped particles; with a tie no parameter counts as identified."""
    if not choice.is_tie or fit.doubt:
        return attrs.evolve(fit, grasp=choice, n_runs=n_runs)
    first, second = choice.hypotheses[:2]
    pairs = ", ".join(
        f"{name} {first.particles[name][0]} or {second.particles[name][0]}"
        for name in choice.grippers
        if first.particles[name] != second.particles[name]
    )
    doubt = (
        f"the motions do not decide which particles are held ({pairs}). Name them by --held, or record faster motions"
    )
    estimates = tuple(attrs.evolve(e, is_identified=False, is_explained=False) for e in fit.estimates)
    return attrs.evolve(fit, grasp=choice, doubt=doubt, estimates=estimates, n_runs=n_runs)


def _prepare(
    recordings: Sequence[Recording],
    scene: Scene,
    choice: GraspChoice | None,
    named: Mapping[str, tuple[int, ...]],
    settle_time: float,
    max_offset: float,
) -> list[FitRecording]:
    prepared = []
    for recording in recordings:
        if choice is not None:
            chosen = choice.selections()
        else:
            begin = start_time(recording, scene, max_offset)
            chosen = [
                find_grasped_at_rest(scene, name, recording.grippers[name].pose_at(begin)[0], named.get(name, ()))
                for name in closed_grippers(scene, recording.grippers, begin, named)
            ]
        prepared.append(motion_recording(recording, scene, chosen, settle_time=settle_time, max_offset=max_offset))
    return prepared


def _prepare_named(
    recordings: Sequence[Recording],
    scene: Scene,
    named: Sequence[Mapping[str, tuple[int, ...]]],
    settle_time: float,
    max_offset: float,
) -> list[FitRecording]:
    prepared = []
    for recording, particles in zip(recordings, named, strict=True):
        begin = start_time(recording, scene, max_offset)
        for name in closed_grippers(scene, recording.grippers, begin, particles):
            if name not in particles:
                raise FitError(
                    f"--held names no particles of gripper '{name}' for {recording.name}; if recordings differ, name "
                    "those of each gripper"
                )
        chosen = selections(particles, is_named=True)
        prepared.append(motion_recording(recording, scene, chosen, settle_time=settle_time, max_offset=max_offset))
    return prepared


@attrs.frozen(kw_only=True, eq=False)
class _GraspChooser:
    """Choice of grasped particles by simulations of several combinations."""

    recordings: Sequence[Recording]
    scene: Scene
    parameters: Sequence[FitParameter]
    settle_time: float
    variations: tuple[str, str]
    pool: TrajectoryPool
    on_progress: Callable[[int], None]

    def initial_choice(self, named: Mapping[str, tuple[int, ...]], max_offset: float) -> GraspChoice | None:
        """Return the choice by simulations with the starting values; None for bare points, which show no particle."""
        if not self.recordings[0].matched:
            return None
        combinations = plausible_particles(self.recordings, self.scene, named, max_offset)
        grippers = tuple(combinations[0])
        if len(combinations) == 1:
            only = Hypothesis(particles=combinations[0], distances={})
            is_named = bool(grippers) and all(name in named for name in grippers)
            return GraspChoice(hypotheses=(only,), is_named=is_named, grippers=grippers)
        values, scored, remaining = [parameter.start for parameter in self.parameters], list[Hypothesis](), combinations
        for n_combinations, n_recordings in ROUNDS:
            if scored and (len(remaining) < 2 or len(self.recordings) <= len(scored[0].distances)):
                break
            scored = [*self._score(remaining[:n_combinations], values, n_recordings), *scored[n_combinations:]]
            remaining = [dict(hypothesis.particles) for hypothesis in scored[: ROUNDS[1][0]]]
        return GraspChoice(hypotheses=tuple(scored), is_named=False, grippers=grippers)

    def repeated_choice(self, choice: GraspChoice, values: Sequence[float]) -> GraspChoice:
        """Return the choice among the best combinations by simulations with other values of the parameters."""
        n_combinations, n_recordings = ROUNDS[1]
        best = [hypothesis.particles for hypothesis in choice.hypotheses[:n_combinations]]
        scored = self._score(best, values, n_recordings)
        return attrs.evolve(choice, hypotheses=(*scored, *choice.hypotheses[n_combinations:]))

    def _score(
        self, combinations: Sequence[Mapping[str, tuple[int, ...]]], values: Sequence[float], n_recordings: int
    ) -> list[Hypothesis]:
        selected = strongest_motions(self.recordings, range(len(self.recordings)), n_recordings)
        return score_hypotheses(
            self.recordings,
            self.scene,
            combinations,
            self.parameters,
            values=values,
            selected=selected,
            variations=self.variations,
            settle_time=self.settle_time,
            pool=self.pool,
            on_progress=self.on_progress,
        )
