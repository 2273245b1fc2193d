# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error bound in contact: sheets that fall on obstacles and on themselves.

The obstacles are a table, a sphere and the edge of a box. Speeds are moderate: those of a fall of a few centimetres.
Surfaces have no friction, or enough friction to prevent sliding. DOP853 on the same equations gives the reference
solution. Each trajectory has its own steps, and friction anchors are updated after each. Tests compare the engine's
forces with independent implementations of the laws.
"""

from __future__ import annotations

import math
import time
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros import Advance, Scene, Simulation, State, UnstableError
from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import integrate_intervals
from cloth_sim_ros.verify.reference_motion import Equations, FrameCapture, ReferenceMotion, SimulatedFrame
from validation.tolerance.random_scenes import (
    RandomScene,
    fabric_bending,
    fabric_membrane,
    law_words,
    log_uniform,
    smooth_field,
)
from validation.tolerance.windows import EXPLAINED_FRACTION, SceneEvaluation, Window

KINDS = ("table", "sphere", "edge", "itself")
#: Coefficients of friction: none, and one that prevents sliding everywhere.
FRICTIONS = (0.0, 4.0)
#: Size of a perturbation [m, m/s]: far above the difference of two reference runs, far below the thickness.
PERTURBATION = 1e-7
#: Accuracy of a reference: local error of DOP853 relative to the coordinates, or step counts of leapfrog runs.
Accuracy = float | tuple[int, ...]
#: Local error relative to the coordinates: of the reference, and of the run that checks it.
FINE, ROUGH = 1e-11, 1e-10
#: Parts of a window, and number of further perturbations. If those at the window's start do not explain its error,
#: further ones start there and at the parts' borders: impacts amplify some directions far more than others.
_PARTS, _FURTHER_FIELDS = 4, 6
#: Simulated time of a scene, and of a window [s].
_SECONDS, _WINDOW = 2.0, 1.0
#: Particles of a sheet along a side.
_SIDES = (6, 12)


def draw_contact(seed: int, index: int) -> RandomScene:
    """Draw the scene of an index: kind and friction cycle with the index, everything else is random."""
    kind, friction = KINDS[index % len(KINDS)], FRICTIONS[index // len(KINDS) % len(FRICTIONS)]
    rng, air, laws = (np.random.default_rng([seed, index, salt]) for salt in (14, 15, 16))
    carries_air, has_laws = bool(air.random() < 1.0 / 3.0), laws.random() < 0.5
    draw = draw_contact_scene(rng, kind, friction, _SIDES, carries_air=carries_air, laws=laws if has_laws else None)
    return attrs.evolve(draw, seed=seed, index=index)


def draw_contact_scene(
    rng: np.random.Generator,
    kind: str,
    friction: float,
    sides: tuple[int, int],
    *,
    carries_air: bool = False,
    laws: np.random.Generator | None = None,
) -> RandomScene:
    """Draw a scene of a kind.

    Args:
        rng: draws the scene.
        kind: one of `KINDS`.
        friction: coefficient of friction.
        sides: limits of the number of particles along a side.
        carries_air: true for a sheet that carries air along, of half its mass.
        laws: draws a bending model and membrane triangles of fabrics; None for springs.
    """
    rows, columns = (int(count) for count in rng.integers(sides[0], sides[1] + 1, size=2))
    spacing = float(rng.uniform(0.02, 0.04))
    height, width = (rows - 1) * spacing, (columns - 1) * spacing
    thickness = float(rng.uniform(0.15, 0.3)) * spacing
    gap = float(rng.uniform(0.0, 0.03))
    bending = str(rng.choice(["none", "axial", "opposite", "crossed"]))
    values: dict[str, Any] = {
        "gripper.max_speed": 0.0,
        "wind.normal_drag": 0.0,
        "cloth.resolution": [rows, columns],
        "cloth.size": [height, width],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.anchors": [_anchor(kind, friction)],
        "cloth.position": [0.0, 0.0, gap + 1.05 * thickness],
        "material.stretch_modulus": log_uniform(rng, 100.0, 2000.0),
        "material.damping": float(rng.uniform(0.05, 0.5)),
        "material.density": log_uniform(rng, 0.1, 0.5),
        "bending.model": bending,
        "contact.thickness": thickness,
        "obstacles": ["thing"],
        "thing.friction": [friction],
        "tolerance": log_uniform(rng, 1e-6, 1e-3),
        "rate": float(rng.integers(30, 121)),
        **_obstacle(kind, height, width, rng),
    }
    if bending == "crossed":
        values["material.bending_modulus"] = log_uniform(rng, 1e-6, 1e-4)
    elif bending != "none":
        values["bending.stiffness"] = log_uniform(rng, 0.1, 5.0)
    if kind == "itself":
        values |= {"contact.self": True, "contact.friction": [friction]}
    if laws is not None:
        values.pop("bending.stiffness", None)
        values |= fabric_bending(laws)
        values |= fabric_membrane(laws, values) if laws.random() < 0.5 else {}
    if carries_air:
        values["air.added_mass"] = 0.5 * values["material.density"]
    scene = Scene.from_parameters(values)
    positions = scene.initial_positions()
    positions = _folded(positions, rng.uniform(1.5, 2.5) * thickness) if kind == "itself" else _tilted(positions, rng)
    words = (
        f"{kind}, {rows} x {columns}, {values['material.stretch_modulus']:.2g} N/m, "
        f"k_d0 {values['material.damping']:.2g}, {law_words(values)}, thickness {1e3 * thickness:.2g} mm, "
        f"friction {friction:g}, {scene.rate:g} Hz{', added mass' if carries_air else ''}"
    )
    return RandomScene(scene=scene, state=State(positions), frames=round(_SECONDS * scene.rate), words=words)


def _anchor(kind: str, friction: float) -> str:
    """Return the anchored edge; it prevents a sheet from sliding off an obstacle without friction."""
    if friction or kind not in ("sphere", "edge"):
        return ""
    return "right" if kind == "edge" else "top"


def _obstacle(kind: str, height: float, width: float, rng: np.random.Generator) -> dict[str, Any]:
    """Return the parameters of the obstacle; its highest point has the height 0."""
    if kind == "sphere":
        radius = float(rng.uniform(0.3, 0.8)) * min(height, width)
        return {"thing.shape": "sphere", "thing.size": [radius], "thing.position": [0.0, 0.0, -radius]}
    if kind == "edge":
        # Part of the sheet lies on the box, part hangs over its edge.
        supported_width = float(rng.uniform(0.55, 0.75)) * width
        position = [0.5 * width - supported_width + 1.0, 0.0, -0.2]
        return {"thing.shape": "box", "thing.size": [2.0, 2.0, 0.4], "thing.position": position}
    return {"thing.shape": "plane", "thing.position": [0.0, 0.0, 0.0]}


def _tilted(positions: Array, rng: np.random.Generator) -> Array:
    """Tilt the sheet by up to two degrees about horizontal axes; the height of its lowest particle stays."""
    slopes = np.tan(np.radians(rng.uniform(-2.0, 2.0, size=2)))
    lifted = positions.copy()
    lifted[:, 2] += positions[:, :2] @ slopes
    lifted[:, 2] += positions[:, 2].min() - lifted[:, 2].min()
    return lifted


def _folded(positions: Array, radius: float) -> Array:
    """Fold the right half of the sheet back over the left one."""
    folded, along = positions.copy(), positions[:, 0]
    first = -0.5 * math.pi * radius
    angle = np.clip((along - first) / radius, 0.0, math.pi)
    folded[:, 0] = np.minimum(along, first) + radius * np.sin(angle) - np.maximum(along + first, 0.0)
    folded[:, 2] += radius * (1.0 - np.cos(angle))
    return folded


@attrs.frozen(eq=False, kw_only=True)
class ContactRun:
    """Frames of the engine and their step statistics."""

    draw: RandomScene
    frames: list[SimulatedFrame]
    advances: list[Advance]
    seconds: list[float]
    trouble: str


def run_contact(draw: RandomScene) -> ContactRun:
    """Run a scene to its end."""
    simulation, capture = Simulation(draw.scene, draw.state), FrameCapture()
    run = ContactRun(draw=draw, frames=[], advances=[], seconds=[], trouble="")
    for frame_index in range(draw.frames):
        before, begin = simulation.state.shallow_copy(), time.perf_counter()
        try:
            frame = simulation.advance(draw.events.get(frame_index, []))
        except (UnstableError, ValueError) as error:
            return attrs.evolve(run, trouble=f"frame {frame_index}: {error}")
        seconds = time.perf_counter() - begin
        simulated_frame = capture.capture(simulation, draw.scene, before, frame)
        if simulated_frame is None or frame.advance is None:
            raise RuntimeError(f"frame {frame_index} let no time pass")
        run.frames.append(simulated_frame)
        run.advances.append(frame.advance)
        run.seconds.append(seconds)
    return run


def integrate_reference(
    frames: list[SimulatedFrame], perturbation: tuple[Array, Array] | None, accuracy: Accuracy
) -> list[Array]:
    """Return positions (3, n) [m] at the end of each frame by DOP853, or by extrapolated leapfrog runs.

    It starts from the engine's state before the first frame, with an optional perturbation. `accuracy` is the local
    error of DOP853, or the step counts of the runs.

    Raises:
        ArithmeticError: if no step is small enough.
    """
    motion, equations, positions = ReferenceMotion(frames[0].before), Equations(), list[Array]()
    if perturbation is not None:
        motion.perturb(*perturbation)
    for frame in frames:
        motion.apply_grasps(frame)
        plan, start = equations.plan(frame, motion), motion.state
        if isinstance(accuracy, tuple):
            motion.state = integrate_intervals(plan, frame.t, [frame.duration], start, accuracy)
        else:
            tolerances = {"relative_tolerance": accuracy, "absolute_tolerance": accuracy}
            motion.state = dop853(plan, frame.t, frame.duration, start, **tolerances)
        positions.append(motion.x)
    return positions


def evaluate_contact(seed: int, index: int, windows: int) -> SceneEvaluation:
    """Draw a scene, run it, and evaluate a number of its windows of one second."""
    draw = draw_contact(seed, index)
    run = run_contact(draw)
    second, count = round(_WINDOW * draw.scene.rate), len(run.frames)
    rng = np.random.default_rng([seed, index, 15])
    later_starts = rng.permutation(np.arange(1, max(1, count - second + 1)))[: windows - 1]
    evaluated, unknown = list[Window](), list[str]()
    for first in [0, *sorted(later_starts.tolist())] if count >= second else []:
        try:
            evaluated.append(evaluate_contact_window(run, first, second, rng))
        except ArithmeticError as error:
            unknown.append(f"window at {first}: {error}")
    return SceneEvaluation.of(
        draw,
        run.advances,
        run.seconds,
        windows=tuple(evaluated),
        whole=None,
        mismatch=0.0,
        trouble=run.trouble,
        unknown=tuple(unknown),
    )


def evaluate_contact_window(
    run: ContactRun,
    first: int,
    second: int,
    rng: np.random.Generator,
    *,
    fine: Accuracy = FINE,
    rough: Accuracy = ROUGH,
    size: float = PERTURBATION,
) -> Window:
    """Evaluate the window of one second from a frame on; `fine`, `rough`, `size`: see `FINE`, `PERTURBATION`."""
    frames, advances = run.frames[first : first + second], run.advances[first : first + second]
    exact = integrate_reference(frames, None, fine)
    check = integrate_reference(frames, None, rough)
    tolerance, initial_positions = run.draw.scene.tolerance, run.draw.state.x.T
    fields = [rng.normal(size=initial_positions.shape), smooth_field(rng, initial_positions)]
    amplification = _amplification(frames, check, fields, size, rough)
    error = max(largest_distance(frame.after.x, x) for frame, x in zip(frames, exact, strict=True))
    later_amplification = 0.0
    if error > EXPLAINED_FRACTION * tolerance * max(1.0, amplification):
        fields += [rng.normal(size=initial_positions.shape) for _ in range(_FURTHER_FIELDS)]
        for part in range(_PARTS):
            later_frames = frames[part * second // _PARTS :]
            later_check = integrate_reference(later_frames, None, rough)
            later = _amplification(later_frames, later_check, fields, size, rough)
            later_amplification = max(later_amplification, later)
    return Window.of(
        advances,
        first=first,
        frames=second,
        error=error,
        amplification=amplification,
        error_bound=tolerance * max(1.0, amplification, later_amplification),
        reference_error=max(largest_distance(a, b) for a, b in zip(exact, check, strict=True)),
        reference_evaluations=0,
        later_amplification=later_amplification,
    )


def _amplification(
    frames: list[SimulatedFrame], exact: list[Array], fields: list[Array], size: float, accuracy: Accuracy
) -> float:
    """Return the largest amplification of perturbations of a size [m, m/s], of positions and of velocities."""
    perturbations = [size * np.ascontiguousarray(field.T / np.linalg.norm(field, axis=1).max()) for field in fields]
    pairs = [pair for field in perturbations for pair in ((field, 0.0 * field), (0.0 * field, field))]
    distances = [
        largest_distance(a, b)
        for pair in pairs
        for a, b in zip(integrate_reference(frames, pair, accuracy), exact, strict=True)
    ]
    return max(distances) / size
