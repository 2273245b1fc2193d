# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A plain subscriber with rclpy and sensor_msgs only: `plain_subscriber.py topic file`.

It appends each message to the file: its length (8 bytes, little endian), then its bytes. SIGINT ends it at once,
because the shutdown of the middleware may hang on a busy machine and is not tested here.
"""

import os
import signal
import sys

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2


def main() -> None:
    topic, path = sys.argv[1:]
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("plain_subscriber")
    ended: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _frame: ended.append(number))
    with open(path, "wb", buffering=0) as file:

        def receive(data: bytes) -> None:
            message = deserialize_message(data, PointCloud2)
            assert message.height * message.row_step == len(message.data)
            if not file.tell():
                print("receives", flush=True)
            file.write(len(data).to_bytes(8, "little") + data)

        node.create_subscription(PointCloud2, topic, receive, QoSProfile(depth=1000), raw=True)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        print("ready", flush=True)
        while not ended:
            executor.spin_once(timeout_sec=0.1)
    os._exit(0)


if __name__ == "__main__":
    main()
