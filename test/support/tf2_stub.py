# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A stand-in for tf2_ros, whose transforms a test sets."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import pytest


def stub_tf2(monkeypatch: pytest.MonkeyPatch, x_of: dict[str, float]) -> list[Any]:
    """Replace tf2_ros: each frame is displaced along x, and frames that are not in `x_of` are missing.

    Returns:
        The buffers that listen to /tf.
    """
    listening: list[Any] = []

    class TransformException(Exception):
        pass

    class Buffer:
        def lookup_transform(self, _target: str, source: str, _time: Any) -> Any:
            if source not in x_of:
                raise TransformException(f"'{source}' does not exist")
            return SimpleNamespace(
                header=SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=0)),
                transform=SimpleNamespace(
                    translation=SimpleNamespace(x=x_of[source], y=0.0, z=0.0),
                    rotation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0),
                ),
            )

        def __init__(self) -> None:
            self.n_cleared = 0

        def clear(self) -> None:
            self.n_cleared += 1

    module = SimpleNamespace(
        Buffer=Buffer,
        TransformException=TransformException,
        TransformListener=lambda buffer, _node: listening.append(buffer),
    )
    monkeypatch.setitem(sys.modules, "tf2_ros", module)
    return listening
