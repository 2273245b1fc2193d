# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes of `make bits`, and their events.

Together they use every force, contact, both precisions, several orders and all integrators.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from typing import Any

_GRID = {
    "cloth.resolution": [9, 8],
    "cloth.size": [0.4, 0.35],
    "cloth.position": [0.1, -0.3, 1.7],
    "cloth.orientation": [0.61, 0.07, -0.13, 0.77],
    "gripper.radius": 0.08,
}
#: A sheet on a table, rotated so that its last particle is carried over it.
_FLAT = {
    "cloth.resolution": [9, 8],
    "cloth.size": [0.4, 0.35],
    "cloth.position": [0.0, 0.0, 0.0075],
    "cloth.orientation": [0.0, 0.0, 1.0, 1.0],
    "cloth.anchors": [""],
    "contact.thickness": 0.008,
    "gripper.radius": 0.06,
    "obstacles": ["table"],
    "table.shape": "box",
    "table.size": [1.0, 0.9, 0.04],
    "table.position": [0.0, 0.0, -0.02],
    "table.friction": [0.6, 0.4],
}
_BENT = {"material.bending_modulus": 1e-4, "material.stretch_modulus": 100.0, "material.shear_modulus": 10.0}
#: Parameters of each scene. Positions and rotations come from fractions, not from sines, so that only the package's
#: computation is tested.
SCENES: dict[str, dict[str, Any]] = {
    "axial springs": _GRID,
    "membrane triangles": {
        **_GRID,
        "membrane.model": "triangles",
        "bending.model": "none",
        "material.stretch_modulus_weft": 300.0,
        "material.poisson_ratio": 0.3,
        "material.warp_direction": [0.6, 0.8, 0.0],
    },
    "implicit fabric": {
        **_GRID,
        "cloth.resolution": [6, 7],
        "material.fabric": "polyester_plain",
        "integrator": "implicit",
        "tolerance": 1e-2,
    },
    "opposite springs": {**_GRID, "bending.model": "opposite", "bending.stiffness": 0.5},
    "crossed springs": {**_GRID, **_BENT, "bending.model": "crossed"},
    "altitude springs": {**_GRID, **_BENT, "bending.model": "altitude", "bending.rest_angle": 0.4},
    "friction of bending": {
        **_GRID,
        **_BENT,
        "bending.model": "crossed",
        "bending.friction_moment": 1e-3,
        "bending.yield_curvature": 1.0,
    },
    "friction of bending, mesh": {
        "cloth.mesh": "sheet.obj",
        "cloth.anchors": ["0", "6"],
        "gripper.radius": 0.1,
        "bending.model": "altitude",
        **_BENT,
        "bending.friction_moment": 1e-3,
        "bending.yield_curvature": 1.0,
    },
    "wind on a surface": {
        **_GRID,
        "wind.velocity": [3.0, 1.0, 0.3],
        "wind.normal_drag": 1.0,
        "wind.tangential_drag": 0.05,
        "diagnostics.energy": True,
    },
    "carried air": {
        **_GRID,
        **_BENT,
        "bending.model": "altitude",
        "air.added_mass": 0.1,
        "wind.velocity": [3.0, 1.0, 0.3],
        "diagnostics.energy": True,
    },
    "carried air of a mesh": {
        "cloth.mesh": "sheet.obj",
        "cloth.anchors": ["0", "6"],
        "bending.model": "opposite",
        "air.added_mass": 0.1,
        "gripper.radius": 0.1,
    },
    "implicit": {
        **_GRID,
        "cloth.resolution": [6, 7],
        "integrator": "implicit",
        "tolerance": 1e-2,
        "material.stretch_modulus": 3e4,
        "material.shear_modulus": 3e3,
    },
    "loose tolerance": {**_GRID, "cloth.resolution": [24, 24], "cloth.size": [1.0, 1.0], "tolerance": 3e-3},
    "tight tolerance": {**_GRID, "cloth.resolution": [6, 6], "tolerance": 1e-9},
    "mesh": {
        "cloth.mesh": "sheet.obj",
        "cloth.anchors": ["0", "6"],
        "bending.model": "opposite",
        "gripper.radius": 0.1,
    },
    "raw springs": {"cloth.springs": "net.yaml", "cloth.anchors": ["0"], "bending.model": "none"},
    "two threads": {**_GRID, "cloth.resolution": [64, 64], "cloth.size": [1.0, 1.0], "tolerance": 0.0},
    "obstacles": {
        **_GRID,
        "contact.thickness": 0.01,
        "diagnostics.energy": True,
        "obstacles": ["floor", "ball", "crate", "finger", "drum"],
        "floor.shape": "plane",
        "floor.position": [0.0, 0.0, 1.5],
        "floor.orientation": [0.1, 0.0, 0.0, 1.0],
        "ball.shape": "sphere",
        "ball.size": [0.08],
        "ball.position": [0.2, -0.6, 1.75],
        "crate.shape": "box",
        "crate.size": [0.1, 0.2, 0.15],
        "crate.position": [-0.05, 0.0, 1.6],
        "finger.shape": "capsule",
        "finger.size": [0.03, 0.1],
        "finger.position": [0.05, -0.5, 1.65],
        "drum.shape": "cylinder",
        "drum.size": [0.06, 0.3],
        "drum.position": [-0.1, -0.2, 2.0],
    },
    "friction": {
        **_FLAT,
        "obstacles": ["table", "ball"],
        "ball.shape": "sphere",
        "ball.size": [0.06],
        "ball.position": [0.05, 0.0, 0.15],
        "ball.friction": [1.0],
    },
    "friction, implicit": {**_FLAT, "cloth.resolution": [6, 6], "integrator": "implicit"},
    "pinch": {
        **_FLAT,
        "cloth.position": [0.0, 0.0, 0.175],
        "cloth.orientation": [1.0, 0.0, 0.0, 1.0],
        "cloth.anchors": ["top"],
        "gripper.mode": "pinch",
        "gripper.pad_size": [0.15, 0.02, 0.15],
        "gripper.opening": 0.03,
        "gripper.force": 1.0,
        "tolerance": 1e-2,
        "obstacles": [""],
    },
    "cloth on itself": {
        **_FLAT,
        "cloth.resolution": [7, 6],
        "cloth.anchors": ["top", "left"],
        "contact.self": True,
        "contact.thickness": 0.012,
        "cloth.position": [0.0, 0.0, 0.0115],
        "tolerance": 1e-2,
    },
    "prescribed grip": {
        **_GRID,
        **_BENT,
        "bending.model": "crossed",
        "cloth.resolution": [17, 16],
        "gripper.model": "prescribed",
        "diagnostics.energy": True,
    },
    "prescribed grip, mesh on a table": {
        "cloth.mesh": "sheet.obj",
        "cloth.anchors": ["0"],
        "cloth.position": [0.0, 0.0, 0.0075],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "bending.model": "opposite",
        "contact.thickness": 0.008,
        "tolerance": 1e-2,
        "gripper.radius": 0.1,
        "gripper.model": "prescribed",
        "obstacles": ["table"],
        "table.shape": "box",
        "table.size": [1.0, 1.0, 0.04],
        "table.position": [0.0, 0.0, -0.02],
        "table.friction": [0.5, 0.4],
    },
    "prescribed grip, implicit": {
        **_GRID,
        "cloth.resolution": [6, 7],
        "integrator": "implicit",
        "tolerance": 1e-2,
        "gripper.model": "prescribed",
    },
    "mesh on itself": {
        "cloth.mesh": "sheet.obj",
        "cloth.anchors": ["0", "6", "42"],
        "cloth.position": [0.0, 0.0, 0.0075],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "bending.model": "opposite",
        "contact.self": True,
        "contact.thickness": 0.008,
        "tolerance": 1e-2,
        "gripper.radius": 0.1,
        "obstacles": ["table"],
        "table.shape": "box",
        "table.size": [1.0, 1.0, 0.04],
        "table.position": [0.0, 0.0, -0.02],
        "table.friction": [0.5, 0.4],
    },
    "joined nets with hinges": {
        "cloth.springs": "nets.yaml",
        "cloth.anchors": ["0"],
        "cloth.position": [0.0, 0.0, 0.05],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.joints": ["3-19"],
        "cloth.joint_stiffness": 20.0,
        "bending.model": "altitude",
        "bending.flat": True,
        "bending.rest_angles": "angles.yaml",
        "material.bending_modulus": 1e-4,
        "contact.self": True,
        "contact.thickness": 0.015,
        "tolerance": 1e-2,
        "gripper.radius": 0.06,
        "obstacles": ["table"],
        "table.shape": "box",
        "table.size": [1.0, 1.0, 0.04],
        "table.position": [0.0, 0.0, -0.02],
        "table.friction": [0.5, 0.4],
    },
}
#: Fraction of the frames to run, for scenes with expensive frames.
_FRAME_FRACTION = {
    "two threads": 0.2,
    "tight tolerance": 0.5,
    "friction, implicit": 0.25,
    "implicit": 0.5,
    "implicit fabric": 0.5,
    "prescribed grip, implicit": 0.5,
}
#: Smallest number of frames of a whole motion; shorter runs contain only its beginning.
_MIN_MOTION_FRAMES = 40
#: Total displacement of obstacles [m]; they rotate as well.
MOVED = {
    "obstacles": {
        "floor": (0.0, 0.0, 0.05),
        "ball": (0.0, 0.5, 0.0),
        "crate": (0.1, -0.25, 0.0),
        "finger": (0.0, 0.4, 0.1),
        "drum": (0.0, 0.0, -0.25),
    },
    "friction": {"table": (0.1, 0.0, 0.02), "ball": (-0.1, 0.05, -0.055)},
    "friction, implicit": {"table": (0.1, 0.0, 0.02)},
}
#: Parameters that change at half time, in addition to those of all scenes.
CHANGED: dict[str, dict[str, Any]] = {
    "obstacles": {"obstacles": ["ball", "floor", "drum", "finger"], "contact.thickness": 0.008},
    "friction": {"table.friction": [0.2, 0.1], "contact.damping": 3.0},
    "pinch": {"gripper.force": 2.0},
    # The change compresses contacts, which then regain their thickness.
    "friction, implicit": {"contact.thickness": 0.01},
    "cloth on itself": {"contact.thickness": 0.016},
    "mesh on itself": {"contact.thickness": 0.01},
}


