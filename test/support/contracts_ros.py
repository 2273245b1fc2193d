# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contracts of the node: topics, services, quality of service, diagnostics and what it records. Needs ROS."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter

from cloth_sim_ros.replay import plots
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.verify import diagnostics as verify_diagnostics
from support.clocked_cloth import ClockedCloth
from support.contracts_files import contents
from support.ros_client import Client

#: Services that rclpy alone decides about.
_OF_RCLPY = ("/get_type_description",)
_MAX_FRAMES = 100_000


def graph() -> dict[str, Any]:
    """Return topics, services and quality of service of a default node."""
    with Client() as client, ClockedCloth(client) as cloth:
        cloth.tick()
        node = cloth.node.node
        node_name = (node.get_name(), node.get_namespace())
        topics = {
            "publishes": {end.topic_name: [_type_name(end.msg_type), _qos(end.qos_profile)] for end in node.publishers},
            "subscribes": {
                end.topic_name: [_type_name(end.msg_type), _qos(end.qos_profile)] for end in node.subscriptions
            },
        }
        services = {
            name: types
            for name, types in node.get_service_names_and_types_by_node(*node_name)
            if not name.endswith(_OF_RCLPY)
        }
        keys = list(cloth.node.reporting.collector(True)[2])
    return {"topics": topics, "services": services, "diagnostics": keys}


def live_session() -> dict[str, Any]:
    """Return what a node with all its options records, and its diagnostics."""
    folder = Path(tempfile.mkdtemp())
    parameters = {
        "rate": 10.0,
        "cloth.size": [0.2, 0.2],
        "cloth.resolution": [4, 4],
        "cloth.position": [0.0, 0.0, 0.004],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.anchors": [""],
        "obstacles": ["table"],
        "table.shape": "plane",
        "grippers": ["gripper", "pads"],
        "pads.mode": "pinch",
        "contact.self": True,
        "contact.friction": [0.3],
        "points.velocity": True,
        "diagnostics.energy": True,
        "diagnostics.accuracy": True,
        "record.enabled": True,
        "record.folder": str(folder),
        "record.least_free_space": 0,
    }
    keys: set[str] = set()
    with Client() as client, ClockedCloth(client, parameters) as cloth:
        cloth.tick()
        cloth.target("gripper", (0.1, 0.1, 0.0))
        cloth.point("gripper", (0.1, 0.1, 0.01))
        cloth.grasp("gripper", True)
        cloth.tick(2)
        cloth.node.node.set_parameters_atomically([Parameter("contact.thickness", value=0.006)])
        while "accuracy_verdict" not in keys:
            assert cloth.simulation.frame < _MAX_FRAMES, "the accuracy of no window was reported"
            cloth.tick(2)
            keys |= set(cloth.node.reporting.collector(True)[2])
        # /clock goes far ahead, then back: a frame's record tells either.
        for jump in (1000, -2000):
            cloth.tick_index += jump
            cloth.tick()
        cloth.node.close(timeout=10.0)
    (path,) = folder.glob("*.mcap")
    session = contents(path)
    session["keys of statuses"]["/diagnostics"] = sorted(keys)
    return {"recorded": session, "plots": _plots(sorted(keys)), "verified": _verified()}


def _type_name(kind: Any) -> str:
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def _qos(profile: Any) -> str:
    return (
        f"{profile.reliability.name.lower()}, {profile.durability.name.lower()}, {profile.history.name.lower()} "
        f"{profile.depth}"
    )


def _plots(keys: list[str]) -> dict[str, Any]:
    """Return the plot of each key of the diagnostics, as replay reads them."""
    # private: paths are a contract
    paths = {key: plots._plot_path(old_keys.DIAGNOSTICS.get(key, key)) for key in keys}
    return {
        "paths": sorted(plots.PLOTS),
        "of keys": {key: path for key, path in paths.items() if path is not None},
    }


def _verified() -> list[str]:
    """Return the keys of the diagnostics that `cloth_verify` has words on beside those that it computes."""
    # private: keys are a contract
    return sorted({*verify_diagnostics._SUMS, *verify_diagnostics._TEXTS, *verify_diagnostics._EXACT})
