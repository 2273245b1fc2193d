# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real-time factor by particles and stiffness, cost by tolerance and integrator, and the slowest frames of a T-shirt.

A gripper carries the lower corner of the default cloth on a circle. Times are processor times on one core, because
other processes have little effect on them. On an idle machine they are wall times. The times of the T-shirt, which two
grippers swing, are wall times, on one core and on all.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from support import garment

from benchmarks.speed.curtain import cores
from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.simulation.events import Event
from validation.command import at_least
from validation.report import Report, Table, print_progress

#: The cloth that is carried.
DEFAULT_CLOTH = Path(__file__).resolve().parents[2] / "config" / "cloth_sim.yaml"
#: Frames before the timed ones, in which the gripper grasps and step control settles.
_WARM = 10
#: Radius [m] and angular speed [rad/s] of the circle.
_RADIUS, _TURN = 0.1, 3.0
#: Integrators at tolerances [m]; None is a fixed step at `_STEP_SHARE` of the stability limit.
CHOICES: tuple[tuple[str, float | None], ...] = (
    *(("auto", tolerance) for tolerance in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8)),
    *(("leapfrog", tolerance) for tolerance in (1e-3, 1e-5)),
    *(("implicit", tolerance) for tolerance in (1e-2, 1e-3)),
    ("leapfrog", None),
)
_STEP_SHARE = 0.5
#: Warm-up frames of the T-shirt, and number of evaluations beyond its steps above which a frame estimated its error.
_GARMENT_WARM, _MIN_ESTIMATED = 48, 8
#: Largest wall time of all but a hundredth of the frames of a T-shirt of 1,460 vertices [ms]: on one core, on two.
_GARMENT_LIMITS = (33.0, 25.0)
#: Wall time after which a cloth is not run again [s].
_MAX_SECONDS = 10.0


@attrs.frozen(kw_only=True)
class FrameCosts:
    """Cost of the frames of one cloth."""

    #: Processor time [s] and force evaluations, means over the frames.
    seconds: float
    evaluations: float
    #: Largest error estimate [m]; None without a tolerance.
    error: float | None
    #: Fraction of flagged frames.
    flagged: float
    #: Most frequent integrator and limiting factor.
    integrator: str
    limited_by: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--sizes", type=int, nargs="*", default=[16, 32, 64], metavar="N", help="particles a side")
    parser.add_argument("--moduli", type=float, nargs="+", default=[1e2, 1e3, 1e4, 1e5], help="of stretch [N/m]")
    parser.add_argument("--choices-size", type=int, default=30, metavar="N", help="particles a side, second table")
    parser.add_argument("--choices-moduli", type=float, nargs="*", default=[1e3, 1e5], help="of stretch, second table")
    parser.add_argument("--frames", type=at_least(1), default=20, help="timed frames of each cloth")
    vertices = "about so many vertices of the T-shirt; 0: none"
    parser.add_argument("--garment", type=at_least(0), default=1460, metavar="N", help=vertices)
    parser.add_argument("--garment-frames", type=at_least(1), default=240, help="timed frames of the T-shirt")
    rounds = "runs of each cloth; the fastest counts; fewer of slow ones"
    parser.add_argument("--rounds", type=at_least(1), default=3, help=rounds)


def run(options: argparse.Namespace) -> Report:
    """Measure all cloths."""
    report = Report("Real time by particles and stiffness")
    factors = Table("Real-time factor, one core", ["particles", *(f"{modulus:g} N/m" for modulus in options.moduli)])
    evaluations = Table("Force evaluations a frame", factors.columns)
    for size in options.sizes:
        costs = [frame_costs(_values(size, modulus), options) for modulus in options.moduli]
        period = Scene.from_parameters(_values(size, options.moduli[0])).period
        factors.rows.append([f"{size} x {size}", *(period / cost.seconds for cost in costs)])
        evaluations.rows.append([f"{size} x {size}", *(cost.evaluations for cost in costs)])
    columns = ["stretch N/m", "integrator", "tolerance m", "frame ms", "evaluations", "estimate m", "flagged"]
    columns += ["stepped", "limit"]
    choices = Table(f"Tolerance and integrator, {options.choices_size} x {options.choices_size}", columns)
    for modulus in options.choices_moduli:
        for integrator, tolerance in CHOICES:
            values = _values(options.choices_size, modulus) | {"integrator": integrator}
            values |= {"step": _fixed_step(values)} if tolerance is None else {"tolerance": tolerance}
            cost = frame_costs(values, options)
            row = [modulus, integrator, "fixed step" if tolerance is None else tolerance, 1e3 * cost.seconds]
            row += [cost.evaluations, "-" if cost.error is None else cost.error, f"{cost.flagged:.0%}"]
            choices.rows.append([*row, cost.integrator, cost.limited_by])
        print_progress(f"integrators at {modulus:g} N/m")
    report.tables += [factors, evaluations, choices]
    if options.garment:
        _measure_garment(report, options.garment, options.garment_frames)
    report.note(
        f"the cloth of config/cloth_sim.yaml, shear modulus a tenth of the stretch modulus, {options.frames} frames; a "
        f"gripper carries its corner; processor time on one core, fastest of at most {options.rounds} runs"
    )
    return report


