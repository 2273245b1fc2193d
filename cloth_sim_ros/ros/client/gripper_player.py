# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Player of scripted grasps through the command topics of a cloth."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from cloth_sim_ros.ros.client.gripper_client import GripperClient
from cloth_sim_ros.ros.timing.cloth_clock import ClothTime
from cloth_sim_ros.simulation.gripper_script import GripperScript, TimedGrasp

#: Discovery is gradual. A gripper counts as unknown if it appears this much later than other topics of the node [s].
_SETTLE_TIME = 1.0
#: Service that rclpy creates with the node itself, before the node is ready.
_RCLPY_SERVICE = "/get_type_description"
#: If a grasp is later than this, the scripts are set back to this long before it, so that the gripper closes at its
#: scripted position [s].
_REWIND = 0.1
#: Largest regular interval between targets, as a ratio to the period of a frame or of targets.
_MAX_INTERVAL_RATIO = 1.5
#: The script's time stands if it has not changed for this long [s].
_STANDING_TIMEOUT = 5.0
#: Longest time that it may stand by default [s].
_MAX_STANDING = 30.0


class NodeTime:
    """ROS time of the client's node as the time of scripts, if no `ClothTime` is given."""

    period = 0
    send_time = 0.0

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()

    def now(self) -> int:
        """Return the ROS time [ns]."""
        return int(self._clock.now().nanoseconds)

    def describe(self) -> str:
        """Return why the client's ROS time stands, as the end of a sentence."""
        return "is not heard: the clock of this node stands"


class GripperError(RuntimeError):
    """Error: the script can't be played; the message says why."""