def sheet() -> bytes:
    """Return an OBJ mesh of 7 x 7 vertices, none exactly at a grid's position."""
    lines = []
    for row in range(7):
        for column in range(7):
            away = ((5 * row + 3 * column) % 7 - 3) / 200.0
            lines.append(f"v {column / 15.0 + away!r} {row / 15.0 - 0.7 * away!r} 0.0")
    for row in range(6):
        for column in range(6):
            a = 7 * row + column + 1
            lines += [f"f {a} {a + 1} {a + 8}", f"f {a} {a + 8} {a + 7}"]
    return "\n".join(lines).encode()


def net() -> bytes:
    """Return a springs file: two strands of springs that joints connect."""
    places = [[k / 10.0, 0.0, 0.0] for k in range(12)] + [[k / 10.0, 0.1, (k % 3) / 30.0] for k in range(12)]
    strands = [[k, k + 1] for k in range(11)] + [[k, k + 1] for k in range(12, 23)]
    cross = [[k, 12 + k] for k in range(1, 12, 2)]
    joints = [[0, 12], [10, 22]]
    tables = {
        "positions": places,
        "masses": 0.01,
        "springs": strands + cross + joints,
        "rest_lengths": [0.1] * (len(strands) + len(cross)) + [0.0] * len(joints),
        "stiffness": 20.0,
        "k_d0": 0.1,
        "velocities": [[0.0, 0.0, k / 50.0] for k in range(24)],
    }
    return json.dumps(tables).encode()


