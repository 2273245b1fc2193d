# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cost of a frame with and without subscriber and recorder.

`python -m benchmarks ros-outputs` runs the same cloth four times in turns, frame by frame. It has no receiver, a
subscriber in another process, a recorder, or both. A frame consists of steps, record and messages. Without
receiver no message may be built.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from typing import Any

from rclpy.node import Node

from benchmarks.ros.node_process import PATIENCE, listener_process, ros_context
from benchmarks.timing import InterleavedTimes
from cloth_sim_ros.ros.io.outputs import ClothTopics
from cloth_sim_ros.ros.recording.recording import SessionRecording
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Pause after each frame [s], as the rest of a period, for the recorder thread and the subscriber.
_PAUSE = 0.005
#: Warm-up frames.
_FIRST = 10
PRESENCES = {"nobody": (False, False), "subscriber": (True, False), "recorder": (False, True), "both": (True, True)}
#: Largest share that both together add to a frame of 16 thousand particles.
GOAL = 0.10


class Candidate:
    """Cloth with its outputs.

    Args:
        name: name of its node.
        scene: configuration.
        subscribed: whether a subscriber runs in another process.
        recorded: whether it is recorded.
    """

    def __init__(self, name: str, scene: Scene, *, subscribed: bool, recorded: bool) -> None:
        self._node = Node(name)
        self._simulation = Simulation(scene)
        self._recording = SessionRecording(node_name=self._node.get_fully_qualified_name(), simulation=self._simulation)
        self._outputs = ClothTopics(self._node, scene, self._recording)
        self._subscriber = contextlib.ExitStack()
        topic = f"{self._node.get_fully_qualified_name()}/points"
        if subscribed:
            self._subscriber.enter_context(listener_process(topic))
            end = time.monotonic() + PATIENCE
            while not self._node.count_subscribers(topic):
                if time.monotonic() > end:
                    raise RuntimeError(f"nobody listens on {topic} after {PATIENCE:g} s")
                time.sleep(0.05)
        if recorded:
            self._recording.begin(self._now())
            self._recording.wait_until_open()

    def frame(self) -> float:
        """Run one frame as a node does; return its wall time [s]."""
        stamp = self._now()
        begun = time.perf_counter()
        self._recording.before_frame(stamp)
        frame = self._simulation.advance()
        self._recording.add_frame(frame, stamp)
        state, fields = self._simulation.state, self._simulation.scene.points
        self._outputs.send(state.x, frame.wrenches, stamp, velocities=state.v, fields=fields)
        return time.perf_counter() - begun

    @property
    def published(self) -> int:
        """Number of published clouds."""
        return self._outputs.published

    def close(self) -> None:
        """Stop the subscriber, the recording and the node."""
        self._subscriber.close()
        self._recording.end(reason="measured", timeout=10.0)
        self._node.destroy_node()

    def _now(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)


@contextlib.contextmanager
def candidates(resolution: int) -> Iterator[dict[str, Candidate]]:
    """Yield the four cloths; recordings go to a temporary folder."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        cloths = {}
        for name, (subscribed, recorded) in PRESENCES.items():
            values = {"cloth.resolution": [resolution, resolution], "record.folder": folder}
            scene = Scene.from_parameters(values)
            cloths[name] = Candidate(f"outputs_{os.getpid()}_{name}", scene, subscribed=subscribed, recorded=recorded)
            stack.callback(cloths[name].close)
        yield cloths


def measure(resolution: int, frames: int) -> InterleavedTimes:
    """Return the frame times [s] of the four cloths, in turns.

    Raises:
        RuntimeError: if a cloud was built without receiver, or missing with one.
    """
    with candidates(resolution) as cloths:
        times: dict[str, list[float]] = {name: [] for name in cloths}
        for k in range(frames + _FIRST):
            for name, candidate in cloths.items():
                frame_time = candidate.frame()
                if k >= _FIRST:
                    times[name].append(frame_time)
                time.sleep(_PAUSE)
        for name, candidate in cloths.items():
            expected = 0 if name == "nobody" else frames + _FIRST
            if candidate.published != expected:
                raise RuntimeError(f"with {name} there, {candidate.published} clouds were built instead of {expected}")
    return InterleavedTimes(times)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--resolution", type=int, default=128, help="particles a side (default: 128, 16 thousand)")
    parser.add_argument("--frames", type=int, default=100, help="of each (default: 100)")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the times; they are met if both receivers together add at most `GOAL`."""
    if options.frames < 1:
        raise ValueError(f"--frames is {options.frames}; at least 1 is needed")
    with ros_context():
        times = measure(options.resolution, options.frames)
    presences = {
        name: {"median_ms": round(1e3 * times.median(name), 4), "to_nobody": round(times.ratio(name, "nobody"), 4)}
        for name in PRESENCES
    }
    met = presences["both"]["to_nobody"] <= 1.0 + GOAL
    return {"particles": options.resolution**2, "presences": presences, "goal": 1.0 + GOAL, "met": met}
