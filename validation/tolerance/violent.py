# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Violent scenes: gripper targets jump by up to a third of the sheet.

The targets jump with every frame while the grippers hold the sheet. There is no reference. Each scene must stay finite
and gain no energy while no gripper acts; the cost of frames is measured.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import attrs
import numpy as np
from support.random_meshes import drawn_alike

from cloth_sim_ros import Grasp, Scene, Simulation, Target, UnstableError
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.simulation.events import Event
from validation.case_pool import CasePool
from validation.report import Report, Table
from validation.stability.cases import EnergyAccount, kinetic_energy
from validation.tolerance.random_scenes import DENSITIES, log_uniform

SIDES, MODULI = (2, 33), (30.0, 1e5)
TOLERANCES, RATES = (1e-5, 1e-2), (30, 120)
#: Simulated time [s]: with grasped particles, and free.
GRASPED_DURATION, FREE_DURATION = 0.6, 0.6
#: Largest energy gain while no gripper acts, relative to the energy turned over.
MAX_FREE_ENERGY_GAIN = 0.01
#: Largest fraction of flagged frames.
MAX_FLAGGED_FRAMES = 0.05
_N_LISTED = 10


@attrs.frozen(kw_only=True)
class ViolentResult:
    """Result of one violent scene."""

    index: int
    words: str
    finite: bool
    #: See `MAX_FREE_ENERGY_GAIN`.
    gain: float
    frames: int
    flagged: int
    #: Largest number of evaluations in a frame, and their estimated cost relative to the work limit.
    evaluations: int
    of_cap: float
    #: Wall time of the longest frame [s].
    seconds: float
    #: Wall time of all frames [s].
    total: float
    integrators: str
    trouble: str


def violent_scene(seed: int, index: int) -> tuple[Scene, np.random.Generator, str]:
    """Return a sheet in still air, the generator for its events, and a short description."""
    rng = np.random.default_rng([seed, index, 2])
    while True:
        model = str(rng.choice(["none", "axial", "opposite", "crossed", "altitude"]))
        rows, columns = (round(log_uniform(rng, *SIDES)) for _ in range(2))
        stretch = log_uniform(rng, *MODULI)
        damping = 0.0 if rng.random() < 0.2 else float(rng.uniform(0.0, 1.0))
        height = float(rng.uniform(0.3, 1.2))
        values: dict[str, Any] = {
            "rate": float(rng.integers(RATES[0], RATES[1] + 1)),
            "gripper.max_speed": 0.0,
            "tolerance": log_uniform(rng, *TOLERANCES),
            "cloth.size": [height, height * (columns - 1) / (rows - 1)],
            "cloth.resolution": [rows, columns],
            "cloth.anchors": [["top"], ["top_left"], [""]][int(rng.integers(3))],
            "material.stretch_modulus": stretch,
            "material.shear_modulus": stretch * float(rng.uniform(0.0, 0.3)),
            "material.damping": damping,
            "material.density": log_uniform(rng, *DENSITIES),
            "bending.model": model,
            "wind.normal_drag": 0.0,
            "air.drag": float(rng.choice([0.0, 0.2])),
            "grippers": ["left", "right"][: int(rng.integers(1, 3))],
            "gripper.radius": float(rng.uniform(0.2, 0.6)) * height,
            "gripper.stiffness": log_uniform(rng, 100.0, 3000.0),
        }
        if model in ("axial", "opposite"):
            values["bending.stiffness"] = stretch * float(rng.uniform(0.0, 0.1))
        elif model != "none":
            values["material.bending_modulus"] = log_uniform(rng, 1e-7, 1e-3)
        try:
            scene = Scene.from_parameters(values)
        except ParameterError:
            # Some materials are not possible on some grids.
            continue
        words = f"{rows} x {columns}, {stretch:.2g} N/m, k_d0 {damping:.2g}, {model}, {scene.rate:g} Hz"
        return scene, rng, f"{words}, tolerance {scene.tolerance:.1e} m"


