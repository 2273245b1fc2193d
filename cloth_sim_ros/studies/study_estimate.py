# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost estimate of a study, measured on the beginning of a run."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs

from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.run_recording import RunRecording
from cloth_sim_ros.studies.sampling import MAX_RUNS, sample
from cloth_sim_ros.studies.study import POLICY, TARGET, Study
from cloth_sim_ros.studies.study_run import CommandedSimulation, RunError

#: Wall time of the trial run [s].
_TRIAL_SECONDS = 2.0
#: Number of runs that are tried until one starts.
_MAX_TRIALS = 8


@attrs.frozen(kw_only=True)
class StudyEstimate:
    """Estimated cost of a run: wall time [s] on one core, size [bytes] and number of frames."""

    #: Wall time of one run on one core [s].
    seconds_per_run: float
    #: Size of one run's session and row [bytes].
    bytes_per_run: float
    #: Number of frames of one run.
    n_frames: int

    def describe(self, runs: int, cores: int) -> str:
        """Return the disk space and the wall time of all runs on a number of cores, as text."""
        hours = runs * self.seconds_per_run / 3600.0 / cores
        return (
            f"about {format_quantity(runs * self.bytes_per_run, 'B')} and {hours:,.2g} hours on {cores} cores "
            f"({self.seconds_per_run:.2g} s and {format_quantity(self.bytes_per_run, 'B')} a run)"
        )


def format_quantity(value: float, unit: str) -> str:
    """Return a number with a suitable SI prefix and its unit."""
    for prefix in ("", "k", "M", "G", "T"):
        if value < 1000.0:
            return f"{value:.3g} {prefix}{unit}"
        value /= 1000.0
    return f"{value:,.3g} P{unit}"


def sample_and_estimate(study: Study, cores: int) -> tuple[list[tuple[Any, ...]], StudyEstimate]:
    """Check a study by drawing and trying runs; return the factor values and a run's cost. Raises StudyError.

    Args:
        study: the study.
        cores: number of cores, for the error text.

    Raises:
        StudyError: if there are too many runs, values are invalid, or the policy raises.
    """
    if study.runs > MAX_RUNS:
        small_study = attrs.evolve(study, runs=_MAX_TRIALS)
        estimate = estimate_study(study, _draw_samples(small_study))
        cost = f"They would take {estimate.describe(study.runs, cores)}; split the study, or reduce runs"
        raise StudyError(f"runs is {study.runs}; at most {MAX_RUNS} are possible. {cost}")
    samples = _draw_samples(study)
    _check_extremes(study, samples)
    return samples, estimate_study(study, samples)


def check_disk_space(folder: Path, study: Study, estimate: StudyEstimate) -> None:
    """Raise StudyError if a study's sessions would exceed the free disk space.

    Raises:
        StudyError: if the space is too small; the text names the required and the free space.
    """
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    needed = study.runs * estimate.bytes_per_run
    if needed > free:
        advice = "omit the clouds ('clouds: false'), " if study.clouds else ""
        cause = f"about {format_quantity(needed, 'B')}, {folder} has {format_quantity(free, 'B')} left"
        raise StudyError(f"{study.runs} runs take {cause}; {advice}reduce runs or use another disk")


def estimate_study(study: Study, samples: Sequence[Sequence[Any]]) -> StudyEstimate:
    """Simulate the beginning of a run for about 2 s; return the estimated cost of a run. Raises StudyError.

    Raises:
        StudyError: if none of the first runs starts.
    """
    names = [factor.name for factor in study.factors]
    first: RunError | None = None
    for run, values in enumerate(samples[:_MAX_TRIALS]):
        try:
            commanded = CommandedSimulation.create(study, run, dict(zip(names, values, strict=True)))
            commanded.advance()
        except RunError as error:
            first = first or error
            if study.policy is not None and str(error).startswith("policy "):
                break
            continue
        return _time_run(study, run, dict(zip(names, values, strict=True)))
    raise StudyError(f"no run starts: {first}")


def _time_run(study: Study, run: int, factor_levels: dict[str, Any]) -> StudyEstimate:
    commanded = CommandedSimulation.create(study, run, factor_levels)
    n_tried = 0
    with tempfile.TemporaryDirectory(prefix="cloth_batch_") as folder:
        recording = RunRecording(Path(folder), commanded.simulation, name="trial", clouds=study.clouds)
        start = time.perf_counter()
        try:
            while n_tried < commanded.n_frames and time.perf_counter() - start < _TRIAL_SECONDS:
                recording.add(*commanded.advance())
                n_tried += 1
        except RunError:
            # The run fails before its end. Its row will record that.
            n_tried = max(n_tried, 1)
        seconds = time.perf_counter() - start
        header_bytes = recording.bytes_written
        size = recording.finish(reason="trial").stat().st_size
    per_frame = max(size - header_bytes, 0) / n_tried
    return StudyEstimate(
        seconds_per_run=seconds * commanded.n_frames / n_tried,
        bytes_per_run=min(header_bytes, size) + per_frame * commanded.n_frames + 1500.0,
        n_frames=commanded.n_frames,
    )


def _draw_samples(study: Study) -> list[tuple[Any, ...]]:
    runs = min(study.runs, MAX_RUNS)
    return sample(study.factors, runs=runs, seed=study.seed, sampling=study.sampling)


def _check_extremes(study: Study, samples: Sequence[Sequence[Any]]) -> None:
    """Raise StudyError if the smallest or largest drawn value of a normal distribution is invalid in the scene.

    Raises:
        StudyError: if a value is invalid; the text names value and run.
    """
    for index, factor in enumerate(study.factors):
        if factor.kind != "normal" or factor.name.partition(".")[0] in (TARGET, POLICY):
            continue
        drawn = [values[index] for values in samples]
        for value in (min(drawn), max(drawn)):
            try:
                study.scene({factor.name: value})
            except ParameterError as error:
                cause = f"{value!r} in run {drawn.index(value)}, of a normal distribution: {error}"
                raise StudyError(f"vary: '{factor.name}' is {cause}; narrow it, or use uniform") from error
