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
from benchmarks.peers.jobs import PeerSolver
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.simulation.sleep import wake


@attrs.frozen(kw_only=True)
class ContactPeer(PeerSolver):
    """Solver of another engine for contact, with the step of its examples."""

    #: Steps in a frame of 1/60 s.
    steps: int
    #: Differences in one scene, by its name.
    apart: dict[str, str] = attrs.field(factory=dict)


@attrs.frozen(eq=False, kw_only=True)
class EngineRecording:
    """Positions at the start and at the end of every frame."""

    #: Particles [m], (frames + 1, n, 3).
    frames: Array
    #: Centres of the pads [m], (frames + 1, pads, 3).
    pads: Array
    #: Simulated time [s], including an unfinished frame, and wall time of the steps [s].
    simulated: float
    wall: float
    #: Whether all positions stayed finite.
    finite: bool = True
    versions: dict[str, str] = attrs.field(factory=dict)
    remarks: list[str] = attrs.field(factory=list)

    @property
    def factor(self) -> float:
        """Simulated seconds per wall second."""
        return self.simulated / self.wall

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
    frames, pads, wall = [simulation.positions], [contact_scene.pad_positions], 0.0
    for frame in range(contact_scene.frames):
        commands = _events(contact_scene, frame)
        begin = time.perf_counter()
        wake(simulation.state)
        simulation.advance(commands)
        wall += time.perf_counter() - begin
        frames.append(simulation.positions)
        pinching = simulation.pinching
        pads.append(contact_scene.pad_positions if pinching is None else pinching.poses()[:, :3])
        if wall >= seconds:
            break
    simulated = (len(frames) - 1) * PERIOD
    return EngineRecording(frames=np.array(frames), pads=np.array(pads), simulated=simulated, wall=wall)


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
    peer: ContactPeer, contact_scene: ContactScene, seconds: float, *, environment: Path, threads: int = 1
) -> EngineRecording:
    """Run a scene by another engine, in a process of the peers' environment.

    Args:
        peer: the engine.
        contact_scene: the scene.
        seconds: limit of the wall time of the steps [s].
        environment: where the engines are installed.
        threads: limit for engines with several threads.

    Raises:
        PeerFailed: if the engine gives no result.
    """
    with tempfile.TemporaryDirectory() as folder:
        sheet, record = Path(folder, "sheet.npz"), Path(folder, "record.npz")
        np.savez(sheet, **contact_scene.tables())
        job = {"sheet": str(sheet), "record": str(record), "steps": peer.steps, "frames": contact_scene.frames}
        job |= {"hold": contact_scene.hold, "seconds": seconds}
        answer = peer_jobs.answer(peer, job, folder=Path(folder), environment=environment, threads=threads)
        with np.load(record) as arrays:
            frames, pads = arrays["frames"], arrays["pads"]
    return EngineRecording(
        frames=frames,
        pads=pads,
        simulated=answer["n_steps"] / peer.steps * PERIOD,
        wall=answer["wall"],
        finite=answer["finite"],
        versions=answer["versions"],
        remarks=answer["remarks"],
    )
