# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old keys of statuses and JSON files beside the current ones."""

from __future__ import annotations

import pytest

from cloth_sim_ros.session import old_keys

TABLES = {name: table for name, table in vars(old_keys).items() if name.isupper()}
CURRENT = {"a": "alpha", "b": "beta"}


@pytest.mark.parametrize("name", TABLES)
def test_old_keys_and_current_keys_are_distinct(name: str) -> None:
    table = TABLES[name]
    assert len(set(table.values())) == len(table)
    assert not table.keys() & set(table.values())


def test_old_keys_are_added_at_every_level() -> None:
    tree = {"alpha": [{"beta": 2, "other": 3}], "c": {"alpha": None}}
    inner = [{"beta": 2, "other": 3, "b": 2}]
    assert old_keys.add_old_keys(tree, CURRENT) == {"alpha": inner, "c": {"alpha": None, "a": None}, "a": inner}


@pytest.mark.parametrize(
    "entries",
    [
        [("alpha", 1), ("x", 2)],
        [("a", 1), ("x", 2)],
        [("alpha", 1), ("x", 2), ("a", 1)],
        [("a", 1), ("alpha", 1), ("x", 2)],
    ],
    ids=["current", "old", "both", "old first"],
)
def test_current_entries_hide_old_keys(entries: list[tuple[str, int]]) -> None:
    assert list(old_keys.current_entries(entries, CURRENT)) == [("alpha", 1), ("x", 2)]
