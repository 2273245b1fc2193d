# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Additivity of costs: two features together against each of them alone.

The bound is (AB - base) <= 1.1 ((A - base) + (B - base)) + 0.02 base. All cloths take the same fixed steps, so that
step control does not affect the comparison.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import attrs
import numpy as np
from support import garment
from support.problems import PERIOD
from support.random_meshes import shuffled_mesh

from benchmarks.timing import time_interleaved
from cloth_sim_ros import Force, Grasp, Model, Plan, Scene, Simulation, Target, compile
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.simulation.events import Event
from validation.command import above, at_least
from validation.report import Report, Table, print_progress

#: Scene to which features are added.
DEFAULT_CLOTH = Path(__file__).resolve().parents[2] / "config" / "cloth_sim.yaml"
#: Bound of AB - base: factor of the sum, plus share of base.
TIMES, SHARE = 1.1, 0.02
SHEETS = ("grid", "mesh")
#: Bending models, of which a cloth has at most one.
BENDINGS = ("opposite", "crossed", "altitude", "quadratic")
FEATURES = (*BENDINGS, "air", "added-mass", "gripper", "numpy", "energy")
#: Fixed step as a share of the smallest stability limit of the compared cloths.
_STEP_SHARE = 0.8
#: Frames of one turn, and warm-up frames in which the gripper grasps.
_FRAMES, _WARM = 8, 3
#: Angular speed [rad/s] and speed [m/s] of the gripper.
_TURN, _SPEED = 1.0, 0.2


class Floor(Force):
    """User-defined force in numpy: a soft floor that pushes particles up."""

    name = "floor"

    def __init__(self, level: float, stiffness: float) -> None:
        self.level, self.stiffness = level, stiffness

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        f[2] += self.stiffness * np.maximum(self.level - x[2], 0.0)

    def energy(self, t: float, x: Array) -> float:
        below = np.maximum(self.level - x[2], 0.0)
        return 0.5 * self.stiffness * float(np.sum(below * below))

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        blocks[2] += self.stiffness


class FlooredScene(Scene):
    """Scene with a soft floor."""

    def plan(self) -> Plan:
        """Return the plan of the scene's forces and the floor."""
        model = self.model()
        return compile(Model(model.masses, [*model.forces, Floor(0.7, 0.01)], anchors=model.anchors))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--sheets", nargs="+", choices=SHEETS, default=SHEETS, help="kinds of cloth")
    parser.add_argument("--features", nargs="+", choices=FEATURES, default=FEATURES, help="that are paired")
    parser.add_argument("--resolution", type=at_least(4), default=30, metavar="N", help="particles a side")
    parser.add_argument("--seconds", type=above(0.0), default=90.0, help="of timing for each kind of cloth")


def run(options: argparse.Namespace) -> Report:
    """Measure all pairs."""
    report = Report("Costs add up")
    for sheet in options.sheets:
        add(sheet, measured(sheet, options), report)
    report.note(
        "frames with equal fixed steps, processor time, medians of rounds in turns, each round relative to its base; "
        f"at most: {TIMES:g} times the sum of what each adds alone, + {SHARE:.0%} of base"
    )
    return report


@attrs.frozen
class Cost:
    """Frame times by features, relative to base of the same round."""

    #: Frame time of base [s], and steps per frame.
    base: float
    steps: int
    times: Mapping[frozenset[str], float]


