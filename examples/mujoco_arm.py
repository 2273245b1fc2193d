# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An arm in MuJoCo lifts a towel and pushes it with its forearm; joints and wrist feel the towel.

Needs `pip install mujoco`. Start the towel first: `cloth_sim --ros-args --params-file config/mujoco_towel.yaml`.
"""

import mujoco
import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, WrenchStamped
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

data = mujoco.MjData(mujoco.MjModel.from_xml_path(__file__.replace(".py", ".xml")))
rclpy.init()
node = rclpy.create_node("mujoco")
clock, time, felt = node.create_publisher(Clock, "/clock", 10), Clock(), []
targets = {name: node.create_publisher(PoseStamped, f"/cloth_sim/{name}/target", 10) for name in ("hand", "forearm")}
wrenches = {name: WrenchStamped() for name in targets}
for name in targets:
    node.create_subscription(WrenchStamped, f"/cloth_sim/{name}/wrench", lambda w, n=name: wrenches.update({n: w}), 10)


def advance(joints):
    """Advance MuJoCo by 1/60 s with the forces of the frame before, then the cloth to the same time."""
    for name, message in wrenches.items():
        vectors = message.wrench.force, message.wrench.torque
        data.body(name).xfrc_applied[:] = [getattr(vector, axis) for vector in vectors for axis in "xyz"]
    data.ctrl[:] = joints
    mujoco.mj_step(data.model, data, nstep=4)
    for name, target in targets.items():
        (x, y, z), (w, i, j, k) = data.body(name).xipos, data.body(name).xquat
        pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))
        target.publish(PoseStamped(pose=pose))
    time.clock.sec, time.clock.nanosec = divmod(round(60 * data.time) * 10**9 // 60, 10**9)
    while any(message.header.stamp != time.clock for message in wrenches.values()):
        clock.publish(time)  # again if it was lost; the cloth takes each time once
        rclpy.spin_once(node, timeout_sec=0.1)
    felt.append([np.linalg.norm(data.sensor("wrist").data), np.linalg.norm(data.body("forearm").xfrc_applied[:3])])


def move(seconds, z, elbow):
    """Move the hand to (0, -0.2, z) [m], its elbow above (1) or below (-1); return mean forces of the last second."""
    middle, half = np.arctan2(-0.5, z - 0.3), np.arccos(np.hypot(0.5, z - 0.3) / 0.9)
    start, goal = data.ctrl.copy(), np.array([middle + elbow * half, -2 * elbow * half])
    for u in np.linspace(0.0, 1.0, 60 * seconds):
        advance(start + (3 - 2 * u) * u * u * (goal - start))
    return np.mean(felt[-60:], axis=0)


data.qpos[:] = data.ctrl[:] = -1.0221, -1.8584  # the hand is 0.1 m above the towel's corner
move(1, 0.0, 1)
tare = move(2, 0.0, 1)
close = node.create_client(SetBool, "/cloth_sim/hand/close").call_async(SetBool.Request(data=True))
while not close.done():
    advance(data.ctrl.copy())
for text, seconds, elbow in (("lifts", 2, 1), ("holds", 4, 1), ("turns", 3, -1), ("pushes", 3, -1)):
    print(f"{text}: wrist %.4f N, forearm %.4f N" % tuple(move(seconds, 0.65, elbow) - tare))
