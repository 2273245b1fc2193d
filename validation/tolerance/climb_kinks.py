# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Families of few numbers with kinks of forces, which the search for violations climbs over.

One or two particles move without damping, at tight tolerances. The fewer numbers a scene has, the sooner a climb places
a kink where an error estimate misses it.
"""

from __future__ import annotations

import json
import math
from typing import Any

import attrs
import numpy as np
from support.error_bound import SPRINGS

from cloth_sim_ros import Grasp, Scene, Target
from validation.tolerance.climb_scenes import DURATION, Trial, evaluate_frames, evaluate_trial
from validation.tolerance.random_scenes import RandomScene, log_uniform

#: Local errors of DOP853, relative to the coordinates: of the reference, and of the run that checks it.
_FINE, _ROUGH = 1e-13, 1e-12
#: Size of perturbations relative to the tolerance, and their smallest size [m, m/s].
_PERTURBATION_FRACTION, _MIN_PERTURBATION = 0.1, 1e-8
#: Step counts of single runs as a reference where friction jumps, and of the run that checks it.
_JUMP_STEPS, _FEW_JUMP_STEPS = (2500,), (1500,)
#: Tables of springs without a spring.
_NO_SPRINGS = {"masses": 1.0, "springs": [], "rest_lengths": 1.0, "stiffness": 1.0}


def stiffening(rng: np.random.Generator) -> Trial:
    """Evaluate one or two cells of membrane triangles that stiffen, dropped from their upper edge."""
    values = _hung_cells(rng, [2, int(rng.integers(2, 4))])
    values |= {
        "membrane.model": "triangles",
        "material.poisson_ratio": 0.0,
        "material.stretch_modulus_weft": values["material.stretch_modulus"],
        "material.warp_direction": [1.0, float(rng.uniform(-1.0, 1.0)), 0.0],
    }
    for name in ("warp", "weft"):
        values[f"material.{name}_stiffening"] = [log_uniform(rng, 0.002, 0.2), log_uniform(rng, 2.0, 30.0)]
    return _evaluate_sheet(values, "drops")


def gust(rng: np.random.Generator) -> Trial:
    """Evaluate one cell in wind that changes once."""
    values = _hung_cells(rng, [2, 2])
    values |= {"wind.normal_drag": log_uniform(rng, 0.02, 2.0), "wind.velocity": rng.uniform(-4.0, 4.0, 3).tolist()}
    frame = int(rng.integers(1, int(values["rate"])))
    changes = {frame: {"wind.velocity": rng.uniform(-4.0, 4.0, 3).tolist()}}
    return _evaluate_sheet(values, f"gust in frame {frame}", changes=changes)


def hinges(rng: np.random.Generator) -> Trial:
    """Evaluate two rows of cells whose hinges are thrown over."""
    values = _hung_cells(rng, [3, 2])
    width = values["cloth.size"][0]
    values |= {
        "cloth.size": [2.0 * width, width],
        "bending.model": str(rng.choice(["crossed", "altitude"])),
        "material.bending_modulus": log_uniform(rng, 1e-4, 1e-1),
        "bending.rest_angle": float(rng.uniform(-0.5, 0.5)),
    }
    return _evaluate_sheet(values, "thrown", speed=log_uniform(rng, 0.1, 6.0))


def yielding(rng: np.random.Generator) -> Trial:
    """Evaluate a hinge with friction of bending, whose wing swings."""
    rate, tolerance = rate_and_tolerance(rng)
    edge = log_uniform(rng, 0.03, 0.5)
    width, mass = edge * float(rng.uniform(0.5, 1.1)), log_uniform(rng, 0.003, 0.5)
    fold, speed = float(rng.uniform(0.5, 2.8)), log_uniform(rng, 0.003, 1.0)
    modulus = log_uniform(rng, 1e-5, 1.0)
    moment, curvature = modulus * log_uniform(rng, 0.05, 3.0), log_uniform(rng, 0.05, 3.0)
    tip, along = [math.cos(fold), 0.0, math.sin(fold)], [-math.sin(fold), 0.0, math.cos(fold)]
    wing = [width * tip[0], 0.5 * edge, width * tip[2]]
    tables = {
        "positions": [[0.0, 0.0, 0.0], [0.0, edge, 0.0], [-edge, 0.5 * edge, 0.0], wing],
        "velocities": [[0.0] * 3] * 3 + [[speed * component for component in along]],
        "masses": [1.0, 1.0, 1.0, mass],
        "springs": [[0, 1], [0, 2], [1, 2], [0, 3], [1, 3]],
        "rest_lengths": [edge, *[math.hypot(edge, 0.5 * edge)] * 2, *[math.hypot(width, 0.5 * edge)] * 2],
        "stiffness": log_uniform(rng, 1.0, 100.0),
        "k_d0": 0.0,
        "triangles": [[0, 1, 2], [1, 0, 3]],
    }
    values = {
        "cloth.anchors": ["0", "1", "2"],
        "bending.model": "crossed",
        "bending.flat": True,
        "bending.friction_moment": moment,
        "bending.yield_curvature": curvature,
        "material.bending_modulus": modulus,
        "material.damping": 0.0,
        "gravity": [0.0, 0.0, 0.0],
    }
    scene = spring_scene(tables, {"rate": rate, "tolerance": tolerance, **values})
    draw = RandomScene(scene=scene, state=scene.starting_state(), frames=frame_count(rate), words="yields")
    return evaluate_trial(draw, {**scene.parameters(), **tables})


def gliding(rng: np.random.Generator) -> Trial:
    """Evaluate a particle that glides over an edge of a box or over the ridge of a mesh."""
    rate, tolerance = rate_and_tolerance(rng)
    thickness, gravity = log_uniform(rng, 0.05, 1.0), log_uniform(rng, 0.1, 10.0)
    height, x = float(rng.uniform(0.6, 1.05)) * thickness, -float(rng.uniform(0.0, 0.6))
    velocity = [float(rng.uniform(0.2, 2.0)), 0.0, float(rng.uniform(-0.3, 0.3))]
    slope, is_mesh = float(rng.uniform(0.0, 0.5)), rng.random() < 0.5
    tables = _NO_SPRINGS | {
        "positions": [[x, 0.1, 3.0 * thickness + 3.0], [x, 0.1, height]],
        "velocities": [[0.0] * 3, velocity],
    }
    body: dict[str, Any] = {"thing.shape": "mesh", "thing.mesh": "thing.obj"}
    if not is_mesh:
        body = {"thing.shape": "box", "thing.size": [8.0, 8.0, 8.0]}
    values = {"rate": rate, "tolerance": tolerance, "gravity": [0.0, 0.0, -gravity], "contact.thickness": thickness}
    corner = (0.0, 0.0, 0.0) if is_mesh else (-4.0, 0.0, -4.0)
    scene = spring_scene(tables, values | body, corner, {"thing.obj": _ridge(slope)} if is_mesh else {})
    return _evaluate_contact(rng, scene, "glides", tables)


def landing(rng: np.random.Generator) -> Trial:
    """Evaluate a particle that falls on a plane, or on a triangle of the same cloth."""
    rate, tolerance = rate_and_tolerance(rng)
    thickness, gravity = log_uniform(rng, 0.1, 1.0), log_uniform(rng, 0.1, 10.0)
    speed, is_layer = float(rng.uniform(0.0, 0.5)), rng.random() < 0.5
    time = (int(rng.integers(2, min(12, int(rate)))) - log_uniform(rng, 1e-3, 0.5)) / rate
    height = thickness + speed * time + 0.5 * gravity * time * time
    values: dict[str, Any] = {"rate": rate, "tolerance": tolerance, "gravity": [0.0, 0.0, -gravity]}
    values["contact.thickness"] = thickness
    if is_layer:
        tables = _NO_SPRINGS | {
            "positions": [[-3.0, -3.0, 0.0], [3.0, -3.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, height], [20.0, 0.0, 0.0]],
            "velocities": [[0.0] * 3] * 3 + [[0.0, 0.0, -speed], [0.0] * 3],
            "triangles": [[0, 1, 2]],
        }
        values |= {"cloth.anchors": ["0", "1", "2", "4"], "contact.self": True, "contact.friction": [0.0, 0.0]}
        scene = spring_scene(tables, values)
    else:
        tables = _NO_SPRINGS | {
            "positions": [[0.0, 0.0, 3.0 * height], [0.0, 0.0, height]],
            "velocities": [[0.0] * 3, [0.0, 0.0, -speed]],
        }
        scene = spring_scene(tables, values | {"thing.shape": "plane"}, (0.0, 0.0, 0.0))
    return _evaluate_contact(rng, scene, "lands", tables)


def sticking(rng: np.random.Generator) -> Trial:
    """Evaluate a particle that touches a plane with friction for a moment, while another one swings."""
    rate, tolerance = rate_and_tolerance(rng)
    thickness, friction = log_uniform(rng, 5e-4, 2e-2), log_uniform(rng, 0.1, 4.0)
    speed, frame = tolerance * log_uniform(rng, 30.0, 2000.0), 2 + int(rng.integers(0, 4))
    slip, time = speed * log_uniform(rng, 0.1, 3.0), (frame + float(rng.uniform(0.0, 1.0))) / rate
    swing, amplitude = log_uniform(rng, 0.5, 6.0), tolerance * log_uniform(rng, 1e3, 1e6)
    tables = {
        "positions": [[0.0, 0.0, 10.0], [amplitude, 0.0, 10.0], [0.0, 0.0, thickness + speed * time]],
        "velocities": [[0.0] * 3, [0.0, amplitude * swing, 0.0], [slip, 0.0, -speed]],
        "masses": 1.0,
        "springs": [[0, 1]],
        "rest_lengths": 0.0,
        "stiffness": swing * swing,
        "k_d0": 0.0,
    }
    values = {
        "rate": rate,
        "tolerance": tolerance,
        "gravity": [0.0, 0.0, 0.0],
        "contact.thickness": thickness,
        "thing.shape": "plane",
    }
    scene = spring_scene(tables, values, (0.0, 0.0, 0.0), friction=friction)
    words = f"friction {friction:.2g}, {speed:.2g} m/s, slips at {slip:.2g} m/s, {rate:g} Hz"
    draw = RandomScene(scene=scene, state=scene.starting_state(), frames=round(rate), words=words)
    size = max(_MIN_PERTURBATION, _PERTURBATION_FRACTION * tolerance)
    trial = evaluate_frames(draw, _JUMP_STEPS, _FEW_JUMP_STEPS, size)
    return attrs.evolve(trial, parameters={**trial.parameters, **tables})


def jaws(rng: np.random.Generator) -> Trial:
    """Evaluate a particle on a spring between the jaws of a parallel gripper that close."""
    rate, tolerance = rate_and_tolerance(rng)
    thickness, frequency = log_uniform(rng, 0.005, 0.1), log_uniform(rng, 0.3, 10.0)
    opening = 2.0 * thickness * float(rng.uniform(1.1, 2.5))
    offset, speed = float(rng.uniform(-0.4, 0.4)) * opening, float(rng.uniform(-0.5, 0.5))
    tables = {
        "positions": [[0.0, 0.0, 1.0], [0.0, offset, 0.0]],
        "velocities": [[0.0] * 3, [0.0, speed, 0.0]],
        "masses": 1.0,
        "springs": [[0, 1]],
        "rest_lengths": 0.0,
        "stiffness": frequency * frequency,
        "k_d0": 0.0,
    }
    values = {
        "rate": rate,
        "tolerance": tolerance,
        "gravity": [0.0, 0.0, -frequency * frequency],
        "grippers": ["hand"],
        "gripper.mode": "pinch",
        "gripper.max_speed": 0.0,
        "gripper.pad_size": [2.0, 0.1, 4.0],
        "gripper.opening": opening,
        "gripper.force": log_uniform(rng, 0.05, 5.0),
        "gripper.speed": log_uniform(rng, 0.05, 2.0),
        "gripper.friction": [0.0, 0.0],
        "contact.thickness": thickness,
        "contact.damping": 0.0,
    }
    scene = spring_scene(tables, values)
    events = {0: [Target("hand", [0.0, 0.0, 1.0])], int(rng.integers(1, 8)): [Grasp("hand", True)]}
    return _evaluate_contact(rng, scene, "is pinched", tables, events)


def rate_and_tolerance(rng: np.random.Generator) -> tuple[float, float]:
    """Draw an integer rate [Hz] and a tolerance [m]; frames of low rates consist of several pieces."""
    return float(round(log_uniform(rng, 8.0, 60.0))), log_uniform(rng, 1e-8, 1e-4)


def frame_count(rate: float) -> int:
    """Return the number of frames of a scene at a rate [Hz]."""
    return math.ceil(DURATION * rate)


def _hung_cells(rng: np.random.Generator, resolution: list[int]) -> dict[str, Any]:
    """Draw parameters of few cells without damping that hang from their upper edge."""
    rate, tolerance = rate_and_tolerance(rng)
    modulus = log_uniform(rng, 5.0, 300.0)
    return {
        "rate": rate,
        "tolerance": tolerance,
        "cloth.resolution": resolution,
        "cloth.size": [log_uniform(rng, 0.3, 2.0), log_uniform(rng, 0.3, 2.0)],
        "cloth.anchors": ["top"],
        "cloth.orientation": [0.5, 0.5, 0.5, 0.5],
        "material.stretch_modulus": modulus,
        "material.shear_modulus": modulus * log_uniform(rng, 0.01, 0.5),
        "material.density": 0.3,
        "material.damping": 0.0,
        "bending.model": "none",
        "air.drag": 0.0,
        "wind.normal_drag": 0.0,
        "gravity": [0.0, 0.0, -log_uniform(rng, 0.3, 10.0)],
        "grippers": [""],
    }


def _evaluate_sheet(
    values: dict[str, Any], words: str, *, speed: float = 0.0, changes: dict[int, dict[str, Any]] | None = None
) -> Trial:
    """Evaluate a hung sheet; its particles start across it with up to a speed [m/s] that grows with their number."""
    scene = Scene.from_parameters(values)
    state = scene.starting_state()
    if speed:
        is_free = scene.model().inverse_masses > 0.0
        state.v[1] += speed * is_free * np.linspace(0.0, 1.0, len(is_free))
    words = f"{values['cloth.resolution']} {words}"
    frames = frame_count(values["rate"])
    draw = RandomScene(scene=scene, state=state, frames=frames, words=words, changes=changes or {})
    return evaluate_trial(draw, {**values, "velocities": state.v.T.tolist(), "changes": str(changes or {})})


def spring_scene(
    tables: dict[str, Any],
    values: dict[str, Any],
    obstacle_position: tuple[float, float, float] | None = None,
    files: dict[str, bytes] | None = None,
    friction: float = 0.0,
) -> Scene:
    """Return a scene of raw springs; an obstacle "thing" has a position [m] in the frame of the springs' file."""
    files = {"springs.yaml": json.dumps(tables).encode(), **(files or {})}
    values = {**SPRINGS, **values}
    if obstacle_position is None:
        return Scene.from_parameters(values, files=files)
    sheet = {key: value for key, value in values.items() if not key.startswith(("thing.", "contact."))}
    offset = Scene.from_parameters(sheet, files=files).starting_state().positions[0] - np.array(tables["positions"][0])
    obstacle = {
        "obstacles": ["thing"],
        "thing.position": (offset + obstacle_position).tolist(),
        "thing.friction": [friction],
    }
    return Scene.from_parameters({**values, **obstacle, "contact.damping": 0.0}, files=files)