def nets() -> bytes:
    """Return a springs file: two nets of 4 x 4 particles over one another, which a joint connects, with triangles."""
    places = [[c / 15.0 + k / 90.0, r / 15.0, k / 40.0] for k in range(2) for r in range(4) for c in range(4)]
    springs, triangles = list[list[int]](), list[list[int]]()
    for first in (0, 16):
        for r in range(4):
            for c in range(4):
                i = first + 4 * r + c
                springs += [[i, i + 1]] * (c < 3) + [[i, i + 4]] * (r < 3) + [[i, i + 5]] * (c < 3 and r < 3)
                triangles += [[i, i + 1, i + 5], [i, i + 5, i + 4]] * (c < 3 and r < 3)
    joint = [[0, 16]]
    tables = {
        "positions": places,
        "masses": 0.01,
        "springs": springs + joint,
        "rest_lengths": [(1.0 + (b - a == 5) * 0.4140625) / 15.0 for a, b in springs] + [0.0],
        "stiffness": 20.0,
        "k_d0": 0.1,
        "triangles": triangles,
    }
    return json.dumps(tables).encode()


def angles() -> bytes:
    """Return a file of rest angles: a crease in the upper net."""
    return json.dumps({"edges": [[20, 21], [21, 22]], "angles": [0.5, 0.25]}).encode()


