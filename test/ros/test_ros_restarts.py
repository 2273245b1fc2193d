# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Node, gripper and subscribers killed, stalled and restarted during a grasp; no process waits for a dead one."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from std_srvs.srv import SetBool, Trigger
from support.ros_client import LIMIT, STARTED, Client, positions

SUBSCRIBER = Path(__file__).parents[1] / "support" / "plain_subscriber.py"
LIFTED = np.array([0.4, -0.4, 0.9])
STEPS = [
    {"time": 0.0, "position": [0.5, 0.0, 0.5]},
    {"time": 1.0, "position": [0.5, 0.0, 0.5], "close": True},
    {"time": 2.0, "position": LIFTED.tolist()},
    {"time": 600.0, "close": False},
]


class Actors:
    """The processes of a grasp, killed and restarted by name."""

    def __init__(self, start_process: Callable[..., Any], folder: Path) -> None:
        self._start = start_process
        self._folder = folder
        self._processes: dict[str, Any] = {}
        self.node_started = 0.0
        (folder / "script.yaml").write_text(yaml.safe_dump({"steps": STEPS}))

    def start(self, name: str, *, wait: bool = True) -> None:
        record = ["-p", "record.enabled:=true", "-p", f"record.folder:={self._folder / 'sessions'}"]
        arguments = {
            "node": ["-m", "cloth_sim_ros.ros.main", "--ros-args", "-p", "cloth.resolution:=[12, 12]", *record],
            "gripper": ["-m", "cloth_sim_ros.ros.gripper_main", self._folder / "script.yaml"],
            "subscriber": [sys.executable, SUBSCRIBER, "/cloth_sim/points", self._folder / "received"],
        }[name]
        if name == "node":
            self.node_started = time.time()
        self._processes[name] = self._start(arguments)
        if wait:
            self.wait_for_output(name, {"node": STARTED, "gripper": "waiting for", "subscriber": "ready"}[name])

    def signal(self, name: str, signum: int) -> None:
        self._processes[name].send_signal(signum)

    def kill(self, name: str) -> None:
        self._processes[name].kill()

    def interrupt(self, name: str) -> int:
        return int(self._processes[name].interrupt())

    def wait_for_output(self, name: str, text: str) -> None:
        self._processes[name].wait_for_output(text)

    def output(self, name: str) -> str:
        return str(self._processes[name].output)

    @property
    def received(self) -> int:
        """Number of bytes that the subscriber has written."""
        return (self._folder / "received").stat().st_size


def is_lifted(client: Client, since: float = 0.0) -> bool:
    """Return true if the newest cloud after ``since`` [s] has the corner lifted."""
    if not client.clouds:
        return False
    stamp = client.clouds[-1].header.stamp
    if stamp.sec + 1e-9 * stamp.nanosec < since:
        return False
    return bool(np.linalg.norm(positions(client.clouds[-1])[-1] - LIFTED) < 0.03)


