# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Execution of one run of a study by a Dask worker."""

from __future__ import annotations

import functools
import os
import shutil
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, SetParameters, Target
from cloth_sim_ros.simulation.script_events import ScriptEvents
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.studies.errors import FolderError, folder_error
from cloth_sim_ros.studies.folder import StudyFolder, read_row
from cloth_sim_ros.studies.outcomes import OutcomeError, OutcomeRecorder
from cloth_sim_ros.studies.run_recording import RunRecording
from cloth_sim_ros.studies.study import POLICY, Study
from cloth_sim_ros.studies.user_code import USER_ERRORS, Observation, as_events, format_error, load_function

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.ensemble import Ensemble, EnsembleFrame

#: Status of a run: successful; failed by its own fault; every worker that executed it was killed.
OK, FAILED, KILLED = "ok", "failed", "killed"
#: Events that a policy may return: a robot's commands, and parameters.
_COMMANDS = (Target, Move, Grasp, SetParameters)


class RunError(RuntimeError):
    """Error: a run failed by its own fault; the message gives the cause."""


def perform_all(folder: str, runs: Sequence[tuple[int, tuple[Any, ...]]]) -> list[int]:
    """Execute runs in sequence, as one Dask task, into the study's folder; return their indices. Raises FolderError.

    Args:
        folder: folder of the study.
        runs: index and factor values of each run.

    Returns:
        Indices of the runs.

    Raises:
        FolderError: if this machine can't read or write the folder.
    """
    study_folder = StudyFolder(folder)
    try:
        # The modification time distinguishes a recreated folder from its predecessor in the cache.
        study = _read_study(folder, study_folder.study_file.stat().st_mtime_ns)
    except OSError as error:
        cause = f"{socket.gethostname()} can't read the study in {folder}: {error.strerror}"
        remedy = "Workers on other machines need a shared folder under the same name"
        raise FolderError(f"{cause}. {remedy}") from error
    for run, values in runs:
        perform(study_folder, study, run, values)
    return [run for run, _ in runs]


@functools.lru_cache(maxsize=4)
def _read_study(folder: str, _modified_ns: int) -> Study:
    return StudyFolder(folder).read()


def perform(study_folder: StudyFolder, study: Study, run: int, values: Sequence[Any]) -> dict[str, Any]:
    """Execute a run unless it has succeeded already; write its session and row, return the row. Raises FolderError.

    A successful run is not repeated.

    Args:
        study_folder: folder of the study.
        study: the study.
        run: index of the run.
        values: values of the factors, in their order.

    Raises:
        FolderError: if the folder can't be written; the run's files are removed then.
    """
    existing_row = read_row(study_folder.row_file(run))
    if existing_row is not None and existing_row["status"] == OK:
        return existing_row
    wall_start, cpu_start = time.perf_counter(), time.process_time()
    factor_levels = dict(zip((factor.name for factor in study.factors), values, strict=True))
    run_folder = None
    try:
        run_folder = study_folder.create_run_folder(run)
        row, session = _record(study, run, factor_levels, run_folder)
        if session is not None:
            row["bytes"] = session.stat().st_size
            target = study_folder.session_file(run)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(session, target)
            row["session"] = str(target.relative_to(study_folder.path))
        row.update(wall_time=time.perf_counter() - wall_start, cpu_time=time.process_time() - cpu_start)
        study_folder.write_row(row)
    except OSError as error:
        raise folder_error(study_folder.path, error) from error
    finally:
        if run_folder is not None:
            shutil.rmtree(run_folder, ignore_errors=True)
    return row


def empty_row(study: Study, run: int, factor_levels: dict[str, Any], *, status: str, error: str) -> dict[str, Any]:
    """Return the row of a run without results, such as a failed one: index, status, error, seed and factor values."""
    return {
        "run": run,
        "status": status,
        "error": error,
        "seed": study.seed_of(run),
        "values": {name: list(v) if isinstance(v, tuple) else v for name, v in factor_levels.items()},
        "outcomes": {},
        "digest": "",
        "frames": 0,
        "flagged_frames": 0,
        "error_estimate": None,
        "wall_time": 0.0,
        "cpu_time": 0.0,
        "session": "",
        "bytes": 0,
    }


def _record(study: Study, run: int, factor_levels: dict[str, Any], folder: Path) -> tuple[dict[str, Any], Path | None]:
    """Simulate and record a run; return its row without times, and its session file, None if nothing started."""
    row = empty_row(study, run, factor_levels, status=OK, error="")
    try:
        commanded = CommandedSimulation.create(study, run, factor_levels)
    except RunError as error:
        return {**row, "status": FAILED, "error": str(error)}, None
    simulation, outcome_recorder = commanded.simulation, OutcomeRecorder(commanded.simulation)
    recording = RunRecording(folder, simulation, name=f"run_{run:07d}", clouds=study.clouds)
    try:
        try:
            for _ in range(commanded.n_frames):
                events, frame, ensemble = commanded.advance()
                recording.add(events, frame, ensemble)
                outcome_recorder.add(frame, ensemble)
            row["outcomes"] = {**outcome_recorder.outcomes(), **_user_outcomes(study, outcome_recorder, factor_levels)}
        except RunError as error:
            row["status"], row["error"] = FAILED, f"frame {simulation.frame}: {error}"
        except OutcomeError as error:
            row["status"], row["error"] = FAILED, str(error)
        session = recording.finish(reason="stopped" if row["status"] == OK else "failed")
    except BaseException:
        recording.abandon()
        raise
    row.update(digest=simulation.state.digest(), frames=outcome_recorder.n_frames)
    row["flagged_frames"] = outcome_recorder.n_flagged
    row["error_estimate"] = outcome_recorder.error_estimate
    return row, session


