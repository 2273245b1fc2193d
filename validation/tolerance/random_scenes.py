# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random scenes for the error bound with their gripper scripts, and the estimated cost of their evaluation."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from typing import Any

import attrs
import numpy as np
from support.random_meshes import drawn_alike, random_mesh

from cloth_sim_ros import Grasp, Scene, Simulation, State, Target
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, quaternion_product
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.simulation.events import Event
from validation.tolerance.compiled_reference import ReferenceSystem

ACTIONS = ("carry", "turn", "jump", "hold", "swing")
#: Number of frames before a grasp in which the open gripper follows its particle.
APPROACH = 3


@attrs.frozen(kw_only=True, eq=False)
class GraspInterval:
    """Interval from the grasp of one particle to its release, and the actions in it."""

    gripper: str
    particle: int
    #: Frames before which the gripper grasps and releases.
    grasp: int
    release: int
    #: First frame, name and vector of each action; the vector's length is a distance [m] or an angle [rad].
    actions: tuple[tuple[int, str, Array], ...]
    #: Number of frames between targets.
    stride: int


@attrs.frozen(kw_only=True, eq=False)
class RandomGripScript:
    """Grasp intervals of a scene."""

    holds: tuple[GraspInterval, ...] = ()

    @classmethod
    def random(cls, rng: np.random.Generator, scene: Scene, frames: int, *, pace: float = 1.0) -> RandomGripScript:
        """Draw a script for a number of frames; `pace` scales the speeds."""
        rest_positions = scene.initial_positions()
        size = float(np.ptp(rest_positions, axis=0).max()) or 1.0
        rate = scene.rate
        holds = []
        for name in scene.gripper_names:
            frame = int(rng.uniform(0.0, 0.5) * rate)
            while frame < frames - 2:
                release = frame + max(2, int(rng.uniform(0.3, 2.0) * rate))
                actions, action_frame = [], frame + 1
                while action_frame < release:
                    action_name = str(rng.choice(ACTIONS))
                    direction = rng.normal(size=3)
                    reach = {"turn": 2.0, "jump": 0.25 * size}.get(action_name, 0.4 * size)
                    displacement = pace * rng.uniform(0.1, 1.0) * reach * direction / np.linalg.norm(direction)
                    actions.append((action_frame, action_name, displacement))
                    action_frame += max(2, int(rng.uniform(0.15, 0.8) * rate))
                stride = int(rng.choice([1, 1, 1, 2, 4]))
                holds.append(
                    GraspInterval(
                        gripper=name,
                        particle=int(rng.integers(len(rest_positions))),
                        grasp=frame,
                        release=release,
                        actions=tuple(actions),
                        stride=stride,
                    )
                )
                frame = release + max(2, int(rng.uniform(0.2, 1.0) * rate)) + APPROACH
        return cls(holds=tuple(holds))

    @property
    def words(self) -> str:
        """Short description."""
        grippers = {hold.gripper for hold in self.holds}
        return f"{len(grippers)} grippers, {len(self.holds)} holds" if grippers else "nothing held"

    def moments(self) -> list[int]:
        """Return the frames before which an action begins, sorted."""
        frames = {frame for hold in self.holds for frame in (hold.grasp, hold.release, *(a[0] for a in hold.actions))}
        return sorted(frames)


