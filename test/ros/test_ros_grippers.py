# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grippers over topics: targets at any rate and order, grasps of none, all, twice, by several."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from geometry_msgs.msg import PointStamped, WrenchStamped
from support.clocked_cloth import SECOND, ClockedCloth
from support.ros_client import Client

CORNER = np.array([0.5, 0.0, 0.5])


def off_corner(x: float, y: float, z: float) -> np.ndarray:
    """A position beside the lower right corner."""
    return np.add(CORNER, (x, y, z))


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.mark.parametrize("rate", [1, 10, 60, 250, 1000])
def test_targets_at_any_rate(client: Client, rate: int) -> None:
    def where(time: float) -> np.ndarray:
        return off_corner(-0.1 * np.sin(time), -0.1 * np.cos(time) + 0.1, 0.05 * time)

    seconds = 2 if rate < 10 else 1
    with ClockedCloth(client) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.tick()
        assert cloth.held("gripper") == [41]
        start = cloth.now
        stamps = iter([start + round(k * SECOND / rate) for k in range(seconds * rate)])
        coming, newest, places = next(stamps), CORNER, [cloth.position("gripper")]
        for _ in range(60 * seconds):
            # Sent in time for their frame: each up to a millisecond ahead.
            while coming is not None and coming <= cloth.now:
                newest = where((coming - start) / SECOND)
                cloth.target("gripper", newest, stamp=coming)
                coming = next(stamps, None)
            cloth.tick()
            # At any rate, the gripper is at the newest target in each frame.
            np.testing.assert_allclose(cloth.position("gripper"), newest, rtol=0.0, atol=1e-12)
            places.append(cloth.position("gripper"))
        assert cloth.refused == (0, 0)
        # 0.1 m/s at rates above 60 Hz: no frame moves it further; lower rates jump by the skipped distance.
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        assert steps.max() < 0.13 / min(rate, 60) * 1.2
        corner = cloth.simulation.positions[41]
        assert np.linalg.norm(corner - newest) < 0.02