@pytest.fixture
def grasp(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> Iterator[tuple[Actors, Client]]:
    actors = Actors(start_process, tmp_path)
    for name in ("subscriber", "node", "gripper"):
        actors.start(name)
    with Client() as client:
        client.watch()
        client.spin_until(lambda: is_lifted(client), description="the corner lifted", limit=2 * LIMIT)
        yield actors, client


def lifted_again(actors: Actors, client: Client) -> None:
    """A new gripper finds the cloth and lifts it."""
    # Clouds of a killed node may still be in transit.
    since = actors.node_started
    client.spin_until(lambda: is_lifted(client, since), description="the corner lifted again", limit=2 * LIMIT)
    before = actors.received
    client.spin_until(lambda: actors.received > before, description="the subscriber to receive on")


def test_the_node_dies_first_and_its_callers_go_on(grasp: tuple[Actors, Client], tmp_path: Path) -> None:
    actors, client = grasp
    # A pending service call of a dead node is never answered, and blocks no process.
    pending = client.node.create_client(SetBool, "/cloth_sim/gripper/close")
    client.spin_until(pending.service_is_ready, description="the service")
    actors.signal("node", signal.SIGSTOP)
    future = pending.call_async(SetBool.Request(data=False))
    actors.kill("node")
    assert not future.done()
    # The gripper goes on publishing without a cloth. A new cloth receives its targets, but is not grasped.
    actors.start("node")
    client.clouds.clear()
    client.wait_for_clouds(30)
    assert not is_lifted(client)
    assert "played" not in actors.output("gripper")
    # Its successor opens, closes and lifts.
    actors.kill("gripper")
    actors.start("gripper")
    lifted_again(actors, client)
    assert client.call(Trigger, "/cloth_sim/reset").success
    assert actors.interrupt("gripper") == 130
    assert actors.interrupt("node") == 0
    check_sessions(tmp_path / "sessions", 2)


def test_all_processes_die_and_return_in_reverse(grasp: tuple[Actors, Client], tmp_path: Path) -> None:
    actors, client = grasp
    for name in ("node", "gripper", "subscriber"):
        actors.signal(name, signal.SIGKILL)
    for name in ("node", "gripper", "subscriber"):
        actors.kill(name)
    for name in ("gripper", "subscriber"):
        actors.start(name)
    actors.start("node")
    lifted_again(actors, client)
    assert actors.interrupt("node") == 0
    check_sessions(tmp_path / "sessions", 2)


def test_stalled_processes_do_not_block_others(grasp: tuple[Actors, Client]) -> None:
    actors, client = grasp
    # A suspended reliable subscriber: the node goes on publishing, and the subscriber receives the newest cloud later.
    actors.signal("subscriber", signal.SIGSTOP)
    frames = len(client.clouds)
    client.wait_for_clouds(120)
    assert is_lifted(client)
    before = actors.received
    actors.signal("subscriber", signal.SIGCONT)
    client.spin_until(lambda: actors.received > before, description="the subscriber to receive on")
    # The node itself: frames are skipped, the grasp stays.
    actors.signal("node", signal.SIGSTOP)
    for _ in range(60):
        client.executor.spin_once(timeout_sec=0.02)
    actors.signal("node", signal.SIGCONT)
    client.wait_for_clouds(30)
    assert is_lifted(client)
    # The gripper: after a long silence its target is unchanged.
    actors.signal("gripper", signal.SIGSTOP)
    client.wait_for_clouds(60)
    actors.signal("gripper", signal.SIGCONT)
    client.wait_for_clouds(30)
    assert is_lifted(client)
    assert len(client.clouds) > frames
    assert actors.interrupt("node") == 0
    assert "Traceback" not in actors.output("node")


def test_delayed_gripper_closes_at_the_cloth(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    actors = Actors(start_process, tmp_path)
    actors.start("node")
    with Client() as client:
        client.watch()
        actors.start("gripper")
        # Its script closes in a second and moves away afterwards.
        actors.wait_for_output("gripper", "playing")
        actors.signal("gripper", signal.SIGSTOP)
        # Until well after the lift.
        client.wait_for_clouds(180)
        actors.signal("gripper", signal.SIGCONT)
        client.spin_until(lambda: is_lifted(client), description="the corner lifted")


def test_subscribers_come_and_go_amid_a_grasp(grasp: tuple[Actors, Client]) -> None:
    actors, client = grasp
    for _ in range(4):
        actors.kill("subscriber")
        actors.start("subscriber", wait=False)
        client.wait_for_clouds(20)
        assert is_lifted(client)
    check_clouds_resume(actors, client)
    # A node does not wait at its end for a dead subscriber that discovery still lists.
    actors.kill("subscriber")
    assert actors.interrupt("node") == 0
    assert "Traceback" not in actors.output("node")


def test_half_made_port_blocks_no_process(ros_domain: int, start_process: Callable[..., Any]) -> None:
    # The last port of the domain, which no test reaches.
    port = Path("/dev/shm") / f"fastrtps_port{7400 + 250 * ros_domain + 249}"
    port.write_bytes(b"")
    stuck = start_process([sys.executable, "-c", "pass"])
    stuck.kill()
    assert not port.exists()


def check_clouds_resume(actors: Actors, client: Client) -> None:
    """Check that a subscriber started now receives clouds.

    In Fast DDS a subscriber sometimes receives nothing if its predecessor was killed during discovery. See issues 5053
    and 5469 of eProsima/Fast-DDS; the client of this test receives all clouds meanwhile. The test restarts it, as a
    user would. It is killed, because it may hang in the middleware and ignore signals.
    """
    for _ in range(5):
        before, until = actors.received, time.monotonic() + 15.0
        while actors.received <= before and time.monotonic() < until:
            client.executor.spin_once(timeout_sec=0.02)
        if actors.received > before:
            return
        actors.kill("subscriber")
        actors.start("subscriber")
    pytest.fail("five subscribers, one after the other, received nothing")


def check_sessions(folder: Path, count: int) -> None:
    """Check that every file of a killed node is readable to its end and replays."""
    pytest.importorskip("mcap")
    from cloth_sim_ros.verify.run import verify

    paths = sorted(folder.glob("*.mcap"))
    assert len(paths) == count
    for path in paths:
        verdict = verify([path])
        assert verdict.same, verdict
        assert verdict.frames > 30