class RandomGripPlayer:
    """Player of a script on a simulation; a gripper's path starts at the particle's position at the grasp."""

    def __init__(self, script: RandomGripScript, simulation: Simulation) -> None:
        self._script, self._simulation = script, simulation
        self._orientations = {hold.gripper: np.array([0.0, 0.0, 0.0, 1.0]) for hold in script.holds}
        self._positions: dict[str, Array] = {}

    def events(self, frame: int) -> list[Event]:
        """Return the events before a frame, counted from 0."""
        events: list[Event] = []
        for hold in self._script.holds:
            if hold.grasp - APPROACH <= frame <= hold.grasp:
                events.append(self._target(hold.gripper, self._simulation.state.x[:, hold.particle].copy()))
            if frame == hold.grasp:
                events.append(Grasp(hold.gripper, True))
            elif frame == hold.release:
                events.append(Grasp(hold.gripper, False))
            elif hold.grasp < frame < hold.release and (frame - hold.grasp) % hold.stride == 0:
                events.append(self._follow(hold, frame))
        return events

    def _target(self, gripper: str, position: Array) -> Target:
        self._positions[gripper] = position
        return Target(gripper, drawn_alike(position), drawn_alike(self._orientations[gripper]))

    def _follow(self, hold: GraspInterval, frame: int) -> Target:
        position = self._positions[hold.gripper]
        begin, action_name, vector = [action for action in hold.actions if action[0] <= frame][-1]
        seconds = hold.stride * self._simulation.scene.period
        if action_name == "jump" and frame - hold.stride < begin:
            position = position + vector
        elif action_name == "carry":
            position = position + seconds * vector
        elif action_name == "swing":
            angle = 12.0 * (frame - begin) * self._simulation.scene.period
            position = position + seconds * 4.0 * math.cos(angle) * vector
        elif action_name == "turn":
            speed = float(np.linalg.norm(vector))
            half = 0.5 * seconds * speed
            step = (*(math.sin(half) * vector / speed).tolist(), math.cos(half))
            turned = normalized(quaternion_product(step, self._orientations[hold.gripper].tolist()))
            self._orientations[hold.gripper] = turned
        return self._target(hold.gripper, position)


#: Particles of a sheet along a side, stretch moduli [N/m], densities [kg/m^2], tolerances [m], frames per second [1/s].
SIDES, MODULI, DENSITIES = (5, 60), (50.0, 1e5), (0.02, 2.0)
TOLERANCES, RATES = (1e-8, 1e-2), (30, 240)
#: Simulated time of a scene [s].
DURATIONS = (2.0, 4.0)
#: Largest cost of a scene in spring evaluations by the reference: about a minute of one core.
MAX_COST = 5e9
#: Steps of the reference per radian of the highest frequency, for the cost estimate.
_STEPS_PER_RADIAN = 0.8
_STAGES = 12
_ANCHORS = [["top"], ["top_left", "top_right"], ["top", "bottom"], ["left", "right"]]
_ANCHORS += [["left"], ["top_left"], ["bottom_right", "top_left"], [""]]
#: Number of those that hold a hanging sheet.
_N_HANGING_ANCHORS = 4
#: Fraction of calm scenes: damped sheets that hang from their upper edge, with slow grippers. In most other scenes a
#: perturbation grows without bound within a second, and a window is not meaningful.
_CALM_FRACTION = 0.6
#: Pace of grippers in calm scenes.
_CALM_PACE = 0.15


@attrs.frozen(kw_only=True, eq=False, slots=False)
class RandomScene:
    """Random scene with its initial state and gripper script."""

    scene: Scene
    state: State
    #: Number of frames.
    frames: int
    #: Short description.
    words: str
    script: RandomGripScript = attrs.field(factory=RandomGripScript)
    seed: int = 0
    index: int = 0
    #: Estimated cost of its evaluation, see `MAX_COST`.
    cost: float = 0.0
    #: Changed parameters by the frame before which they change.
    changes: Mapping[int, dict[str, Any]] = attrs.field(factory=dict)
    #: Further events by the frame before which they happen, and the first frame of its window.
    events: Mapping[int, list[Event]] = attrs.field(factory=dict)
    first: int = 0

    @functools.cached_property
    def frequency(self) -> float:
        """Highest frequency of the start, or its damping rate if that is higher [1/s]."""
        return max_frequency(self.scene, self.state.x)

    @property
    def frames_per_second(self) -> int:
        """Number of frames in a window of one second."""
        return round(self.scene.rate)


