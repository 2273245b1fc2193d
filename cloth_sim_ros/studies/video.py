# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Video of a run: drawn by matplotlib, encoded as H.264 by PyAV."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.lerobot_stats import QUANTILES, Statistics
from cloth_sim_ros.studies.trajectories import Trajectory

#: Height and width [pixels].
HEIGHT, WIDTH = 240, 320
_CODEC, _PIXELS = "libx264", "yuv420p"


def render(run: Trajectory, path: Path, *, fps: int) -> tuple[dict[str, Any], Statistics]:
    """Write the video (H.264) of a run; return its LeRobot feature and the pixels' statistics. Raises StudyError.

    Args:
        run: the run.
        path: file to write.
        fps: frames per second.

    Returns:
        The feature in the form of info.json, and statistics of the pixels per channel, from 0 to 1, shape (3, 1, 1).

    Raises:
        StudyError: if PyAV lacks the encoder.
    """
    import av

    if _CODEC not in av.codecs_available:
        raise StudyError(f"videos need the encoder {_CODEC}, which this PyAV lacks: pip install av")
    channels: list[Any] = []
    with av.open(str(path), "w") as container:
        stream = container.add_stream(_CODEC, rate=fps, options={"crf": "23", "g": "2"})
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, _PIXELS
        for picture in _pictures(run):
            channels.append(picture.reshape(-1, 3)[::16] / 255.0)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    feature = {
        "dtype": "video",
        "shape": [HEIGHT, WIDTH, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": HEIGHT,
            "video.width": WIDTH,
            "video.codec": "h264",
            "video.pix_fmt": _PIXELS,
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        },
    }
    return feature, _statistics(np.concatenate(channels), len(channels))


def _statistics(pixels: np.ndarray, frames: int) -> Statistics:
    values = {
        "min": pixels.min(axis=0),
        "max": pixels.max(axis=0),
        "mean": pixels.mean(axis=0),
        "std": pixels.std(axis=0),
        **dict(zip(QUANTILES, np.quantile(pixels, list(QUANTILES.values()), axis=0), strict=True)),
    }
    return {name: value.reshape(3, 1, 1) for name, value in values.items()} | {"count": np.array([frames])}


def _pictures(run: Trajectory) -> Any:
    """Yield a picture of the cloth at the beginning of each frame, shape (HEIGHT, WIDTH, 3), uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    figure = Figure(figsize=(WIDTH / 100.0, HEIGHT / 100.0), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
    axes.set_axis_off()
    low, high = run.positions.min(axis=(0, 1)), run.positions.max(axis=(0, 1))
    middle, half = (low + high) / 2.0, max(float((high - low).max()) / 2.0, 1e-3)
    axes.set(**{f"{axis}lim": (m - half, m + half) for axis, m in zip("xyz", middle.tolist(), strict=True)})
    for positions in run.positions[:-1]:
        surface = Poly3DCollection(positions[run.triangles], facecolors="#d94f40", shade=True, linewidths=0.0)
        axes.add_collection3d(surface)
        canvas.draw()
        yield np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, :3])
        surface.remove()
