# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs of contact scenes by the product and by other engines; their penetration, self-intersection and creep."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import attrs
import numpy as np
from numpy.typing import NDArray
from support.problems import PERIOD

from benchmarks.peers import jobs as peer_jobs
from benchmarks.peers.contact_scenes import ContactScene
from benchmarks.peers.jobs import Attempt, Peer
from benchmarks.peers.runner import largest_stretch
from cloth_sim_ros import Grasp, Model, Simulation, Target
from cloth_sim_ros.physics.contact import self_contact_binding
from cloth_sim_ros.physics.contact.initial_penetration import find_self_intersection
from cloth_sim_ros.physics.contact.obstacle_mesh import nearest_points
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.sleep import wake

#: Stretch of an edge above which a peer's sheet is torn.
TORN = 1.5


@attrs.frozen(eq=False, kw_only=True)
class EngineRecording(Attempt):
    """Run of a scene with contact, and the positions at the start and at the end of every whole frame."""

    #: Particles [m], (frames + 1, n, 3).
    frames: Array
    #: Centres of the pads [m], (frames + 1, pads, 3).
    pads: Array

    @property
    def seen(self) -> float:
        """Time of the last whole frame [s]."""
        return (len(self.frames) - 1) * PERIOD


def run_product(contact_scene: ContactScene, seconds: float) -> EngineRecording:
    """Run a scene by the product as shipped, without sleep: the cloth is woken before each frame.

    Args:
        contact_scene: the scene.
        seconds: limit of the wall time of the frames [s].
    """
    simulation = Simulation(contact_scene.scene)
    frames, pads, wall, cpu = [simulation.positions], [contact_scene.pad_positions], 0.0, 0.0
    for frame in range(contact_scene.frames):
        commands = _events(contact_scene, frame)
        begin, cpu_begin = time.perf_counter(), time.process_time()
        wake(simulation.state)
        simulation.advance(commands)
        wall, cpu = wall + time.perf_counter() - begin, cpu + time.process_time() - cpu_begin
        frames.append(simulation.positions)
        pinching = simulation.pinching
        pads.append(contact_scene.pad_positions if pinching is None else pinching.poses()[:, :3])
        if wall >= seconds:
            break
    stretch = max(largest_stretch(x, contact_scene.edges, contact_scene.edge_lengths) for x in frames)
    return EngineRecording(
        steps=1,
        whole=True,
        stretch=stretch,
        n_steps=len(frames) - 1,
        wall=wall,
        cpu=cpu,
        frames=np.array(frames),
        pads=np.array(pads),
    )


def _events(contact_scene: ContactScene, frame: int) -> list[Event]:
    """Return the commands to the grippers before a frame."""
    names = contact_scene.scene.gripper_names
    if contact_scene.pads:
        position = contact_scene.pad_positions.mean(axis=0)
        return [] if frame else [Target(names[0], position), Grasp(names[0], True)]
    if frame > contact_scene.hold or not names:
        return []
    if frame == contact_scene.hold:
        return [Grasp(name, False) for name in names]
    ends = contact_scene.path[frame + 1]
    commands: list[Event] = [Target(name, end) for name, end in zip(names, ends, strict=True)]
    return commands if frame else commands + [Grasp(name, True) for name in names]


def run_peer(
    peer: Peer, contact_scene: ContactScene, steps: int, seconds: float, *, environment: Path
) -> EngineRecording:
    """Run a scene by another engine on one thread, in a process of the peers' environment.

    Args:
        peer: the engine.
        contact_scene: the scene.
        steps: steps per frame of 1/60 s.
        seconds: limit of the wall time of the steps [s].
        environment: where the engines are installed.

    Raises:
        PeerFailed: if the engine gives no result.
    """
    with tempfile.TemporaryDirectory() as folder:
        sheet, record = Path(folder, "sheet.npz"), Path(folder, "record.npz")
        np.savez(sheet, **contact_scene.tables())
        attempt = peer_jobs.attempt(
            peer,
            sheet,
            steps,
            environment=environment,
            frames=contact_scene.frames,
            seconds=seconds,
            whole=TORN,
            record=str(record),
            hold=contact_scene.hold,
        )
        with np.load(record) as arrays:
            return EngineRecording(frames=arrays["frames"], pads=arrays["pads"], **attrs.asdict(attempt))


