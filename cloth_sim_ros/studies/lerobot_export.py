# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writer of LeRobotDataset v3.0, without the lerobot package.

A run is an episode, and a frame is a row. A row holds the observations at the beginning of the frame and the frame's
action. Format: https://huggingface.co/docs/lerobot/lerobot-dataset-v3, with Parquet files and separate videos.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.lerobot_stats import aggregate, statistics
from cloth_sim_ros.studies.trajectories import Trajectory

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

VERSION = "v3.0"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
CAMERA = "observation.images.cloth"
#: Number of files per chunk folder, and size of a full data or video file [MB]: the format's defaults.
_CHUNK_FILES, _DATA_MB, _VIDEO_MB = 1000, 100, 200
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
#: Further columns of every dataset and their types.
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_DEFAULTS = {"timestamp": "float32", **dict.fromkeys(_INDICES, "int64")}


def write(path: Path, runs: Iterator[Trajectory], *, task: str, video: bool) -> None:
    """Write runs as the episodes of a LeRobot dataset, a new folder. Raises StudyError if they differ in layout.

    Args:
        path: folder to create.
        runs: the runs, all of one cloth.
        task: description of the task.
        video: true to render each run.

    Raises:
        StudyError: if the runs differ in rate, grippers, obstacles or particles, or the rate is no whole number.
    """
    dataset: _Dataset | None = None
    try:
        for run in runs:
            if dataset is None:
                dataset = _Dataset(path, run, task=task, video=video)
            dataset.add(run)
    finally:
        if dataset is not None:
            dataset.close()
    assert dataset is not None
    dataset.finish()


def features_of(run: Trajectory) -> dict[str, dict[str, Any]]:
    """Return data type, shape and component names of a run's features, in the form of LeRobot's info.json."""
    grippers, particles = run.grippers, run.positions.shape[1]
    poses = [f"{name}.{axis}" for name in grippers for axis in (*_POSE, "closed")]
    actions = [f"{name}.{axis}" for name in grippers for axis in (*_POSE, "close")]
    wrenches = [f"{name}.{axis}" for name in grippers for axis in ("fx", "fy", "fz", "tx", "ty", "tz")]
    obstacles = [f"{name}.{axis}" for name in run.obstacles for axis in _POSE]
    points = [f"{k}.{axis}" for k in range(particles) for axis in "xyz"]
    speeds = [f"{k}.v{axis}" for k in range(particles) for axis in "xyz"]
    widths = {
        "observation.state": poses,
        "observation.environment_state": points,
        "observation.velocities": speeds,
        "observation.wrench": wrenches,
        "observation.obstacles": obstacles,
        "action": actions,
    }
    named = {name: names for name, names in widths.items() if names}
    wide = {name: {"dtype": "float32", "shape": [len(names)], "names": names} for name, names in named.items()}
    return wide | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _DEFAULTS.items()}


def columns_of(run: Trajectory) -> dict[str, np.ndarray]:
    """Return a run's observations and actions, as they are at the beginning of each frame, shape (T, width) each."""
    count = len(run.actions)
    # The observed wrench is that of the previous frame; the first frame has none.
    wrenches = np.concatenate([np.zeros_like(run.wrenches[:1]), run.wrenches[:-1]])
    arrays = {
        "observation.state": _known_poses(run.poses[:-1], run.actions),
        "observation.environment_state": run.positions[:-1],
        "observation.velocities": run.velocities[:-1],
        "observation.wrench": wrenches,
        "observation.obstacles": run.obstacle_poses[:-1],
        "action": _known_poses(run.actions, run.actions),
    }
    return {name: values.reshape(count, -1) for name, values in arrays.items() if values.size}


