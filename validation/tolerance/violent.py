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

from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.scene.parameters import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation
from validation.case_pool import Done, run_missing, shown
from validation.report import Report, Table
from validation.tolerance.random_scenes import DENSITIES, log_uniform

SIDES, MODULI = (2, 33), (30.0, 1e5)
TOLERANCES, RATES = (1e-5, 1e-2), (30, 120)
#: Simulated time [s]: with grasped particles, and free.
HELD, ALONE = 0.6, 0.6
#: Largest energy gain while no gripper acts, relative to the energy turned over.
LARGEST_GAIN = 0.01
#: Largest fraction of flagged frames.
MOST_FLAGGED = 0.05
_DEAREST = 10


@attrs.frozen(kw_only=True)
class Violence:
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


def run_violent(case: tuple[int, int]) -> Violence:
    """Run one scene to its end."""
    scene, rng, words = violent_scene(*case)
    simulation = Simulation(scene)
    held = max(3, round(HELD * scene.rate))
    frames = held + max(3, round(ALONE * scene.rate))
    account = _Account(simulation)
    flagged = most = done = 0
    longest = total = 0.0
    names, trouble = dict[str, None](), ""
    evaluation = 1e-9 * simulation.plan.step_cost * simulation.state.particle_count
    cap = scene.work_limit * scene.period / evaluation
    for frame in range(frames):
        begin = time.perf_counter()
        try:
            advance = simulation.advance(_events(simulation, rng, frame, held)).advance
        except (UnstableError, ValueError) as error:
            trouble = f"frame {frame}: {error}"
            break
        seconds = time.perf_counter() - begin
        total, longest, done = total + seconds, max(longest, seconds), done + 1
        if advance is not None:
            flagged += advance.flagged > 0
            most = max(most, advance.evaluations)
            names[advance.integrator] = None
        account.look(alone=frame > held)
    return Violence(
        index=case[1],
        words=words,
        finite=bool(np.isfinite(simulation.state.x).all() and np.isfinite(simulation.state.v).all()),
        gain=account.gain,
        frames=done,
        flagged=flagged,
        evaluations=most,
        of_cap=most / cap,
        seconds=longest,
        total=total,
        integrators=", ".join(names),
        trouble=trouble,
    )


def _events(simulation: Simulation, rng: np.random.Generator, frame: int, held: int) -> list[Event]:
    """Return the events before a frame: all grippers grasp, jump, and release."""
    names = simulation.scene.gripper_names
    if frame == 0:
        places = [simulation.state.x[:, rng.integers(simulation.state.particle_count)] for _ in names]
        targets = [Target(name, tuple(place)) for name, place in zip(names, places, strict=True)]
        return [*targets, *(Grasp(name, True) for name in names)]
    if frame == held:
        return [Grasp(name, False) for name in names]
    if frame > held:
        return []
    events: list[Event] = []
    size = max(simulation.scene.cloth.size)
    for pose, name in zip(simulation.grippers.poses(), names, strict=True):
        leap = rng.normal(size=3)
        leap *= rng.uniform(0.0, size / 3.0) / np.linalg.norm(leap)
        turn = rng.normal(size=4) if rng.random() < 0.2 else None
        events.append(Target(name, drawn_alike(pose[:3] + leap), None if turn is None else drawn_alike(turn)))
    return events


class _Account:
    """Energy account of the free phase."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._least: float | None = None
        self._kinetic = self._turned = 0.0
        #: Largest rise above the energy at the end of any earlier frame, relative to the energy turned over.
        self.gain = 0.0

    def look(self, *, alone: bool) -> None:
        """Account for a frame; `is_free`: no gripper acted during it."""
        energy = self._simulation.energy()
        v = self._simulation.state.v
        kinetic = 0.5 * float(np.sum(self._simulation.model.masses * v * v))
        if alone and self._least is not None:
            self._turned += abs(kinetic - self._kinetic)
            # A sheet at rest turns over no energy.
            scale = max(self._turned, self._least_scale())
            self.gain = max(self.gain, (energy - self._least) / scale)
            self._least = min(self._least, energy)
        else:
            self._least, self._turned = energy, kinetic
        self._kinetic = kinetic

    def _least_scale(self) -> float:
        """Return the work that lifts the sheet by the tolerance [J]."""
        return 9.81 * self._simulation.model.mass * self._simulation.scene.tolerance


def violent(options: argparse.Namespace) -> Report:
    """Run the violent scenes of a seed."""
    from tqdm import tqdm

    report = Report(
        "Violent scenes", f"python -m validation tolerance --violent --seed {options.seed} --count {options.count}"
    )
    cases = [(options.seed, index) for index in range(options.count)]
    found: list[Violence] = []
    limits = {"workers": options.jobs, "limit": options.limit}
    dones = run_missing(run_violent, cases, **limits, file=options.resume, read=_read)
    for done in shown(dones, len(cases), "scene"):
        if done.result is None:
            report.failures.append(f"scene {done.case[1]}: {done.trouble}")
        else:
            found.append(done.result)
            tqdm.write(" | ".join(str(cell) for cell in _row(done.result)))
    columns = [
        "scene",
        "what",
        "gain",
        "flagged",
        "most evaluations",
        "of the cap",
        "longest s",
        "all s",
        "integrators",
        "trouble",
    ]
    chosen = {
        "Most expensive frames": sorted(found, key=lambda each: -each.seconds)[:_DEAREST],
        "Largest energy gain": sorted(found, key=lambda each: -each.gain)[:_DEAREST],
        "Most flagged frames": sorted(found, key=lambda each: -each.flagged / max(1, each.frames))[:_DEAREST],
    }
    for name, some in chosen.items():
        report.tables.append(Table(name, columns, [_row(each) for each in some]))
    frames, flagged = sum(each.frames for each in found), sum(each.flagged for each in found)
    share = flagged / max(1, frames)
    often = sum(each.flagged > 0.1 * each.frames for each in found)
    report.notes += [
        f"{len(found)} scenes, {frames} frames, {share:.2%} of them flagged; {often} scenes with more than a tenth",
        f"longest frame {max((each.seconds for each in found), default=0.0):.3g} s, most evaluations "
        f"{max((each.evaluations for each in found), default=0)}, at most "
        f"{max((each.of_cap for each in found), default=0.0):.3g} of the cap; frames above a second in "
        f"{sum(each.seconds > 1.0 for each in found)} scenes",
        f"largest gain of energy {max((each.gain for each in found), default=0.0):.3g} of the energy turned over",
    ]
    for what, some in (
        ("not finite, or stopped", [each for each in found if not each.finite or each.trouble]),
        (
            f"with a gain above {LARGEST_GAIN:g} of the energy",
            [each for each in found if not each.gain <= LARGEST_GAIN],
        ),
    ):
        if some:
            report.failures.append(f"scenes {what}: {', '.join(str(each.index) for each in some)}")
    if share > MOST_FLAGGED:
        report.failures.append(f"{share:.2%} of all frames are flagged, more than {MOST_FLAGGED:.0%}")
    return report


def _read(entry: dict[str, Any]) -> Done[tuple[int, int], Violence]:
    seed, index = entry["case"]
    result = entry["result"]
    return Done((seed, index), result and Violence(**result), entry["seconds"], entry["trouble"])


def _row(each: Violence) -> list[Any]:
    share = f"{each.flagged}/{each.frames}"
    costs = [each.evaluations, each.of_cap, each.seconds, each.total]
    return [each.index, each.words, each.gain, share, *costs, each.integrators, each.trouble]
