# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Opening of a session for a replay: names, anchors and the grippers' start.

Reads scene.yaml and state.npz without importing scene or physics.
"""

from __future__ import annotations

import io
import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.session.errors import SessionError

#: Maximum uncompressed size of a state's arrays [bytes].
_MAX_STATE_BYTES = 128 << 20
#: Exceptions of numpy's and Python's readers for damaged archives.
_ARCHIVE_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError, SyntaxError, MemoryError),
    *(OSError, ValueError, TypeError, LookupError, EOFError, OverflowError, RuntimeError),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperStart:
    """State of a gripper in the snapshot that a recording begins with, before its first frame."""

    name: str
    pose: NDArray[np.float64] | None
    """Position [m] and quaternion x, y, z, w, shape (7,); None before its first target."""
    target: NDArray[np.float64]
    closed: bool
    grasped: NDArray[np.int64]
    """Indices of the grasped particles."""
    pinches: bool = False
    """True if it closes pads, which are drawn as obstacles, instead of grasping particles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Opening:
    """Contents of a session's opening that a replay shows: frame, anchors, grippers, obstacles, positions."""

    frame_id: str
    anchors: tuple[str, ...]
    gripper_radius: float
    grippers: tuple[GripperStart, ...]
    obstacles: tuple[str, ...]
    """Names of all described obstacles, active or not."""
    positions: NDArray[np.float64]
    """Particle positions before the first frame [m], shape (particle_count, 3)."""
    has_ensemble: bool = False
    """True if an ensemble of uncertain parameters ran beside the cloth."""

    def anchored_particles(self, rows: int, columns: int, anchors: Sequence[str] | None = None) -> NDArray[np.intp]:
        """Return the sorted indices of anchored particles, from names of a grid's edges and corners, or indices.

        `anchors`: `cloth.anchors`; by default that of the snapshot.
        """
        grid = np.arange(rows * columns, dtype=np.intp).reshape(rows, columns)
        lines = {"top": grid[0], "bottom": grid[-1], "left": grid[:, 0], "right": grid[:, -1]}
        corners: dict[str, NDArray[np.intp]] = {}
        for row in ("top", "bottom"):
            corners |= {f"{row}_left": lines[row][[0]], f"{row}_right": lines[row][[-1]]}
        named_particles = {**lines, **corners}
        particles: set[int] = set()
        for name in self.anchors if anchors is None else anchors:
            if name.isdecimal() and int(name) < grid.size:
                particles.add(int(name))
            elif rows > 1 and name in named_particles:
                particles.update(named_particles[name].tolist())
        return np.array(sorted(particles), dtype=np.intp)


def read_opening(scene_yaml: str, state: bytes) -> Opening:
    """Read scene.yaml and state.npz of a session. Raises SessionError if they are invalid."""
    try:
        return _opening(scene_yaml, state)
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        # Either may be intact and hold entries of wrong types or shapes.
        cause = "scene.yaml or state.npz of the session is not one that cloth_sim wrote"
        raise SessionError(f"{cause}: {error}") from error


def _opening(scene_yaml: str, state: bytes) -> Opening:
    values = _parameters(scene_yaml)
    arrays = _arrays(state)
    names = [name for name in _texts(values.get("grippers")) if name]
    mode = str(values.get("gripper.mode", "attach"))
    try:
        positions = np.ascontiguousarray(arrays["position"].T, dtype=np.float64)
    except KeyError as error:
        raise SessionError("state.npz holds no particle positions") from error
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"the positions have the shape {positions.T.shape}")
    return Opening(
        frame_id=str(values.get("frame_id", "world")),
        anchors=tuple(_texts(values.get("cloth.anchors"))),
        gripper_radius=float(values.get("gripper.radius", 0.05)),
        grippers=tuple(
            _gripper(name, index, arrays, str(values.get(f"{name}.mode", mode)), len(positions))
            for index, name in enumerate(names)
        ),
        obstacles=tuple(sorted(name.removesuffix(".shape") for name in values if name.endswith(".shape"))),
        positions=positions,
        has_ensemble=bool(values.get("ensemble.file")),
    )


def _gripper(name: str, index: int, arrays: dict[str, NDArray[Any]], mode: str, particle_count: int) -> GripperStart:
    def entry(key: str, default: NDArray[Any]) -> NDArray[Any]:
        stored = arrays.get(f"memory.{key}")
        return default if stored is None or index >= len(stored) else stored[index]

    nowhere = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    starts = arrays.get("memory.grip.starts", np.zeros(0, dtype=np.int64))
    particles = arrays.get("memory.grip.particles", np.zeros(0, dtype=np.int64))
    known = index + 1 < len(starts)
    grasped = particles[starts[index] : starts[index + 1]] if known else particles[:0]
    pose, target = (np.asarray(entry(key, nowhere), np.float64) for key in ("gripper.pose", "gripper.target"))
    if pose.shape != nowhere.shape or target.shape != nowhere.shape:
        raise ValueError(f"the pose or the target of {name} is not 7 numbers")
    if len(grasped) and not 0 <= int(grasped.min()) <= int(grasped.max()) < particle_count:
        raise ValueError(f"{name} holds a particle that is not there")
    return GripperStart(
        name=name,
        pose=pose if bool(entry("gripper.placed", np.array(False))) else None,
        target=target,
        closed=bool(entry("gripper.closed", np.array(False))),
        grasped=grasped,
        pinches=mode == "pinch",
    )


def _texts(value: Any) -> Sequence[str]:
    return [str(item) for item in value] if isinstance(value, list | tuple) else []


def _parameters(text: str) -> dict[str, Any]:
    """Return all parameters of a ROS parameter file with one node, by full name."""
    import yaml

    try:
        for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            if isinstance(event, yaml.AliasEvent):
                raise yaml.YAMLError("it has an alias, which ROS does not read")
        tree = yaml.safe_load(text)
        content = next(iter(tree.values()))["ros__parameters"]
    except (yaml.YAMLError, AttributeError, StopIteration, LookupError, TypeError, ValueError, RecursionError) as error:
        raise SessionError(f"scene.yaml of the session is no ROS parameter file: {error}") from error
    values: dict[str, Any] = {}
    waiting = [("", content)]
    while waiting:
        prefix, branch = waiting.pop()
        for key, value in branch.items():
            if isinstance(value, dict):
                waiting.append((f"{prefix}{key}.", value))
            else:
                values[f"{prefix}{key}"] = value
    return values


def _arrays(data: bytes) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _MAX_STATE_BYTES:
            raise SessionError(f"state.npz of the session has arrays of {size} bytes, the limit is {_MAX_STATE_BYTES}")
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except _ARCHIVE_ERRORS as error:
        raise SessionError(f"state.npz of the session is not readable: {error}") from error