def _known_poses(rows: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Return rows of poses or actions (T, grippers, 8) without NaN: a gripper's first target stands before it.

    A gripper without any is at the origin.
    """
    rows = rows.copy()
    for k in range(rows.shape[1]):
        targets = actions[~np.isnan(actions[:, k, 0]), k, :7]
        first_target = targets[0] if len(targets) else (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        rows[np.isnan(rows[:, k, 0]), k, :7] = first_target
    return rows


class _Dataset:
    """Writer of a LeRobot dataset: `add` appends episodes, then `close` and `finish` complete the files."""

    def __init__(self, path: Path, run: Trajectory, *, task: str, video: bool) -> None:
        if not float(run.rate).is_integer():
            raise StudyError(f"the scene's rate is {run.rate} Hz; LeRobot needs a whole number: change rate")
        self._path, self._task, self._video = path, task, video
        self._fps = int(run.rate)
        self._features = features_of(run)
        self._info: dict[str, Any] = {}
        self._episodes: list[dict[str, Any]] = []
        self._stats: list[dict[str, dict[str, np.ndarray]]] = []
        self._writer: pq.ParquetWriter | None = None
        self._file = 0
        self._frames = 0

    def add(self, run: Trajectory) -> None:
        """Append a run as the next episode. Raises StudyError if its rate or features differ from the first one's."""
        if run.rate != self._fps:
            remedy = "a dataset has one for all episodes: remove rate from vary, or export with --mcap"
            raise StudyError(f"rate of run {run.run} is {run.rate} Hz, of the first one {self._fps}; {remedy}")
        if features_of(run) != self._features:
            raise StudyError(
                f"run {run.run} has other grippers, obstacles or particles than the first one; LeRobot has one layout "
                "for all episodes: export with --zarr, or do not vary them"
            )
        count, episode = len(run.actions), len(self._episodes)
        columns = columns_of(run)
        columns["timestamp"] = (np.arange(count) / self._fps).astype(np.float32)
        columns["frame_index"] = np.arange(count)
        columns["episode_index"] = np.full(count, episode)
        columns["index"] = np.arange(self._frames, self._frames + count)
        columns["task_index"] = np.zeros(count, dtype=np.int64)
        chunk, file = self._write_rows(columns)
        entry: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [self._task],
            "length": count,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + count,
        }
        stats = {name: statistics(values) for name, values in columns.items()}
        if self._video:
            entry |= self._write_video(run, episode, stats)
        self._frames += count
        self._stats.append(stats)
        flat = {f"stats/{name}/{key}": v.tolist() for name, of in stats.items() for key, v in of.items()}
        self._episodes.append(entry | flat | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})

    def close(self) -> None:
        """Close the current file of rows."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def finish(self) -> None:
        """Write the dataset's metadata: episodes, tasks, features and statistics."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        target = self._path / EPISODES.format(chunk_index=0, file_index=0)
        target.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._episodes), target, compression="snappy")
        pq.write_table(_tasks(self._task), self._path / "meta" / "tasks.parquet")
        features = dict(self._features)
        if self._video:
            features[CAMERA] = self._info
        info = {
            "codebase_version": VERSION,
            "robot_type": "cloth_sim_ros",
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": 1,
            "chunks_size": _CHUNK_FILES,
            "data_files_size_in_mb": _DATA_MB,
            "video_files_size_in_mb": _VIDEO_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": DATA,
            "video_path": VIDEO if self._video else None,
            "features": features,
        }
        (self._path / "meta" / "info.json").write_text(json.dumps(info, indent=4))
        statistics = aggregate(self._stats)
        total = {name: {key: values.tolist() for key, values in of.items()} for name, of in statistics.items()}
        (self._path / "meta" / "stats.json").write_text(json.dumps(total, indent=4))

    def _data_file(self) -> Path:
        chunk, file = divmod(self._file, _CHUNK_FILES)
        return self._path / DATA.format(chunk_index=chunk, file_index=file)

    def _write_rows(self, columns: dict[str, np.ndarray]) -> tuple[int, int]:
        """Write an episode's rows as one row group and return the indices of its chunk and file."""
        import pyarrow.parquet as pq

        table = _table(columns, self._features)
        path = self._data_file()
        if self._writer is not None and path.stat().st_size >= _DATA_MB * 1024**2:
            self.close()
            self._file += 1
            path = self._data_file()
        if self._writer is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, table.schema, compression="snappy", use_dictionary=True)
        self._writer.write_table(table)
        return self._file // _CHUNK_FILES, self._file % _CHUNK_FILES

    def _write_video(self, run: Trajectory, episode: int, stats: dict[str, Any]) -> dict[str, Any]:
        """Render a run into its own video file and return the file's location for the table of episodes."""
        from cloth_sim_ros.studies.video import render

        chunk, file = episode // _CHUNK_FILES, episode % _CHUNK_FILES
        path = self._path / VIDEO.format(video_key=CAMERA, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._info, pixels = render(run, path, fps=self._fps)
        stats[CAMERA] = pixels
        return {
            f"videos/{CAMERA}/chunk_index": chunk,
            f"videos/{CAMERA}/file_index": file,
            f"videos/{CAMERA}/from_timestamp": 0.0,
            f"videos/{CAMERA}/to_timestamp": len(run.actions) / self._fps,
        }


def _table(columns: dict[str, np.ndarray], features: dict[str, dict[str, Any]]) -> pa.Table:
    """Return rows as an Arrow table with fixed-length lists and the schema metadata of Hugging Face's datasets."""
    import pyarrow as pa

    arrays, schema = {}, {}
    for name, feature in features.items():
        values, kind = columns[name], pa.type_for_alias(feature["dtype"])
        value = {"dtype": feature["dtype"], "_type": "Value"}
        if values.ndim == 1:
            arrays[name], schema[name] = pa.array(values, type=kind), value
        else:
            flat = pa.array(values.astype(feature["dtype"]).ravel(), type=kind)
            arrays[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
            schema[name] = {"feature": value, "length": values.shape[1], "_type": "Sequence"}
    metadata = {"huggingface": json.dumps({"info": {"features": schema}})}
    return pa.table(arrays).replace_schema_metadata(metadata)


def _tasks(task: str) -> pa.Table:
    """Return the table of tasks with pandas metadata; the task's text is the index."""
    import pyarrow as pa

    def column(name: str, kind: str, numpy_kind: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}

    pandas = {
        "index_columns": ["task"],
        "column_indexes": [column(None, "unicode", "object") | {"field_name": None}],  # type: ignore[arg-type]
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array([0], type=pa.int64()), "task": pa.array([task])})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
