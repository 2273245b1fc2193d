# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writer of runs as a zarr v3 group.

Each quantity is an array whose first axis is the run. A chunk holds a run or a part of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.folder import StudyFolder
from cloth_sim_ros.studies.trajectories import Trajectory

#: Unit and trailing axes of each array, by field of the trajectory; the first axes are run and frame. States have one
#: more frame.
ARRAYS = {
    "positions": ("m", ("particle", "xyz")),
    "velocities": ("m/s", ("particle", "xyz")),
    "poses": ("m, quaternion x y z w, closed", ("gripper", "pose")),
    "actions": ("m, quaternion x y z w, close", ("gripper", "command")),
    "wrenches": ("N, N m", ("gripper", "wrench")),
    "obstacle_poses": ("m, quaternion x y z w", ("obstacle", "pose")),
}
#: Largest chunk before compression [bytes].
_MAX_CHUNK_BYTES = 64_000_000


def write(path: Path, runs: Iterator[Trajectory], count: int, study_folder: StudyFolder) -> None:
    """Write runs as a new zarr group, padded with NaN to equal sizes. Raises StudyError if they differ in layout.

    Args:
        path: folder to create.
        runs: the runs.
        count: number of runs.
        study_folder: folder of the study.

    Raises:
        StudyError: if the runs differ in rate, grippers or obstacles.
    """
    import zarr

    group = zarr.open_group(str(path), mode="w-", zarr_format=3)
    frame_counts, particle_counts, run_indices, arrays = list[int](), list[int](), list[int](), dict[str, Any]()
    triangles = list[NDArray[np.int32]]()
    unique_triangles: dict[bytes, NDArray[np.int32]] = {}
    names: dict[str, Any] = {}
    for run in runs:
        properties = {"rate": run.rate, "grippers": list(run.grippers), "obstacles": list(run.obstacles)}
        names = names or properties
        for name, value in properties.items():
            if value != names[name]:
                remedy = f"a dataset has one for all runs: remove {name} from vary, or export with --mcap"
                raise StudyError(f"{name} of run {run.run} is {value}, of the first one {names[name]}; {remedy}")
        k = len(run_indices)
        triangles.append(unique_triangles.setdefault(run.triangles.tobytes(), run.triangles))
        run_indices.append(run.run)
        frame_counts.append(len(run.actions))
        particle_counts.append(run.positions.shape[1])
        for name, (unit, axes) in ARRAYS.items():
            values = getattr(run, name)
            if 0 in values.shape:
                continue
            if name not in arrays:
                arrays[name] = _create(group, name, unit, axes, (count, *values.shape))
            array = arrays[name]
            if any(have < want for have, want in zip(array.shape[1:], values.shape, strict=True)):
                array.resize((count, *np.maximum(array.shape[1:], values.shape).tolist()))
            array[(k, *(slice(0, size) for size in values.shape))] = values
    group.create_array("triangles", data=_common_triangles(triangles))
    for name, values in (("run", run_indices), ("frame_count", frame_counts), ("particle_count", particle_counts)):
        group.create_array(name, data=np.array(values, dtype=np.int64))
    group.attrs.update(
        {
            "format": "cloth_sim_ros study",
            "study": study_folder.study_file.read_text(encoding="utf-8"),
            "frames": "row t of positions, velocities, poses and obstacle_poses is the state at t / rate; row t of "
            "actions and wrenches is what happened from there to the next",
            **names,
        }
    )


def _common_triangles(triangles: list[NDArray[np.int32]]) -> NDArray[np.int32]:
    """Return the triangles of all runs, shape (m, 3); if runs differ, shape (runs, m, 3), padded with -1."""
    if all(other_triangles is triangles[0] for other_triangles in triangles):
        return triangles[0]
    padded = np.full((len(triangles), max(map(len, triangles)), 3), -1, dtype=np.int32)
    for k, run_triangles in enumerate(triangles):
        padded[k, : len(run_triangles)] = run_triangles
    return padded


def _create(group: Any, name: str, unit: str, axes: tuple[str, ...], shape: tuple[int, ...]) -> Any:
    from zarr.codecs import ZstdCodec

    per_frame = 4 * int(np.prod(shape[2:]))
    frames_per_chunk = min(shape[1], max(_MAX_CHUNK_BYTES // per_frame, 1))
    return group.create_array(
        name,
        shape=shape,
        chunks=(1, frames_per_chunk, *shape[2:]),
        dtype="float32",
        fill_value=float("nan"),
        compressors=[ZstdCodec(level=3)],
        dimension_names=("run", "frame", *axes),
        attributes={"unit": unit},
    )
