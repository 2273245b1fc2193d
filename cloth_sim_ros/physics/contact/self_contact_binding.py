# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of self-contact and of friction between layers."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.engine.binding import address, check, float64_address, library
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY


def upload_surface(handle: int, contact: Contact) -> None:
    """Upload the surface of self-contact, its joints and the friction between its layers to a plan; none without it."""
    surface = contact.surface
    if surface is None:
        return
    triangles = surface.triangles
    check(library().cloth_plan_self(handle, len(triangles), triangles.ctypes.data, surface.search_length))
    if surface.joined is not None:
        check(library().cloth_self_joints(handle, surface.joined.ctypes.data))
    if contact.has_self_friction:
        check(library().cloth_self_friction(handle, *surface.friction))


def check_anchors(contact: Contact, anchors: Array) -> None:
    """Raise ValueError if a friction anchor between layers is in a triangle that the cloth does not have.

    Args:
        contact: the force.
        anchors: anchors of obstacles, then of layers, shape `ContactBinding.anchors_shape`.

    Raises:
        ValueError: naming the side of the cloth and the triangle.
    """
    if contact.surface is None or not contact.has_self_friction:
        return
    count = len(contact.surface.triangles)
    for side_index, rows in enumerate(anchors[len(contact.obstacles) :]):
        indices = rows[0][rows[3] > 0.0]
        bad = indices[(indices < 0.0) | (indices >= count) | (indices != np.floor(indices))]
        if len(bad):
            raise ValueError(
                f"memory '{ANCHORS_KEY}' has an anchor of side {side_index} of the cloth in triangle {bad[0]}; it must "
                f"be a whole number from 0 to {count - 1}: the state is of another cloth"
            )


def friction_power(handle: int, t: float, x: Array, v: Array) -> float:
    """Return the power [W] that friction between layers dissipates at time t [s], with the uploaded anchors."""
    out = np.empty(1)
    addresses = float64_address("x", x, x.shape), float64_address("v", v, v.shape), address(out)
    check(library().cloth_self_friction_power(handle, t, *addresses))
    return float(out[0])