def frame_costs(values: dict[str, Any], options: argparse.Namespace) -> FrameCosts:
    """Return the costs of frames of a cloth with these parameters, in the fastest run."""
    runs: list[FrameCosts] = []
    begun = time.perf_counter()
    with cores(one_core=True):
        while len(runs) < options.rounds and (not runs or time.perf_counter() - begun < _MAX_SECONDS):
            runs.append(_run(values, options.frames))
    return min(runs, key=lambda cost: cost.seconds)


def _values(size: int, modulus: float) -> dict[str, Any]:
    values = parameter_file.read(DEFAULT_CLOTH, node="cloth_sim", strict=True)
    moduli = {"material.stretch_modulus": modulus, "material.shear_modulus": 0.1 * modulus}
    return {**values, "cloth.resolution": [size, size], **moduli}


def _fixed_step(values: dict[str, Any]) -> float:
    simulation = Simulation(Scene.from_parameters(values))
    return _STEP_SHARE * leapfrog_limit(*simulation.plan.spectral_bounds(simulation.state.x))


def _run(values: dict[str, Any], frames: int) -> FrameCosts:
    simulation = Simulation(Scene.from_parameters(values))
    corner, period = simulation.positions[-1], simulation.scene.period
    seconds, evaluations, flagged, error = 0.0, 0, 0, None
    integrators, limits = Counter[str](), Counter[str]()
    for k in range(_WARM + frames):
        angle = _TURN * period * k
        at = corner + np.array([_RADIUS * (math.cos(angle) - 1.0), -_RADIUS * math.sin(angle), 0.0])
        events: list[Event] = [Target("gripper", tuple(at.tolist()))]
        begun = time.thread_time()
        advance = simulation.advance([*events, Grasp("gripper", True)] if k == 0 else events).advance
        if k < _WARM:
            continue
        assert advance is not None
        seconds += time.thread_time() - begun
        evaluations += advance.evaluations
        flagged += advance.flagged > 0
        error = error if advance.error is None else max(advance.error, error or 0.0)
        integrators[advance.integrator] += 1
        limits[advance.limited_by] += 1
    return FrameCosts(
        seconds=seconds / frames,
        evaluations=evaluations / frames,
        error=error,
        flagged=flagged / frames,
        integrator=integrators.most_common(1)[0][0],
        limited_by=limits.most_common(1)[0][0],
    )


def _measure_garment(report: Report, vertices: int, frames: int) -> None:
    """Measure the frames of a T-shirt that two grippers swing."""
    columns = ["vertices", "cores", "median ms", "p99 ms", "at most", "evaluations", "with estimate", "repeated"]
    table = report.add_table("A T-shirt that two grippers swing, wall time of a frame", columns)
    values = garment.parameters(bending="altitude", tolerance=1e-3)
    scene = Scene.from_parameters(values, files={"garment.obj": garment.obj_file(vertices)})
    for one_core, limit in zip((True, False), _GARMENT_LIMITS, strict=True):
        with cores(one_core=one_core):
            simulation = Simulation(scene)
            seconds, evaluations, n_estimated, rejected = list[float](), 0, 0, 0
            for k in range(_GARMENT_WARM + frames):
                at = {name: tuple(garment.target(name, k * scene.period).tolist()) for name in garment.SHOULDERS}
                events: list[Event] = [Target(name, position) for name, position in at.items()]
                begun = time.perf_counter()
                advance = simulation.advance([*events, *(Grasp(name, True) for name in at if k == 0)]).advance
                assert advance is not None
                if k >= _GARMENT_WARM:
                    seconds.append(time.perf_counter() - begun)
                    evaluations += advance.evaluations
                    n_estimated += advance.evaluations > advance.steps + _MIN_ESTIMATED
                    rejected += advance.rejected > 0
        median, slowest = (1e3 * float(np.quantile(seconds, q)) for q in (0.5, 0.99))
        row = [len(simulation.positions), 1 if one_core else "all", median, slowest, limit, evaluations / frames]
        table.rows.append([*row, f"{n_estimated / frames:.0%}", f"{rejected / frames:.0%}"])
        report.require(slowest <= limit, f"p99 is {slowest:.3g} ms; at most {limit:g} ms")