FILES: dict[str, Callable[[], bytes]] = {"sheet.obj": sheet, "net.yaml": net, "nets.yaml": nets, "angles.yaml": angles}


def frames_of(scene: str, frames: int) -> Iterator[str]:
    """Run a scene here; yield the digest of state and wrenches after each frame."""
    import xxhash

    for frame, simulation in run(scene, frames):
        loads = xxhash.xxh3_64_hexdigest(frame.wrenches.tobytes() + frame.obstacle_wrenches.tobytes())
        yield f"{simulation.state.digest()} {loads}"


def run(scene: str, frames: int) -> Iterator[tuple[Any, Any]]:
    """Run a scene here; yield each frame and the simulation after it.

    The gripper grasps the last particle, carries and rotates it, and releases it. Obstacles move; parameters change.
    """
    from cloth_sim_ros.scene.scene import Scene
    from cloth_sim_ros.simulation.events import Event, Grasp, Move, SetParameters, Target
    from cloth_sim_ros.simulation.simulation import Simulation

    values = SCENES[scene]
    files = {name: FILES[name]() for name in values.values() if isinstance(name, str) and name in FILES}
    simulation = Simulation(Scene.from_parameters(values, files=files))
    start_of_grasp, moved = simulation.positions[-1], MOVED.get(scene, {})
    count = max(1, round(frames * _FRAME_FRACTION.get(scene, 1.0)))
    for k in range(count):
        fraction = k / max(count, _MIN_MOTION_FRAMES)
        orientation = (fraction / 3.0, 0.0, fraction, 1.0)
        displacement = (-0.3 * fraction, -0.35 * fraction, 0.3 * fraction * (1.0 - fraction))
        events: list[Event] = [Target("gripper", _translated(start_of_grasp, displacement), orientation)]
        for name in moved.keys() & set(simulation.scene.obstacle_names):
            start, displacement_of_obstacle = (
                simulation.scene.described[name].position,
                [fraction * c for c in moved[name]],
            )
            events.append(
                Move(name, _translated(start, displacement_of_obstacle), (0.1 * fraction, 0.0, 0.2 * fraction, 1.0))
            )
        if k == count // 8:
            events.append(Grasp("gripper", True))
        if k == count // 2:
            events.append(SetParameters({"air.drag": 0.7, "wind.velocity": [0.5, 1.0, 0.0], **CHANGED.get(scene, {})}))
        if k == 7 * count // 8:
            events.append(Grasp("gripper", False))
        yield simulation.advance(events), simulation


def _translated(position: Sequence[float], displacement: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(a + b) for a, b in zip(position, displacement, strict=True))
