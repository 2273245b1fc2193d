# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded runs of contact scenes by the product and by other engines."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import attrs
import numpy as np
from support.problems import PERIOD

from benchmarks.peers import jobs as peer_jobs
from benchmarks.peers.contact_scenes import ContactScene
from benchmarks.peers.jobs import Attempt, Peer
from benchmarks.peers.runner import largest_stretch
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation
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
