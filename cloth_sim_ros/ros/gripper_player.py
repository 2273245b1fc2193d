# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plays scripted grasps to a running cloth, through its command topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from cloth_sim_ros.ros.gripper_hand import Hand
from cloth_sim_ros.simulation.gripper_script import GraspAt, GripperScript

#: Discovery is gradual: a gripper counts as unknown only if it has not appeared this long after other services of the
#: node [s].
_SETTLING = 1.0
#: Services that rclpy makes with the node itself, before it is ready.
_OF_RCLPY = "/get_type_description"
#: If a grasp is later than this, the scripts are set back to this long before it, so that the gripper closes at the
#: place that its script gives [s].
_HELD_UP = 0.1


#: The time from one target to the next is up to so many times that of a frame, or of a target.
_MORE = 1.5
#: A time that has not moved for this long stands [s].
_STANDING = 5.0
#: How long it may stand by default [s].
_LONGEST_STANDING = 30.0


class PlayedTime(Protocol):
    """The time in which scripts are played."""

    #: How far it goes on from one frame of the cloth to the next [ns]; 0 where it has none.
    period: int

    @property
    def send_time(self) -> float:
        """Steady time at which the next target is to be sent, at the earliest [s]."""

    def now(self) -> int | None:
        """Return the time [ns]; None if it is not known yet."""

    def describe(self) -> str:
        """Return what is known of a cloth whose time stands, as the end of a sentence."""


class NodeTime:
    """The ROS time of a client's own node."""

    period = 0
    send_time = 0.0

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()

    def now(self) -> int:
        """Return the time [ns]."""
        return int(self._clock.now().nanoseconds)

    def describe(self) -> str:
        """Return why it stands, as the end of a sentence."""
        return "is not heard: the clock of this node stands"


class GripperError(RuntimeError):
    """The script can't be played; the message says why."""