def start_ensemble(simulation: Simulation) -> Ensemble | None:
    """Return the ensemble of a run's scene, at its start; None if the scene names no distribution.

    Raises:
        ValueError: if the distribution does not fit the scene.
    """
    scene = simulation.scene
    if not scene.ensemble.file:
        return None
    from cloth_sim_ros.simulation.ensemble import Ensemble

    options = scene.ensemble
    # Other runs have the other cores.
    return Ensemble(
        scene,
        scene.distribution(),
        state=simulation.state,
        members=options.members,
        seed=options.seed,
        threads=1,
    )


def advance_ensemble(ensemble: Ensemble, frame: Frame) -> EnsembleFrame:
    """Advance an ensemble by the events of a frame.

    Raises:
        RunError: if a member cannot go on.
    """
    try:
        return ensemble.advance(frame.events)
    except ValueError as error:
        raise RunError(str(error)) from error


def _user_outcomes(study: Study, outcome_recorder: OutcomeRecorder, factor_levels: dict[str, Any]) -> dict[str, Any]:
    functions = {source.reference: load_function(source, "outcome") for source in study.outcomes}
    return outcome_recorder.user_outcomes(functions, factor_levels) if functions else {}


@attrs.define(eq=False)
class CommandedSimulation:
    """Simulation of a run, commanded by scripts or by the user's policy."""

    simulation: Simulation
    #: Number of frames of the run.
    n_frames: int
    #: Cloths of uncertain parameters beside it; None without a distribution.
    ensemble: Ensemble | None
    _commands: Callable[[int], Sequence[Event]]
    _wrenches: Any = None

    @classmethod
    def create(cls, study: Study, run: int, factor_levels: dict[str, Any]) -> CommandedSimulation:
        """Return a run's simulation at its start, with its scripts or its policy. Raises RunError.

        Args:
            study: the study.
            run: index of the run.
            factor_levels: values of the factors by name.

        Raises:
            RunError: if the values are invalid, or the policy can't be created.
        """
        try:
            simulation = Simulation(study.scene(factor_levels))
            ensemble = start_ensemble(simulation)
        except (ValueError, MemoryError) as error:
            raise RunError(str(error) or "not enough memory") from error
        period = simulation.scene.period
        commanded = cls(simulation, max(1, round(study.duration / period)), ensemble, lambda _frame: [])
        commanded._wrenches = np.zeros((len(simulation.grippers.names), 6))
        if study.policy is None:
            commanded._commands = ScriptEvents(study.moved_scripts(factor_levels), period).at
            return commanded
        try:
            policy = load_function(study.policy, "policy")
            policy = policy() if isinstance(policy, type) else policy
        except USER_ERRORS as error:
            raise RunError(f"policy '{study.policy.reference}' raised {format_error(error)}") from error
        policy_values = {name.removeprefix(f"{POLICY}."): value for name, value in factor_levels.items()}
        rng = np.random.default_rng(study.seed_of(run))
        reference = study.policy.reference
        commanded._commands = functools.partial(commanded._query_policy, policy, reference, policy_values, rng)
        return commanded

    def advance(self) -> tuple[Sequence[Event], Frame, EnsembleFrame | None]:
        """Advance by one commanded frame; return its events, the frame, the ensemble's or None. Raises RunError.

        Raises:
            RunError: if the policy raises or returns invalid events, the motion does not stay finite, or a member of
                the ensemble cannot go on.
        """
        simulation = self.simulation
        events = self._commands(simulation.frame)
        try:
            frame = simulation.advance(events)
        except (EventError, UnstableError) as error:
            raise RunError(str(error)) from error
        except (TypeError, ValueError, ArithmeticError, MemoryError) as error:
            raise RunError(format_error(error)) from error
        self._wrenches = frame.wrenches
        return events, frame, None if self.ensemble is None else advance_ensemble(self.ensemble, frame)

    def _query_policy(
        self, policy: Any, reference: str, values: dict[str, Any], rng: Any, frame: int
    ) -> Sequence[Event]:
        simulation = self.simulation
        observation = Observation(
            time=simulation.time,
            frame=frame,
            positions=simulation.positions,
            velocities=simulation.velocities,
            wrenches=self._wrenches.copy(),
            values=values,
            rng=rng,
        )
        try:
            events = list(as_events(policy(observation)))
        except USER_ERRORS as error:
            raise RunError(f"policy '{reference}' raised {format_error(error)}") from error
        for index, event in enumerate(events):
            if not isinstance(event, _COMMANDS):
                known = ", ".join(kind.__name__ for kind in _COMMANDS)
                raise RunError(f"policy '{reference}' returned {event!r}; it must return a list of {known}")
            names = simulation.scene.obstacle_names
            if isinstance(event, Move) and event.orientation is None and event.obstacle in names:
                events[index] = attrs.evolve(event, orientation=self._current_orientation(event.obstacle))
        return events

    def _current_orientation(self, obstacle: str) -> tuple[float, ...]:
        """Return the orientation of an obstacle's current target, which a command without orientation keeps."""
        targets = self.simulation.state.memory["obstacle.target"]
        return tuple(targets[self.simulation.scene.obstacle_names.index(obstacle)][3:].tolist())
