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
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.batch.errors import FolderError, folder_error
from cloth_sim_ros.batch.folder import StudyFolder, read_row
from cloth_sim_ros.batch.outcomes import OutcomeError, OutcomeWatch
from cloth_sim_ros.batch.recording import RunRecording
from cloth_sim_ros.batch.study import POLICY, Study
from cloth_sim_ros.batch.user_code import USER_ERRORS, Observation, events_of, in_words, load
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, SetParameters, Target
from cloth_sim_ros.simulation.script_events import ScriptEvents
from cloth_sim_ros.simulation.simulation import Simulation

#: Status of a run: successful; failed by its own fault; every worker that executed it was killed.
OK, FAILED, KILLED = "ok", "failed", "killed"
#: Events that a policy may return: a robot's commands, and parameters.
_COMMANDS = (Target, Move, Grasp, SetParameters)


class RunError(RuntimeError):
    """A run failed by its own fault; the message gives the cause."""


def perform_all(folder: str, runs: Sequence[tuple[int, tuple[Any, ...]]]) -> list[int]:
    """Execute several runs sequentially, as one Dask task; results go to the folder.

    Args:
        folder: folder of the study.
        runs: index and factor values of each run.

    Returns:
        Indices of the runs.

    Raises:
        FolderError: if this machine can't read or write the folder.
    """
    place = StudyFolder(folder)
    try:
        # The modification time distinguishes a recreated folder from its predecessor in the cache.
        study = _study(folder, place.study_file.stat().st_mtime_ns)
    except OSError as error:
        raise FolderError(
            f"{socket.gethostname()} can't read the study in {folder}: {error.strerror}. Workers on other machines "
            "need a shared folder under the same name"
        ) from error
    for run, values in runs:
        perform(place, study, run, values)
    return [run for run, _ in runs]


@functools.lru_cache(maxsize=4)
def _study(folder: str, _changed: int) -> Study:
    return StudyFolder(folder).read()


def perform(place: StudyFolder, study: Study, run: int, values: Sequence[Any]) -> dict[str, Any]:
    """Execute one run, write its session and its row, and return the row.

    A successful run is not repeated.

    Args:
        study_folder: folder of the study.
        study: the study.
        run: index of the run.
        values: values of the factors, in their order.

    Raises:
        FolderError: if the folder can't be written; the run's files are removed then.
    """
    done = read_row(place.row_file(run))
    if done is not None and done["status"] == OK:
        return done
    begun, worked = time.perf_counter(), time.process_time()
    named = dict(zip((factor.name for factor in study.factors), values, strict=True))
    workplace = None
    try:
        workplace = place.workplace(run)
        row, session = _record(study, run, named, workplace)
        if session is not None:
            row["bytes"] = session.stat().st_size
            target = place.session(run)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(session, target)
            row["session"] = str(target.relative_to(place.path))
        row.update(wall_time=time.perf_counter() - begun, cpu_time=time.process_time() - worked)
        place.write_row(row)
    except OSError as error:
        raise folder_error(place.path, error) from error
    finally:
        if workplace is not None:
            shutil.rmtree(workplace, ignore_errors=True)
    return row


