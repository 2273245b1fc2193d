# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of a recorded session, those that came after it included."""

from __future__ import annotations

from typing import Any

from cloth_sim_ros.scene import parameter_file

#: Parameters that earlier versions did not have, with the value that does what they did. A session's scene.yaml sets
#: every parameter of the version that recorded it.
EARLIER = {"gripper.max_speed": 0.0}


def parameters_of(scene_yaml: str, *, node: str) -> dict[str, Any]:
    """Return the parameters with which a session's cloth moved, by full name.

    Args:
        scene_yaml: content of the session's attachment ``scene.yaml``.
        node: full name of the node that recorded it.

    Raises:
        ParameterError: for a text that is no parameter file.
    """
    return {**EARLIER, **parameter_file.parse(scene_yaml, node=node, source="scene.yaml")}
