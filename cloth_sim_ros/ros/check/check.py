# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_sim --check scene.yaml`: cloth, expected speed and step limit, without a graph."""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.ros.check import node_refusals
from cloth_sim_ros.ros.check.feasibility import check_feasibility
from cloth_sim_ros.ros.check.performance_estimate import PerformanceEstimator, measure_step_cost
from cloth_sim_ros.ros.check.step_limiters import describe_step_limiters, find_step_limiters
from cloth_sim_ros.ros.check.unknown_overrides import unknown_sentences
from cloth_sim_ros.ros.process.options import parser
from cloth_sim_ros.ros.recording.initial_state import session_state
from cloth_sim_ros.scene.build import joined_particles, obstacle_joints
from cloth_sim_ros.scene.mesh_notes import mesh_notes, silence_mesh_log
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.plausibility import cloth_size, implausible_sizes
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.console import escape_unencodable
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.simulation import Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.bodies.obstacles import Obstacles

#: Length of the trial run: simulated time [s], and its limit in wall time [s].
_TRIAL_TIME, _TRIAL_TIMEOUT = 1.0, 5.0


def main(arguments: Sequence[str]) -> int:
    """Run `cloth_sim --check FILE`: print its cloth, or why the node would refuse it; return the exit status.

    Returns:
        Exit status: 0; 1 if the node would refuse the file; 130 if a signal ended the command.
    """
    escape_unencodable()
    options = parser().parse_args(arguments)
    try:
        status = check(options.check, node=options.node)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the output (head, less) has ended. Python's buffered output must go nowhere at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 130
    return status


def check(path: str, *, node: str) -> int:
    """Print cloth, warnings, speed and step limit of a parameter file; return 0, or 1 if the node would refuse it.

    Returns:
        Exit status: 0; 1 if the node would refuse the file, with the node's message.
    """
    values: dict[str, Any] = {}
    try:
        text = parameter_file.read_text(path)
        values = parameter_file.parse(text, node=node, source=path)
        node_refusals.refuse_values(values)
        known = {entry.name for entry in Scene.declared_for(values)}
        scene_values = {name: value for name, value in values.items() if name in known}
        silence_mesh_log()
        scene = _scene(scene_values)
        node_refusals.refuse_scene(scene, node=node)
        simulation = Simulation(scene)
        check_feasibility(scene, simulation)
        cost = measure_step_cost(scene)
    except ValueError as error:
        for sentence in error.sentences if isinstance(error, ParameterError) else [str(error)]:
            print(f"cloth_sim: {sentence}{node_refusals.hint_at_folder(sentence, values, path)}", file=sys.stderr)
        return 1
    full = f"/{node.strip('/')}"
    if not values:
        owners = parameter_file.other_nodes(text, node=node, source=path)
        print(f"warning: '{path}' sets nothing for the node {full}: all has its default{owners and f'; {owners}'}")
    notes, warnings = mesh_notes(scene)
    if (recovery := simulation.contact_recovery) is not None:
        warnings.append(f"the cloth starts {recovery.describe()}")
    warnings += implausible_sizes(scene, simulation.state.x, simulation.model.masses)
    for sentence in [
        *unknown_sentences(values, known, scene, node=full),
        *ineffective_parameters(scene, scene_values),
        *warnings,
    ]:
        print(f"warning: {sentence}")
    for sentence in notes:
        print(sentence)
    _print_cloth(scene, simulation)
    limiters = find_step_limiters(simulation.plan, simulation.state.x)
    estimator = PerformanceEstimator(simulation, _PrintLog())
    estimator.calibrate(cost)
    estimator.report()
    _print_trial(Simulation(scene))
    for line in describe_step_limiters(limiters, scene.sheet):
        print(line)
    return 0


def _scene(values: dict[str, Any]) -> Scene:
    """Build the scene of parameters, with a robot's links as obstacles if `robot.description_file` is set; print notes.

    Raises:
        ParameterError: for invalid parameters, or an invalid description.
    """
    files = session_state(str(values.get("initial_state", "")))
    if values.get("robot.enabled") is not True:
        return Scene.from_parameters(values, files=files)
    if not values.get("robot.description_file"):
        print(
            "warning: the robot's description comes by a topic, so its links are not checked (robot.description_file)"
        )
        return Scene.from_parameters(values, files=files)
    from cloth_sim_ros.scene.robot.links import scene_with_links, without_links

    scene, links = scene_with_links(Scene.from_parameters(without_links(values), files=files), values)
    for note in links.notes:
        print(note)
    return scene