def draw_scene(seed: int, index: int) -> RandomScene:
    """Draw the scene of an index for a seed."""
    rng, law_rng = np.random.default_rng([seed, index]), np.random.default_rng([seed, index, 2])
    while True:
        calm = bool(rng.random() < _CALM_FRACTION)
        try:
            values, files, words = _values(rng, calm)
            words += _draw_added_mass(np.random.default_rng([seed, index, 1]), values)
            words += _draw_laws(law_rng, values)
            scene = Scene.from_parameters(values, files=files)
            break
        except ParameterError:
            # Not every material can be woven into every grid.
            continue
    duration = float(rng.uniform(*DURATIONS))
    frames = max(round(scene.rate), round(duration * scene.rate))
    state = initial_state(rng, scene, 0.2 if calm else 1.0)
    script = RandomGripScript.random(rng, scene, frames, pace=_CALM_PACE if calm else 1.0)
    description = ", ".join([*words, f"{scene.rate:g} Hz", f"{frames / scene.rate:.1f} s", script.words])
    draw = RandomScene(
        scene=scene, state=state, frames=frames, words=description, script=script, seed=seed, index=index
    )
    return with_cost(draw, windows=4)


def with_cost(draw: RandomScene, *, windows: int) -> RandomScene:
    """Return a scene with its estimated spring evaluations by the reference: the run and its windows, each twice."""
    seconds = 2.0 * (draw.frames / draw.scene.rate + windows - 1)
    evaluation_cost = ReferenceSystem(draw.scene.model()).evaluation_cost
    return attrs.evolve(draw, cost=seconds * _STAGES * _STEPS_PER_RADIAN * draw.frequency * evaluation_cost)


def max_frequency(scene: Scene, x: Array) -> float:
    """Return the highest frequency of a scene at positions x (3, n), or its damping rate if that is higher [1/s]."""
    plan = scene.plan()
    omega2, damping = plan.spectral_bounds(x)
    if scene.gripper_names:
        # Grip stiffness is proportional to mass: all grips have one frequency.
        omega2 += scene.gripper.stiffness / float(plan.model.masses.max())
    return max(math.sqrt(omega2), damping, 2.0 * scene.rate)


def _values(rng: np.random.Generator, calm: bool) -> tuple[dict[str, Any], dict[str, bytes], list[str]]:
    kind = str(rng.choice(["grid", "mesh", "springs"], p=[0.6, 0.2, 0.2]))
    values: dict[str, Any] = {
        "rate": float(rng.integers(RATES[0], RATES[1] + 1)),
        "tolerance": log_uniform(rng, *TOLERANCES),
        "air.drag": 0.0 if rng.random() < 0.3 else log_uniform(rng, 0.2 if calm else 0.02, 2.0),
        "wind.normal_drag": 0.0,
        "gravity": [0.0, 0.0, -9.81] if calm else _gravity(rng),
    }
    files: dict[str, bytes] = {}
    if kind == "springs":
        files["springs.json.yaml"], more, words = _springs(rng, calm)
        values |= {"cloth.springs": "springs.json.yaml", "bending.model": "none", **more}
    else:
        more, files, words = _sheet(rng, kind, calm)
        values |= more
    if rng.random() < 0.4:
        values |= sheet_air(rng) if kind != "springs" else {"wind.velocity": rng.uniform(-4.0, 4.0, 3).tolist()}
        words += ["wind", "air on panels"] if values["wind.normal_drag"] else ["wind"]
    names = [f"gripper{k}" for k in range(int(rng.choice([0, 1, 2, 3], p=[0.25, 0.4, 0.2, 0.15])))]
    extent = 0.3 * max(values.get("cloth.size", [0.5]))
    values |= {
        "grippers": names or [""],
        "gripper.radius": float(rng.uniform(0.2, 1.0) * extent),
        "gripper.stiffness": log_uniform(rng, 30.0, 3000.0),
        "gripper.damping": float(rng.uniform(0.0, 2.0)),
    }
    return values, files, words


