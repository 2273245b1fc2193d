# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Base class of objects that can't be copied because they use the engine's memory."""

from __future__ import annotations

from typing import Any, ClassVar, NoReturn


class Uncopyable:
    """Base class of objects that `copy` and `pickle` refuse (TypeError), because they use memory of the engine."""

    #: Cause and remedy in the error.
    copy_refusal: ClassVar[str] = (
        "this object works in memory of the engine, and can't be copied or pickled; compile its model once more"
    )

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise TypeError(self.copy_refusal)
