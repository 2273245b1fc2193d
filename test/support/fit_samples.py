# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Synthetic recordings of swung cloths for fits.

Two hands hold and swing a cloth. A camera records it with noise and misses some particles.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode_cloud
from cloth_sim_ros.simulation.events import Event, Grasp, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Simulation
from support.session_maker import START as EPOCH
from support.session_maker import SessionMaker, cloud_bytes, target_bytes

#: Clouds per second [Hz].
RATE = 30.0
#: Edge of the sheet [m], and reduction of the hands' distance relative to it.
SIZE, NEARER = 0.4, 0.1
#: Amplitudes [m] and frequencies [Hz] of the hands' common motion along x, y, z, and opposite motion along y.
AMPLITUDES, FREQUENCIES = (0.008, 0.024, 0.016, 0.012), (1.3, 1.7, 3.1, 2.3)
#: Ranges of the true parameters, uniform in their logarithms. `START` has the starting values of the fits.
RANGES = {
    "material.stretch_modulus": (100.0, 1000.0),
    "material.shear_modulus": (10.0, 100.0),
    "material.bending_modulus": (5e-5, 1e-3),
    "material.damping": (0.05, 0.3),
}
START = {name: float(np.sqrt(low * high)) for name, (low, high) in RANGES.items()}


def cloth(values: dict[str, Any], *, resolution: int = 10, files: dict[str, bytes] | None = None) -> Scene:
    """Return the scene of a square cloth with two hands at its upper corners; `values` are by full name."""
    return Scene.from_parameters(
        {
            "rate": RATE,
            "cloth.size": [SIZE, SIZE],
            "cloth.resolution": [resolution, resolution],
            "cloth.anchors": [""],
            "grippers": ["left", "right"],
            "gripper.radius": 0.03,
            "bending.model": "crossed",
            "tolerance": 1e-6,
            "work_limit": 0.0,
            **values,
        },
        files=files,
    )


def hung(scene: Scene, seconds: float = 3.0) -> State:
    """Return the state of a cloth that hangs nearly at rest between two approached hands.

    A short wind determines the side of the bulge. Thick air damps the motion.
    """
    simulation = Simulation(scene)
    left, right = hands(0.0)
    frames = round(seconds * scene.rate)
    for k in range(frames):
        share = 1.0 - NEARER + NEARER * max(0.0, 1.0 - k / (0.3 * frames))
        shape = np.array([share / (1.0 - NEARER), 1.0, 1.0])
        events: list[Event] = [Target("left", left * shape), Target("right", right * shape)]
        if not k:
            events += [Grasp("left", True), Grasp("right", True)]
            events.append(SetParameters({"air.drag": 6.0, "wind.velocity": [0.0, 3.0, 0.0]}))
        if k == frames // 2:
            events.append(SetParameters({"wind.velocity": [0.0, 0.0, 0.0]}))
        simulation.advance(events)
    simulation.advance([SetParameters({"air.drag": scene.air.drag})])
    return simulation.state