def _sheet(rng: np.random.Generator, kind: str, calm: bool) -> tuple[dict[str, Any], dict[str, bytes], list[str]]:
    """Draw a grid or a mesh of a random material."""
    stretch, density = log_uniform(rng, *MODULI), log_uniform(rng, *DENSITIES)
    damping = 0.0 if rng.random() < (0.1 if calm else 0.25) else float(rng.uniform(0.0, 1.0))
    shear = 0.0 if rng.random() < 0.05 else stretch * log_uniform(rng, 0.01, 0.3)
    models = ["none", "axial", "opposite", "crossed", "altitude"]
    model = str(rng.choice(models if kind == "grid" else [name for name in models if name != "axial"]))
    values: dict[str, Any] = {
        "material.stretch_modulus": stretch,
        "material.density": density,
        "material.damping": damping,
        "bending.model": model,
        "cloth.position": rng.uniform(-1.0, 1.0, 3).tolist(),
        "gripper.max_speed": 0.0,
        "cloth.orientation": upright_orientation(rng) if calm else rng.normal(size=4).tolist(),
    }
    if model in ("axial", "opposite"):
        values["bending.stiffness"] = stretch * log_uniform(rng, 1e-4, 0.1)
    elif model != "none":
        values["material.bending_modulus"] = log_uniform(rng, 1e-7, 1e-3)
        values["bending.rest_angle"] = 0.0 if rng.random() < 0.7 else float(rng.uniform(-0.5, 0.5))
    files: dict[str, bytes] = {}
    if kind == "grid":
        rows, columns = (round(log_uniform(rng, *SIDES)) for _ in range(2))
        height = float(rng.uniform(0.3, 1.2))
        width = float(height * (columns - 1) / (rows - 1) * log_uniform(rng, 0.7, 1.4))
        anchors = list(_ANCHORS[rng.integers(_N_HANGING_ANCHORS if calm else len(_ANCHORS))])
        if not calm and rng.random() < 0.2:
            anchors = [str(int(rng.integers(rows * columns))) for _ in range(int(rng.integers(1, 4)))]
        layout = str(rng.choice(["left", "right", "alternating", "both"]))
        values |= {
            "material.shear_modulus": shear,
            "cloth.size": [height, width],
            "cloth.resolution": [rows, columns],
            "cloth.anchors": anchors,
            "cloth.shear_layout": layout,
        }
        shape = f"grid {rows} x {columns} {layout}"
    else:
        files["sheet.obj"], points, shape = random_mesh(rng)
        chosen = rng.integers(0, len(points), int(rng.integers(0, 4)))
        if calm:
            chosen = np.flatnonzero(points[:, 1] > points[:, 1].max() - 0.1 * np.ptp(points[:, 1]))
        anchors = [str(int(k)) for k in chosen] or [""]
        values |= {"cloth.mesh": "sheet.obj", "cloth.anchors": anchors}
    anchor_names = " ".join(anchors) if len(anchors) < 4 else f"{len(anchors)} particles"
    words = ["calm" if calm else "wild", shape, f"{stretch:.2g} N/m", f"{density:.2g} kg/m2", f"k_d0 {damping:.2g}"]
    words += [model, f"anchors {anchor_names or 'none'}"]
    return values, files, words


def _springs(rng: np.random.Generator, calm: bool) -> tuple[bytes, dict[str, Any], list[str]]:
    """Draw a single spring, or a chain of different springs."""
    count = 2 if rng.random() < 0.4 else int(rng.integers(3, 102))
    rest_lengths = rng.uniform(0.02, 0.2, count - 1) if count > 2 else rng.uniform(0.1, 1.0, 1)
    if rng.random() < 0.2:
        rest_lengths[:] = 0.0
    slack = float(rng.uniform(1.05 if calm else 0.7, 1.5))
    length = np.where(rest_lengths > 0.0, slack * rest_lengths, 0.05)
    direction = rng.normal(size=3)
    positions = np.concatenate([[0.0], np.cumsum(length)])[:, None] * (direction / np.linalg.norm(direction))
    positions += 0.01 * length.mean() * rng.normal(size=positions.shape)
    rigidity, masses = _alike_or_not(rng, count - 1, MODULI), _alike_or_not(rng, count, (1e-3, 0.3))
    damping = 0.0 if rng.random() < 0.3 else float(rng.uniform(0.0, 1.0 if count > 2 else 3.0))
    anchors = [[""], ["0"], ["0", str(count - 1)] if count > 2 else ["0"]][int(rng.integers(3))]
    velocities = (0.05 if calm else 0.3) * rng.normal(size=positions.shape)
    if rng.random() < 0.7:
        # In the other scenes anchors keep their initial velocity.
        velocities[[int(name) for name in anchors if name]] = 0.0
    stiffness = rigidity * np.where(rest_lengths > 0.0, rest_lengths, 1.0)
    tables = chain_tables(drawn_alike(positions), velocities, masses, rest_lengths, stiffness, damping=damping)
    kind_name = "spring" if count == 2 else f"chain of {count}"
    stiffness_text = "joints" if not rest_lengths.any() else f"{rigidity.min():.2g} to {rigidity.max():.2g} N/m"
    anchor_names = " ".join(anchors) or "none"
    words = ["calm" if calm else "wild", kind_name, stiffness_text, f"k_d0 {damping:.2g}", f"anchors {anchor_names}"]
    return json.dumps(tables).encode(), {"cloth.anchors": anchors, "cloth.size": [float(length.sum()), 1e-6]}, words