class GripperPlayer:
    """Plays scripts, one for each gripper, to a cloth's node; they begin together.

    Args:
        node: a node of the caller's.
        scripts: what to play.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
        proceed: asked again and again; False ends everything early.
        played: the time in which scripts are played; that of the caller's node where left out.
        on_standing: told, once each time, that the script waits because that time stands.
    """

    def __init__(
        self,
        node: Node,
        scripts: Sequence[GripperScript],
        *,
        target: str,
        proceed: Callable[[], bool] = lambda: True,
        played: PlayedTime | None = None,
        on_standing: Callable[[str], object] = lambda _: None,
    ) -> None:
        self._node = node
        self._target = "/" + target.strip("/")
        self._proceed = proceed
        self._played = played or NodeTime(node)
        self._on_standing = on_standing
        #: Of the time in which scripts are played [ns]: the scripts' start, delays included, and the newest.
        self._start = 0
        self._newest: int | None = None
        self._compensated: GraspAt | None = None
        #: The grippers, in the order of the scripts.
        self.hands = [Hand(node, script, self._target) for script in scripts]
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)

    def wait_for_grippers(self, limit: float) -> bool:
        """Wait until the cloth's node serves the grippers and open them; False if told to end.

        Args:
            limit: how long it waits at most [s].

        Raises:
            GripperError: if the node does not come, does not answer, or has no such gripper.
        """
        begun = time.monotonic()
        settling, known = begun, list[str]()
        while self._proceed():
            missing = [hand.script.gripper for hand in self.hands if not hand.is_met()]
            if not missing:
                return self._begin_open(begun + limit)
            now = time.monotonic()
            # A node that only has a name is still preparing, and its grippers come to be known one by one.
            served = self._is_served()
            before, known = known, self._known_grippers() if served else []
            settling = settling if known == before else now
            late = now - begun > limit
            if served and (late or (known and now - settling > _SETTLING)):
                for name in missing:
                    if name not in known:
                        there = ", ".join(known) or "none"
                        raise GripperError(f"{self._target} has no gripper '{name}'; it has {there}")
            if late:
                raise GripperError(self._what_is_missing(limit))
            self._executor.spin_once(timeout_sec=0.02)
        return False

    def _begin_open(self, end: float) -> bool:
        """Open the grippers, once, and wait until the node says that they are open.

        Raises:
            GripperError: if no answer comes until `end`.
        """
        for hand in self.hands:
            hand.open()
        while self._proceed():
            self._executor.spin_once(timeout_sec=0.1)
            closed = [hand.script.gripper for hand in self.hands if not hand.is_open()]
            if not closed:
                return True
            if time.monotonic() > end:
                raise GripperError(
                    f"{self._target} serves the gripper '{closed[0]}', but does not say that it is open; "
                    "does /clock stand still? What does its log say?"
                )
        return False

    def play(self, *, standing: float = _LONGEST_STANDING) -> bool:
        """Play the scripts from beginning to end, in the time of the cloth; False if told to end early.

        A script does not leave the place of a closing before it is known what the gripper holds. If that is late, or
        if this process was held up over a grasp, all scripts are delayed by as much. A gripper would otherwise close
        where the cloth no longer is. Nothing is sent while the time stands.

        Args:
            standing: how long the time may stand [s].

        Raises:
            GripperError: if it stands for longer, or goes back.
        """
        period = 1.0 / max(hand.script.rate for hand in self.hands)
        due = moved = time.monotonic()
        waits = False
        while self._proceed():
            now = self._newest_time()
            if now is not None and now != self._newest:
                now = self._wait_to_send(now)
                if self._go_on(now, time.monotonic() - moved, period):
                    return True
                moved, waits = time.monotonic(), False
            elif (stood := time.monotonic() - moved) > standing:
                raise GripperError(
                    f"{self._target} {self._played.describe()} for {stood:.0f} s: the script ends (--wait gives it "
                    "longer); is it paused or stopped? What does its log say?"
                )
            elif stood > _STANDING and not waits:
                waits = True
                self._on_standing(f"{self._target} {self._played.describe()}: the script waits")
            # By the steady clock, without drift; times that have passed are left out.
            due = max(due + period, time.monotonic() - period)
            while (left := due - time.monotonic()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
            if self._played.period and self._played.now() == self._newest:
                # The target of the next frame is sent as soon as that is known.
                self._executor.spin_once(timeout_sec=period)
        return False

    def _wait_to_send(self, now: int) -> int:
        """Wait until the target of a time [ns] is to be sent, or a newer time comes; return the newest."""
        while (left := self._played.send_time - time.monotonic()) > 0.0 and self._played.now() == now:
            self._executor.spin_once(timeout_sec=left)
        return self._played.now() or now

    def _newest_time(self) -> int | None:
        """Return the time [ns] after all messages that have arrived.

        An executor hands over one message of a topic at a time: a client that was held up would send several targets
        for one frame.
        """
        now = self._played.now()
        while self._played.period:
            self._executor.spin_once(timeout_sec=0.0)
            before, now = now, self._played.now()
            if now == before:
                break
        return now

    def _go_on(self, now: int, elapsed: float, period: float) -> bool:
        """Send what is due at a time [ns]; return whether the scripts have ended.

        Args:
            now: the time in which the scripts are played [ns].
            elapsed: the wall's time since targets were sent [s].
            period: time between two targets [s].

        Raises:
            GripperError: if the time went back.
        """
        if self._newest is None:
            self._start = self._newest = now
        if now < self._newest:
            raise GripperError(f"the time of {self._target} went back: it was restarted; play the script again")
        played, seconds = (now - self._start) * 1e-9, now * 1e-9
        late = self._held_up((now - self._newest) * 1e-9, elapsed, period)
        late = max(late, played - min(hand.stay(played, seconds) for hand in self.hands))
        first = min((grasp for hand in self.hands for grasp in hand.waiting[:1]), key=_time_of, default=None)
        if first is not None and played - late > first.time + _HELD_UP and first is not self._compensated:
            # Once for each: the steps of a simulated clock may be longer.
            self._compensated = first
            late = played - max(first.time - _HELD_UP, 0.0)
        self._newest = now
        self._start += int(late * 1e9)
        played -= late
        for hand in self.hands:
            hand.command(played, seconds)
        if not all(hand.has_played(played, seconds) for hand in self.hands):
            return False
        for hand in self.hands:
            hand.finish()
        return True

    def _held_up(self, played: float, elapsed: float, period: float) -> float:
        """Return by how much the scripts are to be delayed because frames have passed without a target [s].

        A gripper that made up for them would be twice as fast for a frame. A cloth that is faster than real time has
        several frames from one target to the next, and is followed as it is.

        Args:
            played: how far the time of the scripts went on since the last target [s].
            elapsed: the wall's time since then [s].
            period: time between two targets [s].
        """
        step = max(self._played.period * 1e-9, period)
        if not self._played.period or played <= _MORE * step or elapsed < played / _MORE:
            return 0.0
        return played - step

    def _node_names(self) -> set[str]:
        return {f"{namespace.rstrip('/')}/{name}" for name, namespace in self._node.get_node_names_and_namespaces()}

    def _is_served(self) -> bool:
        """Whether the node is there and ready: it serves more than what rclpy makes with the node itself.

        By the services' names: asked for by the node's name, the graph answers for one node of that name, and one that
        was killed stays in it for some seconds beside the one that took its place.
        """
        of_node = (name for name, _ in self._node.get_service_names_and_types() if name.startswith(f"{self._target}/"))
        return any(not name.endswith(_OF_RCLPY) and self._node.count_services(name) for name in of_node)

    def _what_is_missing(self, limit: float) -> str:
        if self._target in self._node_names():
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


def _time_of(grasp: GraspAt) -> float:
    return grasp.time
