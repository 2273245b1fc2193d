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

from cloth_sim_ros.batch.errors import StudyError
from cloth_sim_ros.batch.recording import RunRecording
from cloth_sim_ros.batch.sampling import MAX_RUNS, sample
from cloth_sim_ros.batch.study import POLICY, TARGET, Study
from cloth_sim_ros.batch.study_run import Motion, RunError
from cloth_sim_ros.scene.parameters import ParameterError

#: Wall time of the trial run [s].
_PATIENCE = 2.0
#: Number of runs that are tried until one starts.
_TRIED = 8


@attrs.frozen(kw_only=True)
class Forecast:
    """Estimated cost of a run."""

    #: Wall time of one run on one core [s].
    seconds: float
    #: Size of one run's session and row [bytes].
    bytes: float
    #: Number of frames of one run.
    frames: int

    def in_words(self, runs: int, cores: int) -> str:
        """Return a text with the cost of all runs on a number of cores."""
        hours = runs * self.seconds / 3600.0 / cores
        return (
            f"about {quantity(runs * self.bytes, 'B')} and {hours:,.2g} hours on {cores} cores "
            f"({self.seconds:.2g} s and {quantity(self.bytes, 'B')} a run)"
        )


def quantity(value: float, unit: str) -> str:
    """Return a number with a suitable SI prefix and its unit."""
    for prefix in ("", "k", "M", "G", "T"):
        if value < 1000.0:
            return f"{value:.3g} {prefix}{unit}"
        value /= 1000.0
    return f"{value:,.3g} P{unit}"


def draw(study: Study, cores: int) -> tuple[list[tuple[Any, ...]], Forecast]:
    """Return the values of each run and the cost estimate, after all checks that are possible.

    Args:
        study: the study.
        cores: number of cores, for the error text.

    Raises:
        StudyError: if there are too many runs, values are invalid, or the policy raises.
    """
    if study.runs > MAX_RUNS:
        few = attrs.evolve(study, runs=_TRIED)
        expected = attempt(study, _sample(few))
        raise StudyError(
            f"runs is {study.runs}; at most {MAX_RUNS} are possible. They would take "
            f"{expected.in_words(study.runs, cores)}; split the study, or reduce runs"
        )
    samples = _sample(study)
    _check_extremes(study, samples)
    return samples, attempt(study, samples)


def check_room(folder: Path, study: Study, forecast: Forecast) -> None:
    """Refuse a study that exceeds the free disk space.

    Raises:
        StudyError: if the space is too small; the text names the required and the free space.
    """
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    free = shutil.disk_usage(there).free
    needed = study.runs * forecast.bytes
    if needed > free:
        advice = "omit the clouds ('clouds: false'), " if study.clouds else ""
        raise StudyError(
            f"{study.runs} runs take about {quantity(needed, 'B')}, {folder} has {quantity(free, 'B')} "
            f"left; {advice}reduce runs or use another disk"
        )


def attempt(study: Study, samples: Sequence[Sequence[Any]]) -> Forecast:
    """Return the cost estimate of the first run that starts.

    Raises:
        StudyError: if none of the first runs starts.
    """
    names = [factor.name for factor in study.factors]
    first: RunError | None = None
    for run, values in enumerate(samples[:_TRIED]):
        try:
            motion = Motion.of(study, run, dict(zip(names, values, strict=True)))
            motion.advance()
        except RunError as error:
            first = first or error
            if study.policy is not None and str(error).startswith("policy "):
                break
            continue
        return _measure(study, run, dict(zip(names, values, strict=True)))
    raise StudyError(f"no run starts: {first}")


def _measure(study: Study, run: int, named: dict[str, Any]) -> Forecast:
    motion = Motion.of(study, run, named)
    done = 0
    with tempfile.TemporaryDirectory(prefix="cloth_batch_") as folder:
        recording = RunRecording(Path(folder), motion.simulation, name="trial", clouds=study.clouds)
        begun = time.perf_counter()
        try:
            while done < motion.frames and time.perf_counter() - begun < _PATIENCE:
                recording.add(*motion.advance())
                done += 1
        except RunError:
            # The run fails before its end. Its row will record that.
            done = max(done, 1)
        seconds = time.perf_counter() - begun
        opening = recording.bytes_written
        size = recording.finish(reason="trial").stat().st_size
    per_frame = max(size - opening, 0) / done
    return Forecast(
        seconds=seconds * motion.frames / done,
        bytes=min(opening, size) + per_frame * motion.frames + 1500.0,
        frames=motion.frames,
    )


def _sample(study: Study) -> list[tuple[Any, ...]]:
    runs = min(study.runs, MAX_RUNS)
    return sample(study.factors, runs=runs, seed=study.seed, sampling=study.sampling)


def _check_extremes(study: Study, samples: Sequence[Sequence[Any]]) -> None:
    """Refuse the least and the greatest drawn value of a normal distribution if it is invalid.

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
                raise StudyError(
                    f"vary: '{factor.name}' is {value!r} in run {drawn.index(value)}, of a normal distribution: "
                    f"{error}; narrow it, or use uniform"
                ) from error
