# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages from the node to its ensemble process: frames of the cloth, and the state at which the ensemble starts."""

from __future__ import annotations

from typing import Any

import attrs

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.events import Event


@attrs.frozen(eq=False)
class EnsembleStart:
    """Scene and state of the cloth at which the ensemble's members start."""

    #: Parameters of the scene by full name, and content of its files by name.
    parameters: dict[str, Any]
    files: dict[str, bytes]
    state: State


@attrs.frozen(eq=False)
class EnsembleStep:
    """Frame of the cloth, by its index and events, that the ensemble's members compute too."""

    index: int
    #: ROS time at which it was due [ns].
    stamp: int
    events: tuple[Event, ...]
    #: The state before the frame if the members start with it; None if they go on.
    start: EnsembleStart | None
