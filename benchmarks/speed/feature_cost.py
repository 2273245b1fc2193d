# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of unused features: against a hand-written loop of the necessary engine calls, and by feature."""

from __future__ import annotations

import argparse
import ctypes
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from support.feature_variants import BARE, FORCES, Running, Variant, swinging, variants

from benchmarks.speed.curtain import cores
from benchmarks.timing import InterleavedTimes, repeated, time_interleaved
from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.engine.binding import SUMMARY_NUMBERS, FrameRequest, check, library
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit, steps_for
from validation.report import Report


class HandWrittenLoop:
    """Hand-written loop for a bare grid: at most axial bending, no grippers, no tolerance, no diagnostics.

    Its only choice is the number of steps, by the stability limit at the end of the previous frame. It uses one thread
    and one engine call per frame, with a reused request. A simulation of such a scene gives the same bits.

    Args:
        scene: configuration.

    Raises:
        ValueError: for an unsupported scene.
    """

    def __init__(self, scene: Scene) -> None:
        if scene.gripper_names or scene.cloth.mesh or scene.cloth.springs or scene.tolerance:
            raise ValueError("the hand-written loop has no grippers, mesh, raw springs or tolerance")
        if scene.bending.model not in ("none", "axial"):
            raise ValueError(f"the hand-written loop has no bending model '{scene.bending.model}'")
        # The plan owns the engine's data and must stay alive.
        self._plan = scene.plan()
        self._handle = self._plan._handle
        self._library = library()
        self._period = scene.period
        state = swinging(scene)
        self.x, self.v = state.x, state.v
        self._limit = leapfrog_limit(*self._plan.spectral_bounds(self.x))
        #: Steps of the newest frame.
        self.steps = 0
        self._counts = np.zeros(1, dtype=np.int64)
        self._summary = np.zeros(SUMMARY_NUMBERS)
        #: Positions and velocities [m, m/s] of the current run and of the previous one, from which the next starts.
        self._ends = np.empty((1, 2, *self.x.shape)), np.empty((1, 2, *self.x.shape))
        self._frame = FrameRequest(duration=self._period, runs=1, steps=self._counts.ctypes.data, bands=1, combined=1)

    def frame(self) -> None:
        """Run one frame with the stable number of steps, and check its end.

        Raises:
            ValueError: if the motion does not stay finite.
        """
        self._frame.summary, self._frame.bounds_level = self._summary.ctypes.data, 1
        self.bare_frame()
        if not self._summary[0] < np.inf:
            raise ValueError("the motion did not stay finite")
        self._limit = leapfrog_limit(float(self._summary[1]), float(self._summary[2]))

    def bare_frame(self) -> None:
        """Run the steps of a frame without the check."""
        self._counts[0] = self.steps = steps_for(self._period, CONSTANTS.stability_safety * self._limit)
        frame = self._frame
        frame.x0, frame.v0, frame.out = self.x.ctypes.data, self.v.ctypes.data, self._ends[0].ctypes.data
        check(self._library.cloth_frame(self._handle, ctypes.byref(frame)))
        self.x, self.v = self._ends[0][0]
        self._ends = self._ends[1], self._ends[0]


#: Largest ratio of a frame to one of the hand-written loop.
MAX_HAND_WRITTEN_RATIO = 1.02
#: Largest ratio of a sleeping frame to a moving one.
MAX_SLEEP_RATIO = 0.03
#: Largest ratio of a frame of a realistic sheet to one of the default cloth.
MAX_REALISTIC_RATIO = 1.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parts = f"of {', '.join(PARTS)}"
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=parts)
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128], metavar="N", help="particles a side")
    parser.add_argument("--copies", type=int, default=3, help="of each candidate; the fastest counts")
    parser.add_argument("--seconds", type=float, default=10.0, help="of timing for each size and table")


def run(options: argparse.Namespace) -> Report:
    """Measure the selected parts."""
    report = Report("Cost of features")
    for part in options.only:
        PARTS[part](options, report)
    timing = "candidates are interleaved on one core and timed by processor time"
    report.note(f"{timing}; ratios are medians over the rounds")
    return report


def _hand(options: argparse.Namespace, report: Report) -> None:
    columns = ["N", "scene", "frame ms", "to the loop by hand", "that loop to itself", "to its steps alone", "more us"]
    table = report.add_table("A simulation's frame against a hand-written loop of the necessary engine calls", columns)
    scenes = {"springs alone": BARE, "springs, damping, drag, gravity": FORCES}
    for resolution in options.sizes:
        makers: dict[str, Callable[[], Callable[[], Any]]] = {}
        for name, values in scenes.items():
            scene = Scene.from_parameters({**values, "cloth.resolution": [resolution, resolution]})
            makers[name] = partial(_simulated, scene)
            makers[f"{name}, by hand"] = makers[f"{name}, again"] = partial(_by_hand, scene)
            makers[f"{name}, steps"] = partial(_by_hand, scene, bare=True)
        times = _frame_times(makers, copies=options.copies, seconds=options.seconds)
        for name in scenes:
            hand, again = f"{name}, by hand", f"{name}, again"
            ratio = 0.5 * (times.ratio(name, hand) + times.ratio(name, again))
            milliseconds = 1e3 * times.median(name)
            more = 1e3 * milliseconds * (1.0 - 1.0 / ratio)
            ratios = [ratio, times.ratio(again, hand), times.ratio(name, f"{name}, steps")]
            table.rows.append([resolution, name, milliseconds, *ratios, more])
            if ratio > MAX_HAND_WRITTEN_RATIO:
                report.fail(f"N = {resolution}, {name}: {ratio:.3f} times the loop by hand")