def _ridge(slope: float) -> bytes:
    """Return a prism in OBJ format: its upper face is level before x = 0, and falls by a slope after it."""
    x, y, depth = 4.0, 4.0, -6.0
    vertices = [(-x, -y, 0.0), (0.0, -y, 0.0), (x, -y, -x * slope), (-x, y, 0.0), (0.0, y, 0.0), (x, y, -x * slope)]
    vertices += [(-x, -y, depth), (x, -y, depth), (-x, y, depth), (x, y, depth)]
    upper = [(1, 2, 5), (1, 5, 4), (2, 3, 6), (2, 6, 5)]
    lower = [(7, 9, 10), (7, 10, 8), (1, 4, 9), (1, 9, 7), (3, 8, 10), (3, 10, 6)]
    ends = [(1, 7, 2), (2, 7, 8), (2, 8, 3), (4, 5, 9), (5, 10, 9), (5, 6, 10)]
    lines = ["v {} {} {}".format(*vertex) for vertex in vertices]
    lines += ["f {} {} {}".format(*face) for face in (*upper, *lower, *ends)]
    return ("\n".join(lines) + "\n").encode()


def _evaluate_contact(
    rng: np.random.Generator, scene: Scene, words: str, tables: dict[str, Any], events: dict[int, Any] | None = None
) -> Trial:
    """Evaluate a second of a scene in contact, from its start or from the half second on."""
    first = int(rng.choice([0, round(0.5 * scene.rate)]))
    draw = RandomScene(
        scene=scene,
        state=scene.starting_state(),
        frames=first + round(scene.rate),
        words=f"{words}, from frame {first}",
        events=events or {},
        first=first,
    )
    size = max(_MIN_PERTURBATION, _PERTURBATION_FRACTION * scene.tolerance)
    trial = evaluate_frames(draw, _FINE, _ROUGH, size)
    return Trial(
        tolerance=trial.tolerance,
        words=trial.words,
        parameters={**trial.parameters, **tables},
        windows=trial.windows,
        trouble=trial.trouble,
    )
