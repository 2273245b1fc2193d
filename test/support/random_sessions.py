# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random sessions: scene, events, splits and cuts, from one seed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.writer import WriterOptions
from cloth_sim_ros.simulation.event_checks import EventError
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Pause, Relax, Reset, SetParameters, Step, Target
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from support import random_contact
from support.random_contact import SIZES, random_obstacles
from support.session_maker import Change, SessionMaker

_ANCHORS = (["top"], ["top_left", "top_right"], ["left"], ["0"], ["bottom", "3"], [""])


def random_scene(
    random: np.random.Generator, *, obstacles: bool = False, contact: bool = False, hinges: bool = False
) -> Scene:
    """Return a small cloth with random geometry, material and grippers.

    Optionally with obstacles around it, with all kinds of contact, or with hinges.
    """
    while True:
        values = _values(random)
        if hinges:
            values["bending.model"] = str(random.choice(["crossed", "altitude"]))
            values["material.bending_modulus"] = float(10.0 ** random.uniform(-6.0, -3.0))
        if obstacles:
            values |= _obstacles(random, values)
        if contact:
            values = random_contact.contact_values(random, values)
        try:
            scene = Scene.from_parameters(values)
            Simulation(scene)
        except ValueError:
            # Some materials do not fit some grids, and obstacles may intersect the cloth.
            continue
        return scene


def _obstacles(random: np.random.Generator, values: dict[str, Any]) -> dict[str, Any]:
    """Return obstacles near a cloth: all are described, some are active."""
    parameters: dict[str, Any] = {"contact.thickness": float(random.uniform(0.002, 0.01))}
    for shape, count in SIZES.items():
        parameters[f"{shape}_1.shape"] = shape
        if count:
            parameters[f"{shape}_1.size"] = random.uniform(0.05, 0.5, count).tolist()
        offset = random.normal(scale=0.4, size=3) - np.array([0.0, 0.0, 0.6 if shape == "plane" else 0.1])
        parameters[f"{shape}_1.position"] = (np.array(values["cloth.position"]) + offset).tolist()
        if shape != "plane":
            parameters[f"{shape}_1.orientation"] = random.normal(size=4).tolist()
        parameters[f"{shape}_1.friction"] = [float(random.uniform(0.0, 1.0))]
    return {**parameters, "obstacles": random_obstacles(random)}


def _values(random: np.random.Generator) -> dict[str, Any]:
    rows, columns = (int(n) for n in random.integers(3, 13, 2))
    size = random.uniform(0.3, 1.5, 2).tolist()
    return {
        "rate": float(random.choice([30.0, 50.0, 60.0, 120.0])),
        "cloth.size": size,
        "cloth.resolution": [rows, columns],
        "cloth.position": random.uniform(-1.0, 1.0, 3).tolist(),
        "cloth.orientation": random.normal(size=4).tolist(),
        "cloth.anchors": _ANCHORS[random.integers(len(_ANCHORS))],
        "cloth.shear_layout": str(random.choice(["left", "right", "alternating", "both"])),
        "material.density": float(random.uniform(0.05, 0.5)),
        "material.stretch_modulus": float(10.0 ** random.uniform(1.5, 3.0)),
        "material.shear_modulus": float(random.uniform(1.0, 10.0)),
        "material.damping": float(random.uniform(0.0, 0.5)),
        "bending.model": str(random.choice(["none", "axial", "opposite"])),
        "bending.stiffness": float(random.uniform(0.0, 2.0)),
        "air.drag": float(random.choice([0.0, 0.3])),
        "grippers": [["gripper"], ["left", "right"], [""]][random.integers(3)],
        "gripper.radius": float(random.uniform(0.05, 0.4) * min(size)),
    }