def chain_tables(
    positions: Array, velocities: Array, masses: Array, rest_lengths: Array, stiffness: Array, *, damping: float
) -> dict[str, Any]:
    """Return a chain of springs between successive particles as tables of `cloth.springs`."""
    return {
        "positions": positions.tolist(),
        "velocities": velocities.tolist(),
        "masses": masses.tolist(),
        "springs": [[k, k + 1] for k in range(len(positions) - 1)],
        "rest_lengths": rest_lengths.tolist(),
        "stiffness": stiffness.tolist(),
        "k_d0": damping,
    }


def _alike_or_not(rng: np.random.Generator, count: int, limits: tuple[float, float]) -> Array:
    """Draw numbers between limits: one for all or each by itself."""
    if rng.random() < 0.5:
        return np.array([log_uniform(rng, *limits) for _ in range(count)])
    return np.full(count, log_uniform(rng, *limits))


def _gravity(rng: np.random.Generator) -> list[float]:
    if rng.random() < 0.75:
        return [0.0, 0.0, -9.81]
    return [0.0, 0.0, 0.0] if rng.random() < 0.5 else rng.uniform(-6.0, 6.0, 3).tolist()


def sheet_air(rng: np.random.Generator) -> dict[str, Any]:
    """Draw a wind, and possibly the forces of air on panels."""
    values: dict[str, Any] = {"wind.velocity": rng.uniform(-4.0, 4.0, 3).tolist()}
    if rng.random() < 0.6:
        values["wind.normal_drag"] = log_uniform(rng, 0.02, 2.0)
        values["wind.tangential_drag"] = float(rng.uniform(0.0, 0.1))
    return values


def _draw_added_mass(rng: np.random.Generator, values: dict[str, Any]) -> list[str]:
    """Let a third of the sheets carry air along; it has a generator of its own, so that other draws stay the same."""
    if "cloth.springs" in values or rng.random() >= 1.0 / 3.0:
        return []
    values["air.added_mass"] = added_mass(rng, values)
    return ["added mass"]


def added_mass(rng: np.random.Generator, values: Mapping[str, Any]) -> float:
    """Draw the mass of the air that a sheet carries along, from a fiftieth of its own to three times that [kg/m^2]."""
    return float(f"{values['material.density'] * log_uniform(rng, 0.02, 3.0):.9g}")


def _draw_laws(rng: np.random.Generator, values: dict[str, Any]) -> list[str]:
    """Let half of the sheets have laws for fabrics; its generator is separate, so that other draws stay the same."""
    if "cloth.springs" in values or rng.random() < 0.5:
        return []
    has_bending = bool(rng.random() < 0.7)
    if has_bending:
        for name in ("bending.stiffness", "bending.rest_angle"):
            values.pop(name, None)
        values |= fabric_bending(rng)
    if not has_bending or rng.random() < 0.5:
        values |= fabric_membrane(rng, values)
    return ["fabric of " + law_words(values)]


def law_words(values: Mapping[str, Any]) -> str:
    """Return the bending model of a scene, its friction and its triangles in words."""
    words = [str(values["bending.model"])]
    if "bending.friction_moment" in values:
        words.append("friction of bending")
    if "membrane.model" in values:
        words.append("stiffening triangles" if "material.warp_stiffening" in values else "triangles")
    return " with ".join(words)


