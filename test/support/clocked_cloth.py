# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node whose time a test sets by /clock, so that commands take effect in known frames."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import numpy as np
from geometry_msgs.msg import PointStamped
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Bool

from cloth_sim_ros.ros.node import ClothNode
from support.ros_client import Client, pose

SECOND = 1_000_000_000


class ClockedCloth:
    """A cloth in this process that follows /clock, and a client that publishes it; a context manager.

    Args:
        client: its context and executor are shared.
        begin: first time of /clock [s].
        name: name of the node.
        parameters: by full name; the default is a small grid with fast frames.
        signal_name: returns the name of a signal that ends the start; None for no such signal.
    """

    def __init__(
        self,
        client: Client,
        parameters: dict[str, Any] | None = None,
        *,
        begin: int = 100,
        name: str = "cloth_sim",
        signal_name: Callable[[], str] | None = None,
    ) -> None:
        values = {"cloth.resolution": [6, 7], "use_sim_time": True, **(parameters or {})}
        self.client = client
        self.node = ClothNode(
            name,
            signal_name=signal_name,
            context=client.context,
            parameter_overrides=[Parameter(key, value=value) for key, value in values.items()],
        )
        self.simulation = self.node.simulation
        self._rate = self.simulation.scene.rate
        self.tick_index = round(begin * self._rate)
        self._sent = 0
        client.executor.add_node(self.node.node)
        self.node.start()
        self._clock = client.publisher(Clock, "/clock")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.client.executor.remove_node(self.node.node)
        self.node.close()
        self.node.node.destroy_node()

    @property
    def now(self) -> int:
        """Time of the newest tick [ns]."""
        return int(self.tick_index * SECOND / self._rate)

    def publish_clock(self, time: int) -> None:
        """Set the time [ns]."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time, SECOND)
        self._clock.publish(message)

    def tick(self, count: int = 1) -> None:
        """Run a number of frames, and wait for each."""
        for _ in range(count):
            frame = self.simulation.frame
            self.publish_clock(self.now)
            self.tick_index += 1
            self.client.spin_until(lambda frame=frame: self.simulation.frame > frame, description=f"frame {frame + 1}")

    def send(self, leaf: str, message: Any) -> None:
        """Publish a command, and wait until the node has received it."""
        kind = type(message)
        publisher = self.client.publisher(kind, f"{self.node.node.get_fully_qualified_name()}/{leaf}")
        commands = self.node.inputs.commands
        publisher.publish(message)
        self._sent += 1
        self.client.spin_until(
            lambda: commands.received == self._sent, description=f"{self._sent} commands to be taken"
        )

    def target(self, gripper: str, position: Any, *, stamp: int = 0, w: float = 1.0) -> None:
        """Send a target."""
        self.send(f"{gripper}/target", pose(*(float(value) for value in position), stamp=stamp, w=w))

    def point(self, gripper: str, position: Any, *, stamp: int = 0) -> None:
        """Send a target by position alone."""
        message = PointStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
        message.point.x, message.point.y, message.point.z = (float(value) for value in position)
        self.send(f"{gripper}/point", message)

    def grasp(self, gripper: str, closed: bool) -> None:
        """Close or open a gripper."""
        self.send(f"{gripper}/grasp", Bool(data=closed))

    def position(self, gripper: str) -> np.ndarray:
        """Return the position of a gripper [m], shape (3,)."""
        return self.simulation.grippers.poses()[self._index(gripper), :3]

    def held(self, gripper: str) -> list[int]:
        """Return the particles that a gripper holds."""
        return [int(particle) for particle in self.simulation.grippers.grasped_particles(self._index(gripper))]

    def is_closed(self, gripper: str) -> bool:
        """Return true if a gripper is closed."""
        return self.simulation.grippers.is_closed(self._index(gripper))

    @property
    def refused(self) -> tuple[int, int]:
        """Numbers of refused commands, and of commands older than the newest."""
        return self.node.inputs.commands.refused, self.node.inputs.commands.outdated

    def _index(self, gripper: str) -> int:
        return self.simulation.grippers.names.index(gripper)
