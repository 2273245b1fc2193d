# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Families of two motions of which one hides the other, which the search for violations climbs over.

Error estimates take the largest value over all particles. Therefore one particle's motion can hide another one's, and a
large slow motion a small fast one.
"""

from __future__ import annotations

import math
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros import Grasp, Scene, State, Target
from validation.tolerance.climb_kinks import frame_count, rate_and_tolerance, spring_scene
from validation.tolerance.climb_scenes import Trial, evaluate_frames, evaluate_trial
from validation.tolerance.random_scenes import RandomScene, log_uniform

_GRAVITY = 9.81
#: Local error of DOP853 for sheets in contact relative to the tolerance, and its smallest value.
_LOCAL_ERROR_FRACTION, _MIN_LOCAL_ERROR = 1e-4, 1e-12
#: Size of perturbations relative to the tolerance, and their smallest size [m, m/s].
_PERTURBATION_FRACTION, _MIN_PERTURBATION = 0.1, 1e-8


def free_fall(rng: np.random.Generator) -> Trial:
    """Evaluate a particle that falls freely beside one that rests on a joint while gravity changes a little once."""
    rate, tolerance = rate_and_tolerance(rng)
    frequency, change = log_uniform(rng, 5.0, 300.0), log_uniform(rng, 1e-6, 1e-2)
    frame, angle = 1 + int(rng.uniform(0.0, 0.9) * rate), float(rng.uniform(0.0, math.pi))
    tables = {
        "positions": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -_GRAVITY / frequency**2]],
        "masses": 1.0,
        "springs": [[0, 2]],
        "rest_lengths": 0.0,
        "stiffness": frequency * frequency,
        "k_d0": 0.0,
    }
    gravity = [change * math.sin(angle), 0.0, -_GRAVITY - change * math.cos(angle)]
    values = {"rate": rate, "tolerance": tolerance, "gravity": [0.0, 0.0, -_GRAVITY]}
    words = f"joint {frequency:.3g}/s, gravity changes by {change:.2g} m/s^2 in frame {frame}"
    return _evaluate(tables, values, words, changes={frame: {"gravity": gravity}})


def crossing(rng: np.random.Generator) -> Trial:
    """Evaluate a particle that falls freely beside one that crosses the line of two springs."""
    rate, tolerance = rate_and_tolerance(rng)
    half, frequency = log_uniform(rng, 0.1, 3.0), log_uniform(rng, 0.3, 60.0)
    distance, speed = half * float(rng.uniform(0.0, 3.0)), log_uniform(rng, 0.01, 5.0)
    angle, slack = float(rng.uniform(-1.6, 1.6)), float(rng.uniform(0.5, 1.8))
    along, y = np.array([math.cos(angle), 0.0, math.sin(angle)]), half * float(rng.uniform(-0.9, 0.9))
    crosser = -distance * along + [0.0, y, 0.0]
    tables = {
        "positions": [[0.0, -half, 0.0], [0.0, half, 0.0], crosser.tolist(), [5.0, 0.0, 0.0]],
        "velocities": [[0.0] * 3] * 2 + [(speed * along).tolist(), [0.0] * 3],
        "masses": 1.0,
        "springs": [[0, 2], [1, 2]],
        "rest_lengths": slack * half,
        "stiffness": frequency * frequency * slack * half,
        "k_d0": 0.0,
    }
    values = {"rate": rate, "tolerance": tolerance, "gravity": [0.0, 0.0, -_GRAVITY], "cloth.anchors": ["0", "1"]}
    return _evaluate(tables, values, f"springs {frequency:.3g}/s, slack {slack:.2g}, crosses from {distance:.2g} m")


def passing(rng: np.random.Generator) -> Trial:
    """Evaluate a particle that circles its anchor on a joint beside one on a spring that flies past the same anchor.

    Lengths are proportional to the tolerance, because both motions scale with them.
    """
    rate, tolerance = rate_and_tolerance(rng)
    radius, circling = tolerance * log_uniform(rng, 1e8, 1e12), log_uniform(rng, 0.1, 5.0)
    speed, time = tolerance * log_uniform(rng, 1e8, 1e10), float(rng.uniform(0.25, 0.9))
    miss, rest_length = speed * log_uniform(rng, 0.003, 0.3), speed * log_uniform(rng, 0.3, 3.0)
    frequency = log_uniform(rng, 0.1, 2.0)
    tables = {
        "positions": [[0.0, 0.0, 0.0], [-speed * time, miss, 0.0], [radius, 0.0, 0.0]],
        "velocities": [[0.0] * 3, [speed, 0.0, 0.0], [0.0, radius * circling, 0.0]],
        "masses": 1.0,
        "springs": [[0, 1], [0, 2]],
        "rest_lengths": [rest_length, 0.0],
        "stiffness": [frequency * frequency * rest_length, circling * circling],
        "k_d0": 0.0,
    }
    values = {"rate": rate, "tolerance": tolerance, "gravity": [0.0, 0.0, 0.0]}
    words = f"circles at {radius:.3g} m, {circling:.3g}/s, passes at {miss:.2g} m after {time:.3g} s, {speed:.3g} m/s"
    return _evaluate(tables, values, words)


def orbit(rng: np.random.Generator) -> Trial:
    """Evaluate a particle on a wide orbit about the anchor of a joint, which passes the anchor of a weak spring.

    Lengths are proportional to the tolerance, because the motion scales with them.
    """
    rate, tolerance = rate_and_tolerance(rng)
    radius, circling = tolerance * log_uniform(rng, 1e8, 1e12), log_uniform(rng, 0.1, 5.0)
    time, ratio = float(rng.uniform(0.25, 1.2)), float(rng.uniform(0.3, 1.0))
    # Distance of the spring's anchor: the particle passes it in about as much time as a frame takes.
    angle, distance = circling * time, radius * circling / rate * log_uniform(rng, 0.1, 3.0)
    passed = np.array([math.cos(angle), ratio * math.sin(angle)]) * radius
    normal = np.array([ratio * math.cos(angle), math.sin(angle)])
    anchor = passed + distance / float(np.hypot(*normal)) * normal * (1.0 if rng.random() < 0.5 else -1.0)
    force = radius * circling * circling * (distance / radius) * log_uniform(rng, 0.01, 30.0)
    tables = {
        "positions": [[0.0] * 3, [*anchor.tolist(), 0.0], [radius, 0.0, 0.0]],
        "velocities": [[0.0] * 3, [0.0] * 3, [0.0, radius * circling * ratio, 0.0]],
        "masses": 1.0,
        "springs": [[0, 2], [1, 2]],
        "rest_lengths": [0.0, radius * log_uniform(rng, 1.0, 30.0)],
        "stiffness": [circling * circling, force],
        "k_d0": 0.0,
    }
    values = {"rate": rate, "tolerance": tolerance, "gravity": [0.0, 0.0, 0.0], "cloth.anchors": ["0", "1"]}
    return _evaluate(tables, values, f"orbit of {radius:.3g} m, {circling:.3g}/s, passes at {distance:.3g} m")


def stairs(rng: np.random.Generator) -> Trial:
    """Evaluate a particle in a gripper that moves a little in some frames, while another one swings.

    A third particle at rest requires short steps. Without it the vibration would be in combined runs.
    """
    rate, tolerance = rate_and_tolerance(rng)
    steps, stride = int(rng.integers(15, 60)), int(rng.integers(1, 4))
    # After a whole number of periods a frame the activity does not show the vibration.
    periods = int(rng.integers(1, 4)) * float(rng.uniform(0.99, 1.01))
    swing, grip = log_uniform(rng, 0.2, 2.0), 2.0 * math.pi * rate * periods
    stiff, phase = 1.84 * steps * rate, float(rng.uniform(0.0, math.pi))
    # The swing takes up to half of the budget by its phase error w^3 h^2/24 a second.
    amplitude = tolerance * float(rng.uniform(0.02, 0.4)) * 24.0 * (steps * rate) ** 2 / swing**3
    height = tolerance * log_uniform(rng, 0.3, 6.0) * steps * steps / (6.0 * grip)
    frames, first = frame_count(rate), int(0.5 * rate)
    tables = {
        "positions": [[0, 0, 0], [amplitude * math.cos(phase), 0, 0], [0, 20, 0], [0, 20, 0], [0, 40, 0], [0, 40, 0]],
        "velocities": [[0] * 3, [-amplitude * swing * math.sin(phase), 0, 0], *([[0] * 3] * 4)],
        "masses": 1.0,
        "springs": [[0, 1], [4, 5]],
        "rest_lengths": 0.0,
        "stiffness": [swing * swing, stiff * stiff],
        "k_d0": 0.0,
    }
    values = {
        "rate": rate,
        "tolerance": tolerance,
        "gravity": [0.0, 0.0, 0.0],
        "cloth.anchors": ["0", "3", "4"],
        "grippers": ["hand"],
        "gripper.radius": 0.02,
        "gripper.stiffness": grip * grip,
        "gripper.damping": 0.0,
        "gripper.max_speed": 0.0,
    }
    scene = spring_scene(tables, values)
    home = scene.starting_state().positions[2] - [0.01, 0.0, 0.0]
    events: dict[int, list[Any]] = {0: [Target("hand", home.tolist()), Grasp("hand", True)]}
    for count, frame in enumerate(range(first, frames, stride), start=1):
        events.setdefault(frame, []).append(Target("hand", [home[0], home[1], home[2] + count * height]))
    words = f"grip {grip:.3g}/s moves by {height:.2g} m in each {stride}. frame, swing {swing:.2g}/s, {steps} steps"
    state = scene.starting_state()
    draw = RandomScene(scene=scene, state=state, frames=first + round(rate), words=words, events=events, first=first)
    size = max(_MIN_PERTURBATION, _PERTURBATION_FRACTION * tolerance)
    trial = evaluate_frames(draw, (600, 800, 1000), (300, 400, 500), size)
    return attrs.evolve(trial, parameters={**trial.parameters, **tables, "height": height, "stride": stride})


def dipping(rng: np.random.Generator) -> Trial:
    """Evaluate a sheet whose hem particle vibrates over a layer of the same sheet while a far corner swings.

    Both are free, all other particles are anchors. DOP853 is the reference, because it leaves out no contact.
    """
    rate, tolerance = rate_and_tolerance(rng)
    frequency, amplitude = 2.0 * math.pi * rate * float(rng.uniform(0.9, 1.1)), log_uniform(rng, 2e-3, 2e-2)
    # Frames that start near the highest point hide the contact from their ends.
    speed, phases = log_uniform(rng, 0.3, 6.0), [float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-math.pi, math.pi))]
    thickness, overlap = log_uniform(rng, 1e-3, 5e-3), float(rng.uniform(0.0, 1.0))
    damping = log_uniform(rng, 0.005, 0.05)
    density, hem, corner = 0.3, 3, 8
    # A cell is a square metre: a corner has a quarter of its mass, and an edge half of its modulus as stiffness.
    modulus = 0.5 * density * frequency * frequency
    values = {
        "rate": rate,
        "tolerance": tolerance,
        "cloth.resolution": [3, 4],
        "cloth.size": [2.0, 3.0],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.anchors": [str(k) for k in range(12) if k not in (hem, corner)],
        "material.density": density,
        "material.damping": damping,
        "material.stretch_modulus": 10.0 * modulus,
        "material.stretch_modulus_weft": modulus,
        "material.shear_modulus": 1e-3 * modulus,
        "bending.model": "none",
        "air.drag": 0.0,
        "wind.normal_drag": 0.0,
        "gravity": [0.0, 0.0, 0.0],
        "grippers": [""],
        "contact.self": True,
        "contact.friction": [0.0, 0.0],
        "contact.thickness": thickness,
        "contact.damping": 0.0,
    }
    scene = Scene.from_parameters(values)
    state = State(_layers(thickness * (1.0 - overlap), amplitude))
    state.x[2, hem] += amplitude * math.cos(phases[0])
    state.v[2, hem] -= amplitude * frequency * math.sin(phases[0])
    state.x[1, corner] += speed / frequency * math.sin(phases[1])
    state.v[1, corner] += speed * math.cos(phases[1])
    words = f"hem {frequency:.3g}/s, {1e3 * amplitude:.2g} mm over {1e3 * thickness:.2g} mm, corner {speed:.2g} m/s"
    draw = RandomScene(scene=scene, state=state, frames=round(rate), words=f"{words}, {rate:g} Hz")
    size = max(_MIN_PERTURBATION, _PERTURBATION_FRACTION * tolerance)
    fine = max(_MIN_LOCAL_ERROR, _LOCAL_ERROR_FRACTION * tolerance)
    trial = evaluate_frames(draw, fine, 10.0 * fine, size)
    return attrs.evolve(trial, parameters={**trial.parameters, "velocities": state.velocities.tolist()})


def _layers(height: float, amplitude: float) -> np.ndarray:
    """Return positions [m], (12, 3), of a sheet whose hem particle hangs over a layer of the same sheet.

    The lowest point of a vibration with an amplitude [m] is at a height [m] above the plane of the layer.
    """
    # The layer slopes from the hem's row on; the hem is at an offset behind that row.
    drop, offset = 0.2, 0.02
    run = math.sqrt(1.0 - drop * drop)
    z, points = (height - offset * drop) / run + amplitude, list[list[float]]()
    for row in range(3):
        y, floor = (run + row - 1.0, -drop) if row else (0.0, 0.0)
        points += [[-0.5, y, floor], [0.5, y, floor], [0.0, row + offset, z + 1.0], [0.0, row + offset, z]]
    return np.array(points)


def _evaluate(
    tables: dict[str, Any], values: dict[str, Any], words: str, *, changes: dict[int, dict[str, Any]] | None = None
) -> Trial:
    """Evaluate raw springs, whose parameters change at frames."""
    scene, changes = spring_scene(tables, values), changes or {}
    words = f"{words}, {scene.rate:g} Hz"
    frames = frame_count(scene.rate)
    draw = RandomScene(scene=scene, state=scene.starting_state(), frames=frames, words=words, changes=changes)
    return evaluate_trial(draw, {**values, **tables, "changes": str(changes)})
