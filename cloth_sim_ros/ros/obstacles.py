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

from cloth_sim_ros.ros.commands import Commands
from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.ros.messages import wrench_message
from cloth_sim_ros.ros.outputs import LATCHED, Output, Tape
from cloth_sim_ros.simulation.events import Move, Reset, SetParameters, Target
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.simulation.surroundings import solids_and_poses

if TYPE_CHECKING:
    from cloth_sim_ros.physics.forces.force import Array
    from cloth_sim_ros.physics.obstacles import Obstacle
    from cloth_sim_ros.ros.obstacle_markers import ObstacleMarkers

#: A stop within this simulated time after the previous one is the same stop [s].
_CALM = 1.0
#: Words for a stop of several bodies: verb, subject and object.
_SEVERAL = ("are", "they", "them")


class ObstacleTopics:
    """Topics of a cloth's obstacles.

    Args:
        node: the node.
        simulation: the cloth.
        commands: subscribes to their targets.
        sink: records the published messages.
        log: receives warnings of stops and lags.
    """

    def __init__(self, node: Node, simulation: Simulation, commands: Commands, tape: Tape, log: ThrottledLog) -> None:
        self._node, self._simulation, self._commands = node, simulation, commands
        self._tape, self._log = tape, log
        self._drawn: list[str] = []
        self._markers: ObstacleMarkers | None = None
        self._output: Output | None = None
        self._wrenches: dict[str, Output] = {}
        self._shown: bytes = b""
        self._poses = np.zeros((0, 7))
        #: Names of stopped bodies without a new command since.
        self._halted: set[str] = set()
        #: Frame of each body's last stop, and the number of frames after which another stop is reported.
        self._stopped: dict[str, int] = {}
        self._calm = round(_CALM * simulation.scene.rate)

    def start(self, stamp: int) -> None:
        """Publish the obstacles at a ROS time [ns], and subscribe to their targets."""
        self._follow(stamp)

    def record(self, stamp: int) -> None:
        """Record the markers at the start of a recording, at a ROS time [ns]."""
        if self._output is not None:
            self._output.record(self._shown, stamp)

    def send(self, frame: Frame, stamp: int) -> None:
        """Publish and record the markers and wrenches after a frame, at a ROS time [ns]."""
        self._follow_halted(frame)
        self._warn_of_stops(frame)
        obstacles = self._simulation.obstacles
        solids, poses = self._solids()
        if [solid.name for solid in solids] != self._drawn:
            self._follow(stamp)
            return
        if not np.array_equal(poses, self._poses):
            self._show(stamp)
        if obstacles is None:
            return
        for name in obstacles.behind:
            self._log.warn(
                f"behind {name}",
                f"'{name}' lags behind its target: the speed of obstacles is limited to {obstacles.speed:g} m/s, "
                "so that they do not pass through the cloth",
            )
        for name, load in zip(obstacles.names, frame.loads, strict=True):
            output = self._wrenches[name]
            if output.wanted:
                output.send(wrench_message(load, frame_id=self._simulation.scene.frame_id, stamp=stamp), stamp)

    def log_recovery(self, frame: Frame) -> None:
        """Log contacts to which the events of a frame gave a reduced thickness; a warning unless a gripper opened."""
        if frame.recovery is None:
            return
        text = frame.recovery.describe()
        if any(isinstance(event, (SetParameters, Reset)) for event in frame.events):
            self._log.warn("contact recovery", f"the cloth is {text}")
        else:
            self._log.info("contact recovery", f"a gripper opened while it pressed the cloth {text}")

    def describe(self) -> dict[str, str]:
        """Return the diagnostics entries of contact; empty without contact."""
        gaps, contact, said = self._simulation.gaps(), self._simulation.plan.contact, dict[str, str]()
        if gaps is not None and len(gaps):
            said = {"contacts": str(int(gaps[:, 0].sum())), "smallest_gap_m": f"{gaps[:, 1].min():.6g}"}
            said["halted"] = ", ".join(sorted(self._halted)) or "none"
        if contact is not None and contact.force.surface is not None:
            count, gap = contact.own_gaps(self._simulation.state.x)
            said |= {"self_contacts": str(count), "self_smallest_gap_m": f"{gap:.6g}"}
        return said

    def _warn_of_stops(self, frame: Frame) -> None:
        """Warn once of a stop, even if commands cause it again in each frame."""
        latest = self._stopped
        self._stopped = {name: index for name, index in latest.items() if frame.index - index <= self._calm}
        new = [name for name in frame.halted if name not in self._stopped]
        self._stopped |= dict.fromkeys(frame.halted, frame.index)
        if not new:
            return
        names = ", ".join(f"'{name}'" for name in new)
        words = ("is", "it", "it") if len(new) == 1 else _SEVERAL
        self._log.warn(
            f"halted {names}",
            f"{names} {words[0]} stopped: {words[1]} would crush the cloth; send a new target to resume {words[2]}",
        )

    def _follow_halted(self, frame: Frame) -> None:
        """Update the stopped bodies: add those of the frame, drop those with a new command and removed ones."""
        anew = {event.obstacle for event in frame.events if isinstance(event, Move)}
        anew |= {event.gripper for event in frame.events if isinstance(event, Target)}
        scene = self._simulation.scene
        known = {*scene.obstacle_names, *scene.gripper_names}
        if any(isinstance(event, Reset) for event in frame.events):
            known = set()
        self._halted = ((self._halted - anew) & known) | set(frame.halted)

    def _follow(self, stamp: int) -> None:
        """Create and remove topics so that they match the present obstacles."""
        obstacles, scene = self._simulation.obstacles, self._simulation.scene
        names = [] if obstacles is None else obstacles.names
        solids, _ = self._solids()
        drawn = [solid.name for solid in solids]
        if not drawn and not self._drawn:
            return
        from cloth_sim_ros.ros.obstacle_markers import MarkerArray, ObstacleMarkers

        self._commands.listen_to_obstacles(names)
        for name in names:
            if name not in self._wrenches:
                self._wrenches[name] = Output(self._node, WrenchStamped, f"~/{name}/wrench", self._tape, droppable=True)
        for name in [name for name in self._wrenches if name not in names]:
            self._wrenches.pop(name).close()
        gone = [name for name in self._drawn if name not in drawn]
        self._markers = ObstacleMarkers(
            solids,
            frame_id=scene.frame_id,
            node=self._node.get_fully_qualified_name(),
            gone=gone,
        )
        self._drawn = drawn
        if self._output is None:
            self._output = Output(self._node, MarkerArray, "~/obstacles", self._tape, qos=LATCHED)
        self._show(stamp)

    def _solids(self) -> tuple[list[Obstacle], Array]:
        return solids_and_poses(self._simulation.obstacles, self._simulation.pinching)

    def _show(self, stamp: int) -> None:
        assert self._markers is not None
        assert self._output is not None
        self._poses = self._solids()[1]
        # Without a check for subscribers: the topic is latched (transient local).
        self._shown = self._markers.serialized(self._poses, stamp)
        self._output.send(self._shown, stamp)