class _PrintLog:
    """Logger that prints messages to standard output."""

    def info(self, text: str) -> None:
        print(text)

    def warning(self, text: str) -> None:
        print(f"warning: {text}")


def _print_cloth(scene: Scene, simulation: Simulation) -> None:
    rows, columns = scene.shape
    if scene.cloth.mesh:
        source = f"the mesh {scene.cloth.mesh}"
    elif scene.cloth.springs:
        source = f"the springs of {scene.cloth.springs}"
    else:
        source = f"a grid of {rows} x {columns}"
    count, anchored = simulation.state.particle_count, len(simulation.model.anchors)
    forces = ", ".join(force.name for force in simulation.model.forces)
    print(f"{source}: {count} particles, {anchored} anchored; forces: {forces}")
    if len(pairs := joined_particles(scene, scene.sheet)):
        away = simulation.state.x[:, pairs[:, 1]] - simulation.state.x[:, pairs[:, 0]]
        print(f"{pluralize(len(pairs), 'joint')}, at most {np.linalg.norm(away, axis=0).max():.3g} m long at the start")
    for obstacle, n_joints in Counter(name for name, _ in obstacle_joints(scene, scene.sheet)).items():
        print(f"{pluralize(n_joints, 'joint')} to obstacle '{obstacle}'")
    if sentence := _describe_rest_angles(scene):
        print(sentence)
    print(cloth_size(scene, simulation.state.x, simulation.model.masses))
    control = f"step {scene.step:g} s" if scene.step else f"tolerance {scene.tolerance:g} m"
    print(f"{scene.rate:g} frames a second; {control}; grippers: {', '.join(scene.gripper_names) or 'none'}")
    if (ratio := scene.poisson_ratio) is not None:
        origin = "" if scene.membrane.model == "triangles" else ", which follows from the moduli"
        print(f"Poisson's ratio{origin}: {ratio:.3f}")
    if simulation.obstacles is not None:
        _print_obstacles(scene, simulation.obstacles)


def _describe_rest_angles(scene: Scene) -> str:
    """Return a sentence on the rest angles of hinges if parameters set any; otherwise an empty text."""
    bending = scene.bending
    if bending.model in ("none", "axial") or not (bending.flat or bending.rest_angle or bending.rest_angles):
        return ""
    shape = (
        f"at {bending.rest_angle:g} rad" if bending.rest_angle else "flat" if bending.flat else "as in the rest shape"
    )
    return f"hinges rest {shape}" + (f", single edges by {bending.rest_angles}" if bending.rest_angles else "")


def _print_obstacles(scene: Scene, obstacles: Obstacles) -> None:
    for solid in obstacles.solids:
        at_rest, moving = solid.friction
        size = f" of {' x '.join(f'{length:g}' for length in solid.size)} m" if solid.size else ""
        gap, particle = obstacles.nearest(solid.name)
        print(
            f"obstacle '{solid.name}': {solid.shape}{size}, friction {at_rest:g} at rest and {moving:g} in motion; the "
            f"nearest particle, {particle}, starts {gap:.3g} m away; it pushes from {scene.contact.thickness:g} m on"
        )
    if not len(scene.sheet.triangles()):
        print("only particles touch: the file of cloth.springs has no triangles")


def _print_trial(simulation: Simulation) -> None:
    """Advance a simulation by 1 s, for at most 5 s of wall time; print integrator, frame times and real-time factor."""
    period = simulation.scene.period
    frame_times: list[float] = []
    advances: list[Advance] = []
    end = time.perf_counter() + _TRIAL_TIMEOUT
    try:
        while simulation.time < _TRIAL_TIME and time.perf_counter() < end:
            start = time.perf_counter()
            advance = simulation.advance().advance
            frame_times.append(time.perf_counter() - start)
            if advance is not None:
                advances.append(advance)
    except UnstableError as error:
        print(f"warning: after {simulation.time:.3g} s of motion time would be stopped: {error}")
    if not advances:
        return
    steps = statistics.median(advance.steps for advance in advances)
    print(f"integrator: {advances[-1].integrator}, {steps:g} steps a frame; {advances[-1].reason}")
    median, longest = statistics.median(frame_times), max(frame_times)
    factor = len(frame_times) * period / sum(frame_times)
    frames = pluralize(len(frame_times), "frame")
    print(
        f"tried here: the first {frames} took {median * 1e3:.3g} ms of {period * 1e3:.3g} ms each "
        f"(median; the longest {longest * 1e3:.3g} ms), real-time factor {factor:.3g}; "
        f"steps were mostly set by: {statistics.mode(advance.limited_by for advance in advances)}"
    )
