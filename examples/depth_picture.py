# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS node that takes one depth image of the camera `front`, prints what it shows, and saves it as a picture.

Start the cloth first (`cloth_sim --ros-args --params-file config/camera.yaml`), then this.
"""

import json
import sys
import time

import numpy as np
import rclpy
from matplotlib.image import imsave
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_msgs.msg import String

CAMERA = "/cloth_sim/front"


def main(path: str) -> None:
    """Wait for a depth image and a label image of one stamp."""
    rclpy.init()
    node = rclpy.create_node("perception")
    depths, labels, names = {}, {}, []

    def keep(images: dict) -> object:
        return lambda image: images.update({(image.header.stamp.sec, image.header.stamp.nanosec): image})

    node.create_subscription(Image, f"{CAMERA}/depth/image_rect_raw", keep(depths), qos_profile_sensor_data)
    node.create_subscription(Image, f"{CAMERA}/labels", keep(labels), qos_profile_sensor_data)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(String, f"{CAMERA}/label_names", names.append, latched)
    end = time.monotonic() + 60.0
    while not (names and depths.keys() & labels.keys()):
        if time.monotonic() > end:
            raise SystemExit(f"no images of {CAMERA} within 60 s; does cloth_sim run?")
        rclpy.spin_once(node, timeout_sec=0.1)

    stamp = max(depths.keys() & labels.keys())
    image = depths[stamp]
    depth = np.frombuffer(image.data, np.float32).reshape(image.height, image.width)
    label = np.frombuffer(labels[stamp].data, np.uint16).reshape(depth.shape)
    print(f"{image.width} x {image.height} pixels in the frame {image.header.frame_id}")
    for key, name in json.loads(names[-1].data).items():
        seen = depth[label == int(key)]
        print(f"{name}: {seen.min():.2f} to {seen.max():.2f} m")
    imsave(path, depth, cmap="viridis_r", vmin=1.0, vmax=3.5)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "depth.png")