def fabric_bending(rng: np.random.Generator) -> dict[str, Any]:
    """Draw a bending model of fabrics, with or without friction."""
    model = str(rng.choice(["shape_operator", "quadratic", "crossed", "altitude"], p=[0.4, 0.2, 0.2, 0.2]))
    values: dict[str, Any] = {"bending.model": model, "material.bending_modulus": log_uniform(rng, 1e-7, 1e-3)}
    if model == "shape_operator" and rng.random() < 0.5:
        values["material.bending_modulus_weft"] = values["material.bending_modulus"] * log_uniform(rng, 0.1, 10.0)
    if model in ("crossed", "altitude") or (model == "quadratic" and rng.random() < 0.5):
        values |= bending_friction(rng, values["material.bending_modulus"])
    return values


def bending_friction(rng: np.random.Generator, modulus: float) -> dict[str, Any]:
    """Draw internal friction of bending, elastic up to a curvature of 0.01 to 5/m, up to ten times a modulus [N m]."""
    curvature = log_uniform(rng, 0.01, 5.0)
    moment = float(f"{modulus * curvature * log_uniform(rng, 0.1, 10.0):.9g}")
    return {"bending.friction_moment": moment, "bending.yield_curvature": curvature}


def fabric_membrane(rng: np.random.Generator, values: Mapping[str, Any]) -> dict[str, Any]:
    """Draw membrane triangles, half of which stiffen with strain."""
    stretch = values["material.stretch_modulus"]
    drawn: dict[str, Any] = {
        "membrane.model": "triangles",
        "material.shear_modulus": stretch * log_uniform(rng, 0.01, 0.5),
        "material.poisson_ratio": float(rng.uniform(-0.3, 0.5)),
        "material.stretch_modulus_weft": stretch * log_uniform(rng, 0.5, 2.0),
        "material.warp_direction": [*drawn_alike(rng.normal(size=2)).tolist(), 0.0],
    }
    if rng.random() < 0.5:
        for name in ("warp", "weft", "shear"):
            drawn[f"material.{name}_stiffening"] = [log_uniform(rng, 0.005, 0.2), log_uniform(rng, 2.0, 30.0)]
    return drawn


def upright_orientation(rng: np.random.Generator) -> list[float]:
    """Draw the orientation of an upright sheet: the default one after a random yaw."""
    half, root = rng.uniform(0.0, math.pi), math.sqrt(0.5)
    sine, cosine = drawn_alike([root * math.sin(half), root * math.cos(half)]).tolist()
    return [cosine, sine, sine, cosine]


def initial_state(rng: np.random.Generator, scene: Scene, amplitude: float) -> State:
    """Draw a start at rest, or one with a smooth deformation and velocity."""
    state = scene.starting_state()
    if rng.random() < 0.5:
        return state
    rest_positions = state.positions
    size = float(np.ptp(rest_positions, axis=0).max())
    free = scene.model().inverse_masses > 0.0
    state.x += drawn_alike(0.05 * amplitude * size * smooth_field(rng, rest_positions).T * free)
    state.v += drawn_alike(rng.uniform(0.0, amplitude) * smooth_field(rng, rest_positions).T * free)
    return state


def smooth_field(rng: np.random.Generator, rest_positions: Array) -> Array:
    """Draw a smooth vector field (n, 3) over positions (n, 3); the longest vector has length 1."""
    size = float(np.ptp(rest_positions, axis=0).max()) or 1.0
    field = np.tile(rng.normal(size=3), (len(rest_positions), 1))
    for _ in range(4):
        waves, phase = rng.normal(scale=4.0 / size, size=3), rng.uniform(0.0, 2.0 * np.pi)
        field = field + np.cos(rest_positions @ waves + phase)[:, None] * rng.normal(size=3)
    return np.asarray(field / np.sqrt(np.sum(field * field, axis=1).max()))


def log_uniform(rng: np.random.Generator, minimum: float, maximum: float) -> float:
    """Draw a log-uniform number, rounded to nine digits because the last bits of exp differ between machines."""
    return float(f"{np.exp(rng.uniform(math.log(minimum), math.log(maximum))):.9g}")
