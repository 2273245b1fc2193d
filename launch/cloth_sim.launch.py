# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One cloth: `ros2 launch cloth_sim_ros cloth_sim.launch.py params_file:=... namespace:=... name:=...`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """The node `cloth_sim` with a parameter file, in a namespace and under a name of the caller's choice."""
    default_parameters = PathJoinSubstitution([FindPackageShare("cloth_sim_ros"), "config", "cloth_sim.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file", default_value=default_parameters, description="ROS parameter file of the cloth"
            ),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("name", default_value="cloth_sim", description="name of the node"),
            Node(
                package="cloth_sim_ros",
                executable="cloth_sim",
                name=LaunchConfiguration("name"),
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params_file")],
                output="screen",
                emulate_tty=True,
                # The node closes its recording within two seconds of a signal; leave it the time.
                sigterm_timeout="10",
                sigkill_timeout="10",
            ),
        ]
    )