def empty_row(study: Study, run: int, named: dict[str, Any], *, status: str, error: str) -> dict[str, Any]:
    """Return the row of a run without results."""
    return {
        "run": run,
        "status": status,
        "error": error,
        "seed": study.seed_of(run),
        "values": {name: list(v) if isinstance(v, tuple) else v for name, v in named.items()},
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


def _record(study: Study, run: int, named: dict[str, Any], folder: Path) -> tuple[dict[str, Any], Path | None]:
    """Simulate and record a run; return its row without times, and its session file or None."""
    row = empty_row(study, run, named, status=OK, error="")
    try:
        motion = Motion.of(study, run, named)
    except RunError as error:
        return {**row, "status": FAILED, "error": str(error)}, None
    simulation, watch = motion.simulation, OutcomeWatch(motion.simulation)
    recording = RunRecording(folder, simulation, name=f"run_{run:07d}", clouds=study.clouds)
    try:
        try:
            for _ in range(motion.frames):
                events, frame = motion.advance()
                recording.add(events, frame)
                watch.add(frame)
            row["outcomes"] = {**watch.outcomes(), **_own(study, watch, named)}
        except RunError as error:
            row["status"], row["error"] = FAILED, f"frame {simulation.frame}: {error}"
        except OutcomeError as error:
            row["status"], row["error"] = FAILED, str(error)
        session = recording.finish(reason="stopped" if row["status"] == OK else "failed")
    except BaseException:
        recording.abandon()
        raise
    row.update(digest=simulation.state.digest(), frames=watch.frames, flagged_frames=watch.flagged)
    row["error_estimate"] = watch.error
    return row, session


def _own(study: Study, watch: OutcomeWatch, named: dict[str, Any]) -> dict[str, Any]:
    functions = {source.reference: load(source, "outcome") for source in study.outcomes}
    return watch.own(functions, named) if functions else {}


@attrs.define(eq=False)
class Motion:
    """Simulation of a run with its scripts or its policy."""

    simulation: Simulation
    #: Number of frames of the run.
    frames: int
    _commands: Callable[[int], Sequence[Event]]
    _wrenches: Any = None

    @classmethod
    def of(cls, study: Study, run: int, named: dict[str, Any]) -> Motion:
        """Return the simulation of a run.

        Args:
            study: the study.
            run: index of the run.
            factor_values: values of the factors by name.

        Raises:
            RunError: if the values are invalid, or the policy can't be created.
        """
        try:
            simulation = Simulation(study.scene(named))
        except (ValueError, MemoryError) as error:
            raise RunError(str(error) or "not enough memory") from error
        period = simulation.scene.period
        motion = cls(simulation, max(1, round(study.duration / period)), lambda _frame: [])
        motion._wrenches = np.zeros((len(simulation.grippers.names), 6))
        if study.policy is None:
            motion._commands = ScriptEvents(study.moved_scripts(named), period).at
            return motion
        try:
            policy = load(study.policy, "policy")
            policy = policy() if isinstance(policy, type) else policy
        except USER_ERRORS as error:
            raise RunError(f"policy '{study.policy.reference}' raised {in_words(error)}") from error
        told = {name.removeprefix(f"{POLICY}."): value for name, value in named.items()}
        rng = np.random.default_rng(study.seed_of(run))
        motion._commands = functools.partial(motion._ask, policy, study.policy.reference, told, rng)
        return motion

    def advance(self) -> tuple[Sequence[Event], Any]:
        """Advance by one frame and return its events and the frame.

        Raises:
            RunError: if the policy raises or returns invalid events, or the motion does not stay finite.
        """
        simulation = self.simulation
        events = self._commands(simulation.frame)
        try:
            frame = simulation.advance(events)
        except (EventError, UnstableError) as error:
            raise RunError(str(error)) from error
        except (TypeError, ValueError, ArithmeticError, MemoryError) as error:
            raise RunError(in_words(error)) from error
        self._wrenches = frame.wrenches
        return events, frame

    def _ask(self, policy: Any, reference: str, values: dict[str, Any], rng: Any, frame: int) -> Sequence[Event]:
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
            events = list(events_of(policy(observation)))
        except USER_ERRORS as error:
            raise RunError(f"policy '{reference}' raised {in_words(error)}") from error
        for index, event in enumerate(events):
            if not isinstance(event, _COMMANDS):
                known = ", ".join(kind.__name__ for kind in _COMMANDS)
                raise RunError(f"policy '{reference}' returned {event!r}; it must return a list of {known}")
            if (
                isinstance(event, Move)
                and event.orientation is None
                and event.obstacle in simulation.scene.obstacle_names
            ):
                events[index] = attrs.evolve(event, orientation=self._turned(event.obstacle))
        return events

    def _turned(self, obstacle: str) -> tuple[float, ...]:
        """Return the orientation of an obstacle's current target, which a command without orientation keeps."""
        targets = self.simulation.state.memory["obstacle.target"]
        return tuple(targets[self.simulation.scene.obstacle_names.index(obstacle)][3:].tolist())