def pairs(features: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return all pairs of features that one cloth can have."""
    return [(a, b) for a, b in itertools.combinations(features, 2) if not (a in BENDINGS and b in BENDINGS)]


def add(sheet: str, cost: Cost, report: Report) -> None:
    """Add a table of all pairs of a kind of cloth to a report."""
    alone = Table(f"{sheet}: frames with one feature", ["feature", "ms", "to base"])
    alone.rows.append(["base", 1e3 * cost.base, 1.0])
    columns = ["A", "B", "A - base", "B - base", "AB - base", "AB to the sum", "at most", "holds"]
    together = Table(f"{sheet}: frames with two features, shares of base", columns)
    for names, time_ in cost.times.items():
        if len(names) == 1:
            alone.rows.append([*names, 1e3 * cost.base * time_, time_])
            continue
        a, b = sorted(names, key=FEATURES.index)
        first, second, both = (cost.times[frozenset(of)] - 1.0 for of in ([a], [b], [a, b]))
        most = TIMES * (first + second) + SHARE
        holds = both <= most
        together.rows.append([a, b, first, second, both, both / (first + second), most, "yes" if holds else "no"])
        report.require(holds, f"{sheet}, {a} and {b}: together {both:.3g} of base more; at most {most:.3g}")
    report.tables += [alone, together]
    report.note(f"{sheet}: {cost.steps} steps a frame")


def measured(sheet: str, options: argparse.Namespace) -> Cost:
    """Time frames of a kind of cloth without features, with each one, and with each pair."""
    feature_sets = [frozenset[str](), *(frozenset([name]) for name in options.features)]
    feature_sets += [frozenset(pair) for pair in pairs(tuple(options.features))]
    limit = min(_limit(scene(sheet, options.resolution, names)) for names in feature_sets)
    steps = math.ceil(PERIOD / (_STEP_SHARE * limit))
    step = PERIOD / steps
    print_progress(f"{sheet}: {len(feature_sets)} cloths, {steps} steps a frame")
    turns = time_interleaved(
        {str(k): turn(scene(sheet, options.resolution, names, step=step)) for k, names in enumerate(feature_sets)},
        seconds=options.seconds,
        clock=time.process_time,
    )
    times = {names: turns.ratio(str(k), "0") for k, names in enumerate(feature_sets) if names}
    return Cost(base=turns.median("0") / _FRAMES, steps=steps, times=times)


def scene(sheet: str, resolution: int, features: frozenset[str], *, step: float = 0.0) -> Scene:
    """Return the default cloth as grid or irregular mesh, without bending and gripper, with features added."""
    values = parameter_file.read(DEFAULT_CLOTH, node="cloth_sim", strict=True)
    # Drag normal to the sheet is a feature.
    values |= {"wind.normal_drag": 0.0, "integrator": "leapfrog", "step": step, "grippers": [""]}
    files: dict[str, bytes] = {}
    if sheet == "grid":
        values["cloth.resolution"] = [resolution, resolution]
    else:
        rest_positions, triangles = shuffled_mesh(resolution**2)
        files["mesh.obj"] = garment.as_obj(rest_positions - [0.5, 0.5, 0.0], triangles)
        edge = np.flatnonzero(rest_positions[:, 1] == rest_positions[:, 1].max())
        values |= {"cloth.mesh": "mesh.obj", "cloth.anchors": [str(particle) for particle in edge.tolist()]}
        del values["cloth.size"], values["cloth.resolution"]
    bending = next((name for name in BENDINGS if name in features), "none")
    values["bending.model"] = bending
    if bending in ("crossed", "altitude", "quadratic"):
        values["material.bending_modulus"] = 1e-5
    if "air" in features:
        values |= {"wind.velocity": [0.0, 1.0, 0.0], "wind.normal_drag": 0.2, "wind.tangential_drag": 0.05}
    if "added-mass" in features:
        values["air.added_mass"] = 0.07
    if "gripper" in features:
        values["grippers"] = ["gripper"]
    values["diagnostics.energy"] = "energy" in features
    kind = FlooredScene if "numpy" in features else Scene
    return kind.from_parameters(values, files=files)


def turn(configuration: Scene) -> Callable[[], None]:
    """Return a function that runs some frames of a scene from a fixed state."""
    simulation = Simulation(configuration)
    corner = lower_corner(simulation)

    def events(frame: int) -> list[Event]:
        if not configuration.gripper_names:
            return []
        t = (frame + 1) * PERIOD
        half = 0.5 * _TURN * t
        orientation = (0.0, 0.0, math.sin(half), math.cos(half))
        return [Target("gripper", corner + np.array([0.0, _SPEED * t, 0.0]), orientation)]

    if configuration.gripper_names:
        done = simulation.advance([Target("gripper", corner), Grasp("gripper", True)])
        if not done.grasps[0].grasped_count:
            raise RuntimeError(f"the gripper holds nothing: {done.grasps[0].reason}")
    for frame in range(_WARM):
        simulation.advance(events(frame))
    start = simulation.state.copy()

    def frames() -> None:
        simulation.state.restore(start)
        for frame in range(_WARM, _WARM + _FRAMES):
            done = simulation.advance(events(frame))
            if not (done.advance and done.advance.steps):
                raise RuntimeError(f"frame {done.index} was not computed: the cloth sleeps")

    return frames


def lower_corner(simulation: Simulation) -> Array:
    """Return the position of the lower right particle of a hung sheet [m], (3,)."""
    positions = simulation.positions
    return np.asarray(positions[np.argmax(positions[:, 0] - positions[:, 2])])


def _limit(configuration: Scene) -> float:
    """Return the longest stable step of a scene's initial, grasped cloth [s]."""
    simulation = Simulation(attrs.evolve(configuration, step=0.0))
    if configuration.gripper_names:
        simulation.advance([Target("gripper", lower_corner(simulation)), Grasp("gripper", True)])
    return leapfrog_limit(*simulation.plan.spectral_bounds(simulation.state.x))