def _simulated(scene: Scene) -> Callable[[], Any]:
    return Simulation(scene, swinging(scene)).advance


def _by_hand(scene: Scene, *, bare: bool = False) -> Callable[[], Any]:
    loop = HandWrittenLoop(scene)
    return loop.bare_frame if bare else loop.frame


def _running(variant: Variant, resolution: int) -> Callable[[], Any]:
    return Running(variant, resolution).frame


#: Frames per turn: several, so that the caches hold the candidate's own data.
_FRAMES_A_TURN = 3


def _frame_times(
    makers: Mapping[str, Callable[[], Callable[[], Any]]], *, copies: int, seconds: float
) -> InterleavedTimes:
    """Return the frame time of each candidate, on one core, as the fastest of several copies in each round.

    Copies are needed because the memory layout slows one in seven by up to an eighth.
    """
    with cores(one_core=True):
        # Copies of the candidates alternate, so that none has better memory.
        candidates = {
            f"{name}#{k}": repeated(make(), _FRAMES_A_TURN) for k in range(copies) for name, make in makers.items()
        }
        turns = time_interleaved(candidates, seconds=seconds, clock=time.thread_time).seconds
    rounds = {name: zip(*(turns[f"{name}#{k}"] for k in range(copies)), strict=True) for name in makers}
    return InterleavedTimes(
        {name: [min(times) / _FRAMES_A_TURN for times in by_copy] for name, by_copy in rounds.items()}
    )


def _features(options: argparse.Namespace, report: Report) -> None:
    columns = ["N", "feature", "is", "frame ms", "to a frame without"]
    table = report.add_table("Cost of a feature", columns)
    for resolution in options.sizes:
        everything = variants()
        makers = {variant.name: partial(_running, variant, resolution) for variant in everything}
        times = _frame_times(makers, copies=options.copies, seconds=options.seconds)
        absent: dict[str, Variant] = {}
        for variant in everything:
            without = absent.setdefault(variant.feature, variant)
            ratio = times.ratio(variant.name, without.name)
            milliseconds = 1e3 * times.median(variant.name)
            table.rows.append([resolution, variant.feature, variant.presence, milliseconds, ratio])
            if variant.asleep and ratio > MAX_SLEEP_RATIO:
                report.fail(f"N = {resolution}: a frame asleep costs {ratio:.3g} of one that moves")


#: The default cloth, its parts one by one, and all together: warp and weft, bending modulus, drag and added mass.
_DEFAULT_CLOTH = {"cloth.resolution": [30, 30], "grippers": [""]}
_THREADS = {"material.stretch_modulus_weft": 500.0}
_BENDING = {"material.bending_modulus": 1e-5, "material.bending_modulus_weft": 5e-6}
_MASS = {"air.added_mass": 0.07}
_WIND = {"wind.velocity": [0.0, 1.0, 0.0]}
_BENDINGS = ("quadratic", "crossed", "altitude")


def _realistic(options: argparse.Namespace, report: Report) -> None:
    columns = ["sheet", "frame ms", "to the default", "by the sum of its parts"]
    table = report.add_table("A realistic sheet of 30 x 30 particles under error control", columns)
    sheets: dict[str, dict[str, Any]] = {"default": {}, "warp and weft": _THREADS, "added mass": _MASS}
    sheets |= {f"bending {model}": {"bending.model": model, **_BENDING} for model in _BENDINGS}
    sheets |= {f"realistic, {model}": {"bending.model": model, **_THREADS, **_BENDING, **_MASS} for model in _BENDINGS}
    sheets["realistic, quadratic, in wind"] = sheets["realistic, quadratic"] | _WIND
    scenes = {name: Scene.from_parameters({**_DEFAULT_CLOTH, **values}) for name, values in sheets.items()}
    makers = {name: partial(_simulated, scene) for name, scene in scenes.items()}
    times = _frame_times(makers, copies=options.copies, seconds=options.seconds)
    ratios = {name: times.ratio(name, "default") for name in sheets}
    for name, ratio in ratios.items():
        parts = ("warp and weft", "added mass", f"bending {name.removeprefix('realistic, ')}")
        total: float | str = "-"
        if parts[-1] in sheets:
            total = 1.0 + sum(ratios[part] - 1.0 for part in parts)
        table.rows.append([name, 1e3 * times.median(name), ratio, total])
    for name in ("realistic, quadratic", "realistic, quadratic, in wind"):
        if ratios[name] > MAX_REALISTIC_RATIO:
            failure = f"takes {ratios[name]:.3g} times the default; target {MAX_REALISTIC_RATIO:g}"
            report.fail(f"the sheet '{name}' {failure}")


PARTS = {"hand": _hand, "features": _features, "realistic": _realistic}