class GripperPlayer:
    """Player of scripts, one for each gripper, to a cloth's node; they start together.

    Args:
        node: the caller's node.
        scripts: the scripts.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
        should_continue: polled; false ends the player early.
        script_time: the time in which scripts are played; by default that of the caller's node.
        on_standing: called with a message each time that the script begins to wait because that time stands.
    """

    def __init__(
        self,
        node: Node,
        scripts: Sequence[GripperScript],
        *,
        target: str,
        should_continue: Callable[[], bool] = lambda: True,
        script_time: ClothTime | None = None,
        on_standing: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._node = node
        self._target = "/" + target.strip("/")
        self._should_continue = should_continue
        self._script_time: ClothTime | NodeTime = script_time or NodeTime(node)
        self._on_standing = on_standing
        #: Start of the scripts, with delays, and newest time, both in the script time [ns].
        self._start = 0
        self._newest: int | None = None
        self._rewound: TimedGrasp | None = None
        #: The grippers, in the order of the scripts.
        self.grippers = [GripperClient(node, script, self._target) for script in scripts]
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)

    def wait_for_grippers(self, limit: float) -> bool:
        """Wait for the node to serve the grippers, and open them; GripperError if late, false if interrupted.

        Args:
            limit: longest wait [s].

        Raises:
            GripperError: if the node does not appear, does not answer, or has no such gripper.
        """
        start = time.monotonic()
        last_change, known = start, list[str]()
        while self._should_continue():
            missing = [hand.script.gripper for hand in self.grippers if not hand.is_connected()]
            if not missing:
                return self._open_all(start + limit)
            now = time.monotonic()
            # A node without services is still starting, and its grippers are discovered one by one.
            served = self._is_served()
            before, known = known, self._known_grippers() if served else []
            last_change = last_change if known == before else now
            is_late = now - start > limit
            if served and (is_late or (known and now - last_change > _SETTLE_TIME)):
                for name in missing:
                    if name not in known:
                        listed = ", ".join(known) or "none"
                        raise GripperError(f"{self._target} has no gripper '{name}'; it has {listed}")
            if is_late:
                raise GripperError(self._describe_missing(limit))
            self._executor.spin_once(timeout_sec=0.02)
        return False

    def _open_all(self, end: float) -> bool:
        """Open the grippers, and wait until the node says so; GripperError if late, false if interrupted.

        Raises:
            GripperError: if no answer comes before the steady time `end` [s].
        """
        for hand in self.grippers:
            hand.open()
        while self._should_continue():
            self._executor.spin_once(timeout_sec=0.1)
            closed = [hand.script.gripper for hand in self.grippers if not hand.is_open()]
            if not closed:
                return True
            if time.monotonic() > end:
                raise GripperError(
                    f"{self._target} serves the gripper '{closed[0]}', but does not say that it is open; "
                    "does /clock stand still? What does its log say?"
                )
        return False

    def play(self, *, standing: float = _MAX_STANDING) -> bool:
        """Play the scripts in the time of the cloth; GripperError if that stands, false if `should_continue` ends it.

        A gripper stays at the position of a closing until the result is known. If the result is late, or if this
        process was suspended during a grasp, all scripts are delayed by as much. Otherwise a gripper would close beside
        the cloth. Nothing is sent while the time stands.

        Args:
            standing: longest time that the script time may stand [s].

        Raises:
            GripperError: if the script time stands for longer, or goes back.
        """
        period = 1.0 / max(hand.script.rate for hand in self.grippers)
        wake_time = last_change = time.monotonic()
        is_waiting = False
        while self._should_continue():
            now = self._newest_time()
            if now is not None and now != self._newest:
                now = self._wait_to_send(now)
                if self._advance(now, time.monotonic() - last_change, period):
                    return True
                last_change, is_waiting = time.monotonic(), False
            elif (standing_time := time.monotonic() - last_change) > standing:
                raise GripperError(
                    f"{self._target} {self._script_time.describe()} for {standing_time:.0f} s: the script ends (--wait "
                    "gives it longer); is it paused or stopped? What does its log say?"
                )
            elif standing_time > _STANDING_TIMEOUT and not is_waiting:
                is_waiting = True
                self._on_standing(f"{self._target} {self._script_time.describe()}: the script waits")
            # By the steady clock, without drift; missed times are skipped.
            wake_time = max(wake_time + period, time.monotonic() - period)
            while (remaining := wake_time - time.monotonic()) > 0.0:
                self._executor.spin_once(timeout_sec=remaining)
            if self._script_time.period and self._script_time.now() == self._newest:
                # The target of the next frame is sent as soon as its time is known.
                self._executor.spin_once(timeout_sec=period)
        return False

    def _wait_to_send(self, now: int) -> int:
        """Wait until the target for a script time [ns] is to be sent, or a newer time comes; return the newest [ns]."""
        while (remaining := self._script_time.send_time - time.monotonic()) > 0.0 and self._script_time.now() == now:
            self._executor.spin_once(timeout_sec=remaining)
        return self._script_time.now() or now

    def _newest_time(self) -> int | None:
        """Take all arrived messages; return the newest script time [ns], or None before the first.

        A spin delivers one message of a topic. Without this loop a client that was suspended would send several targets
        for one frame.
        """
        now = self._script_time.now()
        while self._script_time.period:
            self._executor.spin_once(timeout_sec=0.0)
            before, now = now, self._script_time.now()
            if now == before:
                break
        return now

    def _advance(self, now: int, elapsed: float, period: float) -> bool:
        """Send the commands due, set the scripts back after missed time; return true if they have ended.

        Args:
            now: script time [ns].
            elapsed: wall time since the last targets [s].
            period: time between two targets [s].

        Raises:
            GripperError: if the script time went back.
        """
        if self._newest is None:
            self._start = self._newest = now
        if now < self._newest:
            raise GripperError(f"the time of {self._target} went back: it was restarted; play the script again")
        played, seconds = (now - self._start) * 1e-9, now * 1e-9
        delay = self._missed_time((now - self._newest) * 1e-9, elapsed, period)
        delay = max(delay, played - min(hand.limit_time(played, seconds) for hand in self.grippers))
        next_grasps = [hand.pending[0] for hand in self.grippers if hand.pending]
        first = min(next_grasps, key=lambda grasp: grasp.time, default=None)
        if first is not None and played - delay > first.time + _REWIND and first is not self._rewound:
            # Once for each grasp: a simulated clock may advance by larger steps.
            self._rewound = first
            delay = played - max(first.time - _REWIND, 0.0)
        self._newest = now
        self._start += int(delay * 1e9)
        played -= delay
        for hand in self.grippers:
            hand.send_commands(played, seconds)
        if not all(hand.has_played(played, seconds) for hand in self.grippers):
            return False
        for hand in self.grippers:
            hand.finish()
        return True

    def _missed_time(self, played: float, elapsed: float, period: float) -> float:
        """Return the time by which scripts are set back because frames have passed without a target [s].

        A gripper that caught up would be twice as fast for a frame. A cloth faster than real time has several frames
        between two targets; this causes no delay.

        Args:
            played: increment of the script time since the last target [s].
            elapsed: wall time since then [s].
            period: time between two targets [s].
        """
        step = max(self._script_time.period * 1e-9, period)
        if (
            not self._script_time.period
            or played <= _MAX_INTERVAL_RATIO * step
            or elapsed < played / _MAX_INTERVAL_RATIO
        ):
            return 0.0
        return played - step

    def _is_served(self) -> bool:
        """Return true if the cloth's node is ready: it serves more than the services that rclpy creates with it.

        The check uses the names of services, not that of the node. A killed node stays in the graph for some seconds,
        and a query by node name may return it instead of its successor.
        """
        of_node = (name for name, _ in self._node.get_service_names_and_types() if name.startswith(f"{self._target}/"))
        return any(not name.endswith(_RCLPY_SERVICE) and self._node.count_services(name) for name in of_node)

    def _describe_missing(self, limit: float) -> str:
        nodes = self._node.get_node_names_and_namespaces()
        if self._target in {f"{namespace.rstrip('/')}/{name}" for name, namespace in nodes}:
            return (
                f"{self._target} is there, but was not ready within {limit:g} s; what does its log say? "
                "--wait gives it longer"
            )
        return f"no node {self._target} came within {limit:g} s; is it running, in this ROS_DOMAIN_ID?"

    def _known_grippers(self) -> list[str]:
        prefix, suffix = f"{self._target}/", "/grasp"
        return sorted(
            topic[len(prefix) : -len(suffix)]
            for topic, _ in self._node.get_topic_names_and_types()
            if topic.startswith(prefix) and topic.endswith(suffix) and self._node.count_subscribers(topic)
        )