def depth_in_ball(frames: Array, triangles: NDArray[np.int64], radius: float) -> float:
    """Return the largest depth of any triangle point in a ball about the origin [m]; 0 without penetration.

    Args:
        frames: positions [m], (frames, n, 3).
        triangles: (t, 3).
        radius: of the ball [m].
    """
    nearest = radius
    for x in frames:
        # A triangle without area has no normal; its edges are used.
        with np.errstate(invalid="ignore", divide="ignore"):
            points = nearest_points(np.zeros((1, 3)), x[triangles])[0]
        nearest = min(nearest, float(np.sqrt(np.nanmin((points * points).sum(axis=1)))))
    return radius - nearest


def depth(frames: Array, solid: Obstacle, places: Array) -> float:
    """Return the largest depth of any particle in an obstacle [m]; 0 without penetration.

    Args:
        frames: positions [m], (frames, n, 3).
        solid: the obstacle, without rotation.
        places: its position in each frame, or in all frames [m], (frames, 3) or (3,).
    """
    away = frames - np.broadcast_to(places, (len(frames), 3))[:, None, :]
    gaps, _ = solid.distance(away.reshape(-1, 3))
    return max(0.0, -float(gaps.min()))


def crossings(frames: Array, triangles: NDArray[np.int64], rest_positions: Array) -> list[int]:
    """Return the indices of frames in which an edge of the cloth intersects one of its triangles.

    Args:
        frames: positions [m], (frames, n, 3).
        triangles: (t, 3).
        rest_positions: positions at rest [m], (n, 3).
    """
    plan = PlanHandle(Model(np.ones(len(rest_positions)), []))
    # The thickness does not matter for intersection.
    surface = ContactSurface(triangles, rest_positions, thickness=1e-9)
    self_contact_binding.upload_surface(plan.pointer, Contact(thickness=1e-9, surface=surface))
    intersections = (find_self_intersection(plan, np.ascontiguousarray(x.T)) for x in frames)
    return [index for index, intersection in enumerate(intersections) if intersection is not None]


def creep_on_ball(frames: Array, seconds: float, radius: float, contact_range: float) -> float:
    """Return the mean speed of the fastest particle on a ball [m/s]; nan if none is on it.

    Args:
        frames: positions over the measured time [m], (frames, n, 3).
        seconds: length of that time [s].
        radius: of the ball about the origin [m].
        contact_range: a particle within this distance of the ball at both ends of the time is on it [m].
    """
    first, last = frames[0], frames[-1]
    in_contact = np.ones(frames.shape[1], dtype=bool)
    for x in (first, last):
        in_contact &= np.linalg.norm(x, axis=1) - radius <= contact_range
    if not in_contact.any():
        return float("nan")
    return float(np.linalg.norm(last - first, axis=1)[in_contact].max()) / seconds


def sinking(frames: Array, seconds: float, between: NDArray[np.bool_]) -> float:
    """Return the mean downward speed of some particles [m/s].

    Args:
        frames: positions over the measured time [m], (frames, n, 3).
        seconds: length of that time [s].
        between: mask of these particles, (n,).
    """
    return float((frames[0] - frames[-1])[between, 2].mean()) / seconds


def between_pads(start: Array, solid: Obstacle, places: Array) -> NDArray[np.bool_]:
    """Return the mask of particles between the pads, (n,).

    Args:
        start: positions [m], (n, 3).
        solid: a pad; y is normal to its faces.
        places: positions of both pads [m], (2, 3).
    """
    x, _, z = (0.5 * length for length in solid.size)
    away = np.abs(start - places.mean(axis=0))
    between: NDArray[np.bool_] = (away[:, 0] <= x) & (away[:, 2] <= z)
    return between


def dropped(frames: Array, solid: Obstacle, pads: Array) -> int | None:
    """Return the index of the first frame with all of the cloth below the pads; None if there is none.

    Args:
        frames: positions [m], (frames, n, 3).
        solid: a pad.
        pads: positions of both [m], (frames, 2, 3).
    """
    below = frames[:, :, 2].max(axis=1) < pads[:, :, 2].min(axis=1) - 0.5 * solid.size[2]
    return int(np.argmax(below)) if below.any() else None