def test_out_of_order_repeated_and_early_stamps(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick(2)
        now = cloth.now
        for stamp, x in (
            (now - 5_000_000, 0.1),
            (now - 1_000_000, 0.2),
            (now - 3_000_000, 0.3),
            (now - 1_000_000, 0.4),
        ):
            cloth.target("gripper", (x, 0.0, 0.0), stamp=stamp)
        cloth.tick()
        # An older target is dropped; of two with equal stamps the later one counts.
        assert cloth.position("gripper")[0] == 0.4
        assert cloth.refused == (0, 1)
        # A target ahead of time waits for its frame; older ones that arrive after it are still used.
        third = cloth.now + 2 * SECOND // 60
        cloth.target("gripper", (0.9, 0.0, 0.0), stamp=third)
        cloth.tick(2)
        assert cloth.position("gripper")[0] == 0.4
        cloth.tick()
        assert cloth.position("gripper")[0] == pytest.approx(0.9, abs=1e-12)
        assert cloth.refused == (0, 1)
        # More than a second ahead: refused; zero means now.
        cloth.target("gripper", (2.0, 0.0, 0.0), stamp=cloth.now + 2 * SECOND)
        assert cloth.refused == (1, 1)
        cloth.point("gripper", (0.7, 0.0, 0.0))
        cloth.tick()
        assert cloth.position("gripper")[0] == pytest.approx(0.7, abs=1e-12)


def test_invalid_stamps_change_nothing(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        for sec, nanosec in ((-5, 0), (cloth.now // SECOND, 4_000_000_000)):
            message = PointStamped()
            message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
            cloth.send("gripper/point", message)
        cloth.tick()
        assert cloth.refused == (2, 0)
        assert cloth.position("gripper").tolist() == CORNER.tolist()


def test_targets_and_points_of_a_gripper_share_stamp_order(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.tick()
        cloth.target("gripper", CORNER, stamp=cloth.now - 3, w=2.0)
        cloth.point("gripper", (0.0, 0.0, 1.0), stamp=cloth.now - 5)
        assert cloth.refused == (0, 1), "older than the pose before it"
        cloth.point("gripper", (0.1, 0.0, 1.0), stamp=cloth.now - 3)
        cloth.tick()
        assert cloth.position("gripper").tolist() == [0.1, 0.0, 1.0]


def test_grasp_in_same_frame_as_target_uses_previous_pose(client: Client) -> None:
    # The order of a frame: the newest target, then the grasps; the gripper moves to the target closed.
    with ClockedCloth(client) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        cloth.target("gripper", off_corner(0.0, -0.05, 0.02))
        cloth.grasp("gripper", True)
        cloth.tick()
        assert cloth.held("gripper") == [41]
        np.testing.assert_allclose(cloth.position("gripper"), off_corner(0.0, -0.05, 0.02), atol=1e-12)


def test_several_grippers_hold_the_same_particle(client: Client) -> None:
    with ClockedCloth(client, {"grippers": ["left", "right", "third"], "gravity": [0.0, 0.0, 0.0]}) as cloth:
        wrenches: dict[str, WrenchStamped] = {}
        for name in ("left", "right", "third"):
            client.node.create_subscription(
                WrenchStamped, f"/cloth_sim/{name}/wrench", lambda m, name=name: wrenches.__setitem__(name, m), 10
            )
            cloth.target(name, CORNER)
        cloth.tick()
        for name in ("left", "right", "third"):
            cloth.grasp(name, True)
        cloth.tick()
        assert [cloth.held(name) for name in ("left", "right", "third")] == [[41], [41], [41]]
        # Two pull apart, the third stays: the corner stays in the middle, and the two have opposite forces.
        for k in range(1, 31):
            for name, offset in (("left", -1.0), ("right", 1.0)):
                cloth.target(name, off_corner(0.0, offset * 0.1 * k / 30, 0.0))
            cloth.tick()
        cloth.tick(60)
        client.spin_until(lambda: len(wrenches) == 3, description="all wrenches")
        np.testing.assert_allclose(cloth.simulation.positions[41], CORNER, atol=2e-3)
        left, right = wrenches["left"].wrench.force.y, wrenches["right"].wrench.force.y
        assert left > 1.0
        assert left == pytest.approx(-right, rel=0.02)
        assert abs(wrenches["third"].wrench.force.y) < 0.05 * left
        # One releases: the corner moves towards the other, which still holds it.
        cloth.grasp("left", False)
        cloth.grasp("third", False)
        cloth.tick(60)
        assert cloth.held("left") == []
        assert cloth.held("right") == [41]
        assert np.linalg.norm(cloth.simulation.positions[41] - cloth.position("right")) < 0.02


def test_closing_on_no_and_all_particles_and_twice(client: Client) -> None:
    with ClockedCloth(client, {"gripper.radius": 5.0}) as cloth:
        cloth.target("gripper", (0.0, -100.0, 0.0))
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.tick()
        assert cloth.is_closed("gripper")
        assert cloth.held("gripper") == []
        # Closed on nothing, it stays empty; it grasps only after opening and closing again.
        cloth.target("gripper", (0.0, 0.0, 1.0))
        cloth.tick(2)
        cloth.grasp("gripper", True)
        cloth.tick()
        assert cloth.held("gripper") == []
        cloth.grasp("gripper", False)
        cloth.grasp("gripper", True)
        cloth.tick()
        everything = list(range(7, 42))
        assert cloth.held("gripper") == everything, "all but the anchored edge"
        before = cloth.simulation.positions
        cloth.target("gripper", (0.0, -0.2, 1.0))
        cloth.tick()
        # A second closing elsewhere changes nothing.
        cloth.grasp("gripper", True)
        cloth.tick(60)
        assert cloth.held("gripper") == everything
        moved = cloth.simulation.positions[14:] - before[14:]
        np.testing.assert_allclose(moved, np.broadcast_to((0.0, -0.2, 0.0), moved.shape), atol=0.03)
        cloth.grasp("gripper", False)
        cloth.grasp("gripper", False)
        cloth.tick()
        assert cloth.held("gripper") == []
        assert np.isfinite(cloth.simulation.positions).all()


def test_grasped_from_two_sides(client: Client) -> None:
    # A loose sheet between two grippers at opposite edges, pulled, swapped sides, pulled again.
    parameters = {
        "grippers": ["left", "right"], "cloth.anchors": [""], "gripper.radius": 0.6,
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0], "cloth.position": [0.0, 0.0, 0.0], "gravity": [0.0, 0.0, 0.0],
    }  # fmt: skip
    with ClockedCloth(client, parameters) as cloth:
        cloth.target("left", (-0.7, 0.0, 0.0))
        cloth.target("right", (0.7, 0.0, 0.0))
        cloth.tick()
        cloth.grasp("left", True)
        cloth.grasp("right", True)
        cloth.tick()
        left, right = cloth.held("left"), cloth.held("right")
        assert left
        assert sorted(p // 7 * 7 + 6 - p % 7 for p in left) == right, "the mirror image"
        middle = cloth.simulation.positions.mean(axis=0)
        for k in range(1, 61):
            cloth.target("left", (-0.7 - 0.05 * k / 60, 0.0, 0.0))
            cloth.target("right", (0.7 + 0.05 * k / 60, 0.0, 0.0))
            cloth.tick()
        cloth.tick(60)
        # Pulled equally from both sides, it is stretched and stays in place.
        np.testing.assert_allclose(cloth.simulation.positions.mean(axis=0), middle, atol=1e-6)
        assert np.ptp(cloth.simulation.positions[:, 0]) > 1.04
        # Through each other: the cloth stays finite, and no thread is longer than 1.5 times its length after release.
        for k in range(1, 61):
            cloth.target("left", (-0.75 + 1.5 * k / 60, 0.0, 0.0))
            cloth.target("right", (0.75 - 1.5 * k / 60, 0.0, 0.0))
            cloth.tick()
        assert np.isfinite(cloth.simulation.positions).all()
        cloth.grasp("left", False)
        cloth.grasp("right", False)
        cloth.tick(120)
        edges = np.linalg.norm(np.diff(cloth.simulation.positions.reshape(6, 7, 3), axis=1), axis=2)
        assert edges.max() < 1.5 / 6


def test_a_silent_gripper_keeps_its_last_target(client: Client) -> None:
    with ClockedCloth(client) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.target("gripper", off_corner(0.0, -0.3, 0.1))
        cloth.tick(600)
        assert cloth.held("gripper") == [41]
        np.testing.assert_allclose(cloth.position("gripper"), off_corner(0.0, -0.3, 0.1), atol=1e-12)


def test_gripper_timeout_releases_and_allows_new_grasp(client: Client) -> None:
    with ClockedCloth(client, {"gripper.timeout": 0.5}) as cloth:
        cloth.target("gripper", CORNER)
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.tick()
        # It holds while targets come within the timeout.
        for _ in range(5):
            cloth.target("gripper", CORNER)
            cloth.tick(24)
            assert cloth.held("gripper") == [41]
        cloth.target("gripper", CORNER)
        cloth.tick(30)
        assert cloth.held("gripper") == [41]
        cloth.tick(2)
        assert not cloth.is_closed("gripper")
        # Targets come again, and it grasps again.
        cloth.target("gripper", cloth.simulation.positions[41])
        cloth.tick()
        cloth.grasp("gripper", True)
        cloth.tick()
        assert cloth.held("gripper") == [41]
        # Refused targets do not reset the timeout.
        for _ in range(4):
            cloth.target("gripper", (np.nan, 0.0, 0.0))
            cloth.tick(10)
        assert not cloth.is_closed("gripper")
