# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time from the start of `cloth_viewer` to the first surface in its recording, and the size of a frame.

`python -m benchmarks ros-viewer` runs a cloth, and starts the viewer beside it several times with `--save`. A viewer
with a window paints the same messages; the time until its window is open is not part of the figure.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ros.node_process import module_process, node_process
from validation.command import at_least

#: Time for which the viewer records, for the size of a frame [s].
_RECORDED = 2.0
_CLOTH = "/world/cloth"
#: Largest time to the first surface [s].
GOAL = 3.0


def measure_viewer(target: str, folder: Path) -> tuple[float, float, int]:
    """Start the viewer of a node; return the time to its first surface [s], and sizes [bytes].

    The sizes are those of a frame of the surface, and of its triangles, which are sent once.

    Raises:
        RuntimeError: if it ends, or writes no surface.
    """
    out = folder / "out.rrd"
    out.unlink(missing_ok=True)
    begun = time.monotonic()
    with module_process("cloth_sim_ros.ros.viewer_main", "--node", target, "--save", str(out)) as viewer:
        viewer.wait_until(lambda: _surface_sizes(out)[0], "surface")
        wall = time.monotonic() - begun
        time.sleep(_RECORDED)
    n_frames, n_bytes, triangle_bytes = _surface_sizes(out)
    return wall, n_bytes / n_frames, triangle_bytes


def _surface_sizes(path: Path) -> tuple[int, int, int]:
    """Return the number of frames in a recording, their size, and that of the triangles [bytes]."""
    from rerun.chunk import RrdReader

    if not path.exists() or not path.stat().st_size:
        return 0, 0, 0
    n_frames = n_bytes = triangle_bytes = 0
    try:
        with warnings.catch_warnings():
            # The file still grows.
            warnings.simplefilter("ignore")
            for chunk in RrdReader(path).stream():
                if chunk.entity_path == _CLOTH:
                    batch = chunk.to_record_batch()
                    if chunk.is_static:
                        triangle_bytes += batch.nbytes
                    else:
                        n_frames, n_bytes = n_frames + batch.num_rows, n_bytes + batch.nbytes
    except (ValueError, RuntimeError):
        # Its last message is incomplete.
        return 0, 0, 0
    return n_frames, n_bytes, triangle_bytes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--starts", type=at_least(1), default=5, help="starts of the viewer")
    parser.add_argument("--ros", nargs=argparse.REMAINDER, default=[], help="further ROS arguments of the cloth")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the figures; they are met if the median time is below the goal."""
    name = f"viewed_{os.getpid()}"
    with tempfile.TemporaryDirectory() as folder, node_process(["-r", f"__node:={name}", *options.ros]) as node:
        node.wait_for_output("wall time, grippers")
        starts = [measure_viewer(f"/{name}", Path(folder)) for _ in range(options.starts)]
    median = float(np.median([wall for wall, _, _ in starts]))
    return {
        "first_surface_s": [round(wall, 3) for wall, _, _ in starts],
        "first_surface_median_s": round(median, 3),
        "frame_bytes": round(starts[-1][1]),
        "triangle_bytes_once": starts[-1][2],
        "load_average": round(os.getloadavg()[0], 2),
        "goal_s": GOAL,
        "met": median < GOAL,
    }
