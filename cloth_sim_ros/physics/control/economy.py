# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a run saves on."""

from __future__ import annotations

from typing import NamedTuple


class Economy(NamedTuple):
    """What a run of the leapfrog saves on."""

    #: Single precision inside.
    narrow: bool = False
    #: Weak springs at every second step only; the number of steps is odd.
    alternate: bool = False

    @property
    def words(self) -> str:
        """What it saves on, to be added to a sentence."""
        weak = "; weak springs at every second step" if self.alternate else ""
        return weak + ("; in single precision" if self.narrow else "")


#: A run that saves on nothing.
THOROUGH = Economy()