def hands(t: float, *, strength: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the left and the right hand at a time [s], shape (3,) each [m].

    The swing starts smoothly over 0.3 s.
    """
    ramp = min(1.0, t / 0.3)
    ramp *= strength * ramp * (3.0 - 2.0 * ramp)
    x, y, z, turn = (ramp * a * np.sin(2.0 * np.pi * f * t) for a, f in zip(AMPLITUDES, FREQUENCIES, strict=True))
    both, corner = np.array([x, y, z]), np.array([0.5 * SIZE * (1.0 - NEARER), 0.0, 1.0 + 0.5 * SIZE])
    against = np.array([0.0, turn, 0.0])
    return corner * [-1.0, 1.0, 1.0] + both + against, corner + both - against


def record_swing(
    folder: Path,
    values: dict[str, Any],
    *,
    seed: int = 0,
    seconds: float = 2.0,
    noise: float = 0.002,
    missing: float = 1.0 / 3.0,
    resolution: int = 10,
    strength: float = 1.0,
    stem: str = "swing",
    distort: Callable[[str, bytes, int], bytes] = lambda _topic, data, _frame: data,
) -> Path:
    """Record a session of a swing with noisy clouds and return its path.

    Args:
        folder: folder of the session.
        values: true parameters by full name.
        seed: seed of the noise.
        seconds: length of the session [s].
        noise: standard deviation of each coordinate [m].
        missing: fraction of the particles that each cloud lacks (NaN).
        resolution: particles along an edge.
        strength: factor of the swing's `AMPLITUDES`.
        stem: first part of the file's name.
        distort: changes the bytes of a message before recording; takes topic, bytes and index of the frame, from 0.
    """
    state = hung(cloth(values, resolution=resolution))
    state.frame = 0
    start = {"hung.npz": state.to_bytes()}
    scene = cloth({**values, "initial_state": "hung.npz"}, resolution=resolution, files=start)
    random = np.random.default_rng(seed)

    def see(topic: str, data: bytes) -> bytes:
        if not topic.endswith("/points"):
            return data
        xyz = np.array(decode_cloud(data).xyz, dtype=np.float64)
        xyz += random.normal(scale=noise, size=xyz.shape) if noise else 0.0
        xyz[random.random(len(xyz)) < missing] = np.nan
        return cloud_bytes(xyz, maker.log_time, scene.shape)

    maker = SessionMaker(folder, scene, stem=stem)
    for k in range(round(seconds * RATE)):
        left, right = hands((k + 1) / RATE, strength=strength)
        maker.add(
            [Target("left", left, (0.0, 0.0, 0.0, 1.0)), Target("right", right, (0.0, 0.0, 0.0, 1.0))],
            change=lambda topic, data, k=k: distort(topic, see(topic, data), k),
        )
    return maker.finish()


def random_truth(seed: int) -> dict[str, float]:
    """Return true parameters drawn from `RANGES`, by full name."""
    random = np.random.default_rng([seed, 16])
    return {name: float(low * (high / low) ** random.random()) for name, (low, high) in RANGES.items()}


def write_bag(
    path: Path,
    values: dict[str, Any],
    *,
    seconds: float = 0.5,
    noise: float = 0.0,
    off: tuple[float, float, float] = (0.0, 0.0, 0.0),
    resolution: int = 6,
    see: Callable[[np.ndarray, int], bytes] | None = None,
    poses: tuple[str, str] = ("/robot/left/pose", "/robot/right/pose"),
    begin: float = 0.0,
    rate: int = 30,
    still: float = 0.0,
) -> Path:
    """Write an MCAP like that of a real cloth and return its path.

    It has clouds between frames and poses at 100 Hz. It has no scene and no state.

    Args:
        path: file to write.
        values: true parameters by full name.
        seconds: length of the recording [s].
        noise: standard deviation of each coordinate [m].
        off: offset of every cloud [m].
        resolution: particles along an edge.
        see: returns the bytes of a cloud from particle positions [m], shape (n, 3), and stamp [ns].
        poses: topics of the hands' poses.
        begin: start of the recording [s]; the swing starts at 0.
        rate: clouds per second [Hz], 30 or 60.
        still: time before the end during which the hands stand still [s].
    """
    swing = seconds - still
    from mcap.writer import Writer

    scene = cloth({**values, "rate": 60.0}, resolution=resolution)
    state = hung(scene, 8.0)
    state.frame = 0
    simulation, random = Simulation(scene, state), np.random.default_rng(5)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        cloud = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"")
        pose = writer.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"")
        clouds = writer.register_channel("/camera/points", "cdr", cloud)
        hand = [writer.register_channel(topic, "cdr", pose) for topic in poses]
        for k in range(max(-20, round(100 * begin)), round(100 * seconds) + 5):
            now = EPOCH + k * 10_000_000
            for channel, position in zip(hand, hands(min(max(0.01 * k, 0.0), swing)), strict=True):
                writer.add_message(channel, now, target_bytes(Target("hand", position, (0.0, 0.0, 0.0, 1.0)), now), now)
        for k in range(round(60 * seconds) + 1):
            if k:
                left, right = hands(min(k / 60.0, swing))
                simulation.advance([Target("left", left), Target("right", right)])
            if k % (60 // rate) == 0 and k >= round(60 * begin):
                now = EPOCH + round(k / 60.0 * 1e9)
                x = simulation.positions + off + random.normal(scale=noise, size=(scene.shape[0] * scene.shape[1], 3))
                data = cloud_bytes(x, now, (1, len(x))) if see is None else see(x, now)
                writer.add_message(clouds, now, data, now)
        writer.finish()
    return path