def random_events(random: np.random.Generator, maker: SessionMaker, *, contact: bool = False) -> list[Event]:
    """Return random events before one frame: mostly targets; changes of contact if `contact`."""
    simulation = maker.simulation
    events: list[Event] = []
    for name in simulation.scene.gripper_names:
        for _ in range(int(random.integers(0, 3))):
            particle = simulation.positions[random.integers(simulation.state.particle_count)]
            turn = random.normal(size=4)
            position = tuple(float(x) for x in particle + random.normal(scale=0.02, size=3))
            turned = tuple((turn / np.linalg.norm(turn)).tolist()) if random.random() < 0.5 else None
            # A target whose pads would intersect the cloth is refused.
            with contextlib.suppress(EventError):
                simulation.check(Target(name, position, turned))
                events.append(Target(name, position, turned))
        if random.random() < 0.15:
            events.append(Grasp(name, bool(random.random() < 0.6)))
    scene = simulation.scene
    for name in scene.obstacle_names:
        if random.random() < 0.3:
            particle = simulation.positions[random.integers(simulation.state.particle_count)]
            turn = random.normal(size=4)
            events.append(
                Move(name, tuple((particle + random.normal(scale=0.2, size=3)).tolist()), tuple(turn.tolist()))
            )
    if random.random() < 0.05:
        change = SetParameters(
            {"obstacles": random_obstacles(random)} if scene.described and random.random() < 0.5 else _change(random)
        )
        # With contact, a fixed step may be refused later, during the run.
        if not (contact and "step" in change.values):
            with contextlib.suppress(EventError):
                simulation.check(change)
                events.append(change)
    if contact and random.random() < 0.1:
        changed = SetParameters(random_contact.change(random))
        # Two changes in one frame may be refused although each is valid.
        if not any(isinstance(event, SetParameters) for event in events):
            with contextlib.suppress(EventError):
                simulation.check(changed)
                events.append(changed)
    if random.random() < 0.05:
        events.append(Pause(not simulation.paused))
    if simulation.paused and random.random() < 0.4:
        events.append(Step() if random.random() < 0.5 else Pause(False))
    if random.random() < 0.05:
        events.append(Relax(float(random.choice([1.0, 2.0, 10.0]))))
    # A reset may be refused if the obstacles have changed.
    if random.random() < 0.02 and not any(isinstance(event, SetParameters) for event in events):
        with contextlib.suppress(EventError):
            reset = Reset()
            if simulation.obstacles is not None and random.random() < 0.5:
                reset = Reset(simulation.obstacles.names, simulation.obstacles.poses())
            simulation.check(reset)
            events.append(reset)
    # The order of arrival is random.
    return [events[k] for k in random.permutation(len(events))]


def make_random_session(
    folder: Path,
    seed: int,
    *,
    frames: int = 60,
    obstacles: bool = False,
    contact: bool = False,
    hinges: bool = False,
    change: Callable[[int], Change | None] = lambda _frame: None,
    watch: Callable[[Simulation, Frame], object] = lambda _simulation, _frame: None,
) -> list[Path]:
    """Write a random session and return its files in order. It may be cut off or split.

    `change` may return an alteration of the k-th frame's messages. `watch` receives each frame.
    """
    random = np.random.default_rng(seed)
    options = WriterOptions(chunk_bytes=16_384, sync_seconds=0.0)
    scene = random_scene(random, obstacles=obstacles, contact=contact, hinges=hinges)
    maker = SessionMaker(folder, scene, stem=f"random_{seed}", options=options, watch=watch)
    for k in range(frames):
        spoil = change(k)
        maker.add(random_events(random, maker, contact=contact), **({"change": spoil} if spoil else {}))
        if random.random() < 0.03:
            maker.split()
    if random.random() < 0.3:
        maker.cut()
    else:
        maker.finish()
    return maker.paths


def _change(random: np.random.Generator) -> dict[str, Any]:
    changes: list[dict[str, Any]] = [
        {"material.density": float(random.uniform(0.05, 0.5))},
        {"material.stretch_modulus": float(10.0 ** random.uniform(1.5, 3.0)), "material.damping": 0.2},
        {"gravity": random.uniform(-5.0, 5.0, 3).tolist()},
        {"air.drag": float(random.uniform(0.0, 2.0)), "wind.velocity": random.uniform(-5.0, 5.0, 3).tolist()},
        {"wind.normal_drag": float(random.uniform(0.0, 2.0)), "wind.tangential_drag": 0.1},
        {"gripper.radius": float(random.uniform(0.05, 0.3)), "gripper.stiffness": float(random.uniform(10.0, 1000.0))},
        {"points.velocity": bool(random.random() < 0.5), "overload": "relax"},
        {"step": float(random.choice([0.0, 1e-4]))},
    ]
    return changes[random.integers(len(changes))]
