# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rate and completeness of large clouds at a reliable subscriber.

`python -m benchmarks ros-stream` runs a node that publishes clouds of 16 and of 65 thousand points at wall time. A
subscriber in another process records stamp and arrival of each. The cloth sleeps without gravity, so that transport is
measured, not motion. With `--moving` a soft cloth falls, whose frames at the larger size exceed the period. Frames
pause before the first counted cloud and after the last, until no cloud is in transit. Sent and received clouds are
therefore counted exactly.
"""

from __future__ import annotations

import argparse
import gc
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from benchmarks.ros.listener import LINE
from benchmarks.ros.node_process import PATIENCE, module_process, ros_context
from cloth_sim_ros.ros.node import ClothNode

#: A cloth with few steps per frame, and one that also falls asleep.
_MOVING = {"material.stretch_modulus": 10.0, "material.shear_modulus": 1.0, "bending.model": "none"}
_RESTING = {**_MOVING, "gravity": [0.0, 0.0, 0.0]}
#: Uncounted wall time after the pause of frames [s].
_FIRST = 1.0
#: Longest wait for clouds in transit [s].
_UNDER_WAY = 5.0
#: Time without a cloud after which none is in transit [s].
_QUIET = 0.5


def stream_figures(
    *, rate: float, sent: int, received: int, stamps: np.ndarray, arrivals: np.ndarray, **more: Any
) -> dict[str, Any]:
    """Return the figures of a stream of clouds; they are met if each due time had a cloud and each cloud arrived.

    Args:
        rate: frames a second.
        sent: number of clouds sent.
        received: number of clouds received.
        stamps: stamps of the clouds of the measured interval [s], (clouds,).
        arrivals: their arrival times [s].
        more: further figures.
    """
    left_out = int((np.rint(np.diff(stamps) * rate) - 1.0).clip(0.0).sum())
    spacing = 1e3 * np.diff(arrivals)
    percentiles = zip(("p1", "median", "p99", "max"), np.percentile(spacing, [1.0, 50.0, 99.0, 100.0]), strict=True)
    return {
        "rate_hz": rate,
        "sent": sent,
        "received": received,
        "lost": sent - received,
        "left_out": left_out,
        **more,
        "received_hz": round(1e3 * len(spacing) / float(spacing.sum()), 3),
        **{f"spacing_{name}_ms": round(float(value), 3) for name, value in percentiles},
        "met": received == sent > 0 and left_out == 0,
    }


def measure(resolution: int, options: argparse.Namespace) -> dict[str, Any]:
    """Run a node with `resolution` particles a side.

    Raises:
        RuntimeError: if no subscriber comes, or a cloth that should sleep does not.
    """
    values = {"cloth.resolution": [resolution, resolution], "rate": options.rate}
    values |= _MOVING if options.moving else _RESTING
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    cloth = ClothNode(f"stream_{os.getpid()}_{resolution}", parameter_overrides=overrides)
    executor = SingleThreadedExecutor()
    executor.add_node(cloth.node)
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "received"
            file.touch()
            cloth.warm_up()
            topic = f"{cloth.node.get_fully_qualified_name()}/points"
            # The subscriber has nothing to clean up, and rclpy may hang after a signal.
            with module_process("benchmarks.ros.listener", topic, str(file), patience=0.0):
                return _stream(cloth, executor, file, options)
    finally:
        cloth.close()
        executor.shutdown()


def _stream(
    cloth: ClothNode, executor: SingleThreadedExecutor, file: Path, options: argparse.Namespace
) -> dict[str, Any]:
    def spin(condition: Callable[[], bool]) -> None:
        while not condition():
            executor.spin_once(timeout_sec=0.1)

    def received() -> int:
        return file.stat().st_size // LINE.size

    def spin_to_next(moment: float) -> None:
        """Spin until the first cloud published after a time [s], so that a stall of the machine shows as a gap."""
        spin(lambda: time.monotonic() >= moment)
        count, end = cloth.published, time.monotonic() + PATIENCE
        spin(lambda: cloth.published > count or time.monotonic() > end)
        if cloth.published == count:
            raise RuntimeError(f"no cloud was published in {PATIENCE:g} s: the subscriber is gone")

    gc.collect()
    gc.freeze()
    cloth.start()
    end = time.monotonic() + PATIENCE
    spin(lambda: time.monotonic() > end or (received() > 0 and (options.moving or cloth.simulation.asleep)))
    if not received():
        raise RuntimeError(f"no cloud was received in {PATIENCE:g} s")
    if not (options.moving or cloth.simulation.asleep):
        raise RuntimeError(f"the cloth did not fall asleep in {PATIENCE:g} s")
    _wait_until_quiet(received)
    sent, got = cloth.published, received()
    # Frames due during the pause are not counted: the measured interval begins later.
    spin_to_next(time.monotonic() + _FIRST)
    late, busy, begun = cloth.timing.tally.late, cloth.timing.tally.busy, time.monotonic()
    spin_to_next(begun + options.seconds)
    ended = time.monotonic()
    load = (cloth.timing.tally.busy - busy) / (ended - begun)
    late = cloth.timing.tally.late - late
    sent = cloth.published - sent
    _wait_until_quiet(received, enough=got + sent)
    lines = np.frombuffer(file.read_bytes(), dtype="<i8").reshape(-1, 2)[got:]
    counted = lines[lines[:, 1] >= 1e9 * begun]
    if len(counted) < 2:
        raise RuntimeError(f"of {sent} clouds {len(lines)} were received, too few to tell a rate")
    return stream_figures(
        points=cloth.simulation.state.particle_count,
        rate=options.rate,
        asleep=cloth.simulation.asleep,
        sent=sent,
        received=len(lines),
        # Only differences are needed; nanoseconds since 1970 exceed the precision of a float.
        stamps=(counted[:, 0] - lines[0, 0]) * 1e-9,
        arrivals=counted[:, 1] * 1e-9,
        late=late,
        load=round(load, 4),
    )


def _wait_until_quiet(received: Callable[[], int], *, enough: int | None = None) -> None:
    """Wait until no more clouds arrive, and for `enough` clouds or the timeout if given."""
    end = time.monotonic() + _UNDER_WAY
    count, since = received(), time.monotonic()
    while time.monotonic() < end:
        if received() != count:
            count, since = received(), time.monotonic()
        # An extra cloud would also be counted.
        quiet = time.monotonic() - since > _QUIET
        if quiet and (enough is None or count >= enough):
            return
        time.sleep(0.01)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--resolutions", type=int, nargs="+", default=[128, 256], metavar="N", help="particles a side")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each")
    parser.add_argument("--rate", type=float, default=60.0, help="frames a second")
    parser.add_argument("--moving", action="store_true", help="a soft cloth that falls, not one at rest")


def figures(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the counts of each size; they are met if no cloud was lost or left out."""
    least = 2.0 / options.rate
    if not options.seconds >= least:
        raise ValueError(f"--seconds is {options.seconds:g}; at least two frames, {least:g} s, are needed")
    with ros_context():
        return [measure(resolution, options) for resolution in options.resolutions]
