# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old addresses of modules: each has the public names of the new one."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

MIGRATION = Path(__file__).resolve().parent.parent / "docs" / "migration.md"
ADDRESSES = re.findall(
    r"^\| `(cloth_sim_ros\.batch[\w.]*)` \| `([\w.]+)` \|$", MIGRATION.read_text(encoding="utf-8"), re.M
)


def test_migration_page_lists_each_old_address() -> None:
    folder = Path(importlib.import_module("cloth_sim_ros.batch").__path__[0])
    modules = {f"cloth_sim_ros.batch.{path.stem}".removesuffix(".__init__") for path in folder.glob("*.py")}
    assert {old for old, _ in ADDRESSES} == modules


@pytest.mark.parametrize(("old", "new"), ADDRESSES)
def test_old_address_gives_the_new_names(old: str, new: str) -> None:
    pytest.importorskip("gymnasium")
    moved = importlib.import_module(new)
    names = ["main"] if new.endswith(".main") else getattr(moved, "__all__", None) or vars(moved)
    for name in names:
        if not name.startswith("_"):
            assert getattr(importlib.import_module(old), name) is getattr(moved, name)