def run_violent(case: tuple[int, int]) -> ViolentResult:
    """Run one scene to its end."""
    scene, rng, words = violent_scene(*case)
    simulation = Simulation(scene)
    grasped_frames = max(3, round(GRASPED_DURATION * scene.rate))
    frames = grasped_frames + max(3, round(FREE_DURATION * scene.rate))
    account: EnergyAccount | None = None
    flagged = max_evaluations = n_done = 0
    longest = total = 0.0
    names, trouble = dict[str, None](), ""
    evaluation = 1e-9 * simulation.plan.step_cost * simulation.state.particle_count
    cap = scene.work_limit * scene.period / evaluation
    for frame in range(frames):
        begin = time.perf_counter()
        try:
            advance = simulation.advance(_events(simulation, rng, frame, grasped_frames)).advance
        except (UnstableError, ValueError) as error:
            trouble = f"frame {frame}: {error}"
            break
        seconds = time.perf_counter() - begin
        total, longest, n_done = total + seconds, max(longest, seconds), n_done + 1
        if advance is not None:
            flagged += advance.flagged > 0
            max_evaluations = max(max_evaluations, advance.evaluations)
            names[advance.integrator] = None
        if frame == grasped_frames:
            # No gripper acts from now on. The scale of a sheet at rest is its weight's work over the tolerance.
            lift = 9.81 * simulation.model.mass * scene.tolerance
            account = EnergyAccount(simulation, max(kinetic_energy(simulation), lift))
        elif account is not None:
            account.add_frame()
    return ViolentResult(
        index=case[1],
        words=words,
        finite=bool(np.isfinite(simulation.state.x).all() and np.isfinite(simulation.state.v).all()),
        gain=0.0 if account is None else account.gain,
        frames=n_done,
        flagged=flagged,
        evaluations=max_evaluations,
        of_cap=max_evaluations / cap,
        seconds=longest,
        total=total,
        integrators=", ".join(names),
        trouble=trouble,
    )


def _events(simulation: Simulation, rng: np.random.Generator, frame: int, held: int) -> list[Event]:
    """Return the events before a frame: all grippers grasp, jump, and release."""
    names = simulation.scene.gripper_names
    if frame == 0:
        positions = [simulation.state.x[:, rng.integers(simulation.state.particle_count)] for _ in names]
        targets = [Target(name, tuple(position)) for name, position in zip(names, positions, strict=True)]
        return [*targets, *(Grasp(name, True) for name in names)]
    if frame == held:
        return [Grasp(name, False) for name in names]
    if frame > held:
        return []
    events: list[Event] = []
    size = max(simulation.scene.cloth.size)
    for pose, name in zip(simulation.grippers.poses(), names, strict=True):
        displacement = rng.normal(size=3)
        displacement *= rng.uniform(0.0, size / 3.0) / np.linalg.norm(displacement)
        orientation = rng.normal(size=4) if rng.random() < 0.2 else None
        target_orientation = None if orientation is None else drawn_alike(orientation)
        events.append(Target(name, drawn_alike(pose[:3] + displacement), target_orientation))
    return events


def violent(options: argparse.Namespace) -> Report:
    """Run the violent scenes of a seed."""
    report = Report("Violent scenes")
    cases = [(options.seed, index) for index in range(options.count)]
    done = CasePool(options.jobs, options.limit, options.resume).report(
        run_violent,
        cases,
        report,
        name=lambda case: f"scene {case[1]}",
        describe=lambda result: " | ".join(str(cell) for cell in _row(result)),
        kinds=(tuple[int, int], ViolentResult),
    )
    results = [result for _, result in done]
    columns = ["scene", "what", "gain", "flagged", "most evaluations", "of the cap", "longest s", "all s"]
    columns += ["integrators", "trouble"]
    for name, key in (
        ("Most expensive frames", lambda result: -result.seconds),
        ("Largest energy gain", lambda result: -result.gain),
        ("Most flagged frames", lambda result: -result.flagged / max(1, result.frames)),
    ):
        rows = [_row(result) for result in sorted(results, key=key)[:_N_LISTED]]
        report.tables.append(Table(name, columns, rows))
    frames, flagged = sum(result.frames for result in results), sum(result.flagged for result in results)
    share = flagged / max(1, frames)
    n_often_flagged = sum(result.flagged > 0.1 * result.frames for result in results)
    report.notes += [
        f"{len(results)} scenes, {frames} frames, {share:.2%} of them flagged; {n_often_flagged} scenes with more than "
        "a tenth",
        f"longest frame {_largest(results, 'seconds'):.3g} s, most evaluations {_largest(results, 'evaluations'):g}, "
        f"at most {_largest(results, 'of_cap'):.3g} of the cap; frames above a second in "
        f"{sum(result.seconds > 1.0 for result in results)} scenes",
        f"largest gain of energy {_largest(results, 'gain'):.3g} of the energy turned over",
    ]
    broken = [result.index for result in results if not result.finite or result.trouble]
    report.require(not broken, f"scenes not finite, or stopped: {broken}")
    gained = [result.index for result in results if not result.gain <= MAX_FREE_ENERGY_GAIN]
    report.require(not gained, f"scenes with a gain above {MAX_FREE_ENERGY_GAIN:g} of the energy: {gained}")
    too_many = f"{share:.2%} of all frames are flagged, more than {MAX_FLAGGED_FRAMES:.0%}"
    report.require(share <= MAX_FLAGGED_FRAMES, too_many)
    return report


def _largest(results: list[ViolentResult], quantity: str) -> float:
    return max((getattr(result, quantity) for result in results), default=0.0)


def _row(result: ViolentResult) -> list[Any]:
    share = f"{result.flagged}/{result.frames}"
    costs = [result.evaluations, result.of_cap, result.seconds, result.total]
    return [result.index, result.words, result.gain, share, *costs, result.integrators, result.trouble]
