# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics of obstacles: commands, markers and wrenches.

Topics are created and removed with their obstacles. The markers include the pads of pinching grippers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node

from cloth_sim_ros.ros.io.commands import CommandSubscriptions
from cloth_sim_ros.ros.io.messages import wrench_message
from cloth_sim_ros.ros.io.output import LATCHED_QOS, Output, RecordSink
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.simulation.bodies.bodies import solids_and_poses
from cloth_sim_ros.simulation.events import Grasp, Move, MoveObstacles, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.physics.contact.obstacles import Obstacle
    from cloth_sim_ros.physics.model.forces.force import Array
    from cloth_sim_ros.ros.io.obstacle_markers import ObstacleMarkers

#: A stop within this simulated time after the previous one is the same stop [s].
_STOP_REPEAT_TIME = 1.0


class ObstacleTopics:
    """Topics of obstacles: publisher of markers and wrenches, subscriber of targets; it warns of stops and lags.

    Args:
        node: the node.
        simulation: the cloth.
        commands: subscribes to their targets.
        sink: records the published messages.
        log: receives warnings of stops and lags.
    """

    def __init__(
        self, node: Node, simulation: Simulation, commands: CommandSubscriptions, sink: RecordSink, log: ThrottledLog
    ) -> None:
        self._node, self._simulation, self._commands = node, simulation, commands
        self._sink, self._log = sink, log
        self._drawn: list[str] = []
        self._markers: ObstacleMarkers | None = None
        self._output: Output | None = None
        self._wrenches: dict[str, Output] = {}
        self._published: bytes = b""
        self._poses = np.zeros((0, 7))
        #: Names of stopped bodies without a new command since.
        self._stopped_names: set[str] = set()
        #: Frame of each body's last stop, and the number of frames after which another stop is reported.
        self._last_stop_frames: dict[str, int] = {}
        self._n_repeat_frames = round(_STOP_REPEAT_TIME * simulation.scene.rate)

    def record(self, stamp: int) -> None:
        """Record the markers of obstacles at the start of a recording, at a ROS time [ns]."""
        if self._output is not None:
            self._output.record(self._published, stamp)

    def send(self, frame: Frame, stamp: int) -> None:
        """Publish and record wrenches and moved markers at a ROS time [ns]; update topics; warn of stops and lags."""
        self._update_stopped(frame)
        self._warn_of_stops(frame)
        obstacles = self._simulation.obstacles
        solids, poses = self._solids()
        if [solid.name for solid in solids] != self._drawn:
            self.update_topics(stamp)
            return
        if not np.array_equal(poses, self._poses):
            self._publish(stamp)
        if obstacles is None:
            return
        # A paused frame moves nothing.
        for name in obstacles.lagging if frame.moved else ():
            self._log.warn(
                f"behind {name}",
                f"'{name}' lags behind its target: the speed of obstacles is limited to {obstacles.speed:g} m/s, "
                "so that they do not pass through the cloth",
            )
        for k in obstacles.unlinked_indices:
            load, output = frame.obstacle_wrenches[k], self._wrenches[obstacles.names[k]]
            if output.has_consumers:
                output.send(wrench_message(load, frame_id=self._simulation.scene.frame_id, stamp=stamp), stamp)

    def log_recovery(self, frame: Frame) -> None:
        """Log a reduced contact thickness if a frame's parameters, reset or opened gripper may have caused it.

        A warning if parameters were set or the cloth was reset, an information if a gripper opened.
        """
        if frame.recovery is None:
            return
        text = frame.recovery.describe()
        if any(isinstance(event, (SetParameters, Reset)) for event in frame.events):
            self._log.warn("contact recovery", f"the cloth is {text}")
        elif any(isinstance(event, Grasp) and not event.closed for event in frame.events):
            self._log.info("contact recovery", f"a gripper opened while it pressed the cloth {text}")

    def describe(self) -> dict[str, str]:
        """Return diagnostics entries: number of contacts, smallest gaps [m], stopped bodies; empty without contact."""
        gaps, contact, entries = self._simulation.gaps(), self._simulation.plan.contact, dict[str, str]()
        if gaps is not None and len(gaps):
            entries = {"contacts": str(int(gaps[:, 0].sum())), "smallest_gap_m": f"{gaps[:, 1].min():.6g}"}
            entries["stopped_bodies"] = ", ".join(sorted(self._stopped_names)) or "none"
        if contact is not None and contact.force.surface is not None:
            count, gap = contact.self_gaps(self._simulation.state.x)
            entries |= {"self_contacts": str(count), "self_smallest_gap_m": f"{gap:.6g}"}
        return entries

    def _warn_of_stops(self, frame: Frame) -> None:
        """Warn of obstacles and grippers that a frame stopped; once, even if commands stop them in each frame."""
        latest = self._last_stop_frames
        self._last_stop_frames = {
            name: index for name, index in latest.items() if frame.index - index <= self._n_repeat_frames
        }
        new = [name for name in frame.stopped if name not in self._last_stop_frames]
        self._last_stop_frames |= dict.fromkeys(frame.stopped, frame.index)
        if not new:
            return
        names = ", ".join(f"'{name}'" for name in new)
        words = ("is", "it", "it") if len(new) == 1 else ("are", "they", "them")
        self._log.warn(
            f"halted {names}",
            f"{names} {words[0]} stopped: {words[1]} would crush the cloth; send a new target to resume {words[2]}",
        )

    def _update_stopped(self, frame: Frame) -> None:
        """Update the stopped bodies: add those of the frame, drop those with a new command and removed ones."""
        commanded = {event.obstacle for event in frame.events if isinstance(event, Move)}
        commanded |= {event.gripper for event in frame.events if isinstance(event, Target)}
        if self._stopped_names:
            commanded.update(*(event.obstacles for event in frame.events if isinstance(event, MoveObstacles)))
        scene = self._simulation.scene
        known = {*scene.obstacle_names, *scene.gripper_names}
        if any(isinstance(event, Reset) for event in frame.events):
            known = set()
        self._stopped_names = ((self._stopped_names - commanded) & known) | set(frame.stopped)

    def update_topics(self, stamp: int) -> None:
        """Create and remove topics so that they match the present obstacles, and publish at a ROS time [ns]."""
        obstacles, scene = self._simulation.obstacles, self._simulation.scene
        names = [] if obstacles is None else [obstacles.names[k] for k in obstacles.unlinked_indices]
        solids, _ = self._solids()
        drawn = [solid.name for solid in solids]
        if not drawn and not self._drawn:
            return
        from cloth_sim_ros.ros.io.obstacle_markers import MarkerArray, ObstacleMarkers

        self._commands.subscribe_obstacles(names)
        for name in names:
            if name not in self._wrenches:
                self._wrenches[name] = Output(self._node, WrenchStamped, f"~/{name}/wrench", self._sink, droppable=True)
        for name in [name for name in self._wrenches if name not in names]:
            self._wrenches.pop(name).close()
        removed = [name for name in self._drawn if name not in drawn]
        self._markers = ObstacleMarkers(
            solids, frame_id=scene.frame_id, node=self._node.get_fully_qualified_name(), removed=removed
        )
        self._drawn = drawn
        if self._output is None:
            self._output = Output(self._node, MarkerArray, "~/obstacles", self._sink, qos=LATCHED_QOS)
        self._publish(stamp)

    def _solids(self) -> tuple[list[Obstacle], Array]:
        return solids_and_poses(self._simulation.obstacles, self._simulation.pinching)

    def _publish(self, stamp: int) -> None:
        assert self._markers is not None
        assert self._output is not None
        self._poses = self._solids()[1]
        # Without a check for subscribers: the topic is latched (transient local).
        self._published = self._markers.serialize(self._poses, stamp)
        self._output.send(self._published, stamp)
