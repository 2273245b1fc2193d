# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Golden files: JSON with every name of a public contract, and their comparison with the code."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "golden"
#: Most entries of each kind that a message lists.
_MAX_LISTED = 40


def path_of(subject: str) -> Path:
    """Return the golden file of a subject."""
    return FOLDER / f"{subject}.json"


def write(subject: str, contract: Any) -> None:
    """Write the golden file of a subject anew."""
    FOLDER.mkdir(exist_ok=True)
    path_of(subject).write_text(_text(contract), encoding="utf-8")


def differences(subject: str, contract: Any) -> str:
    """Return a message that lists new, gone and changed entries; empty if there are none."""
    remedy = f"If this is intended, run `python test/test_golden.py --write {subject}` and commit the file."
    if not path_of(subject).exists():
        return f"{path_of(subject)} is missing. {remedy}"
    before = _entries(json.loads(path_of(subject).read_text(encoding="utf-8")))
    now = _entries(json.loads(_text(contract)))
    lines = _listed("new", [f"{name}: {now[name]}" for name in now if name not in before])
    lines += _listed("gone", [f"{name}: {before[name]}" for name in before if name not in now])
    changed = [name for name in now if name in before and json.dumps(before[name]) != json.dumps(now[name])]
    lines += _listed("changed", [f"{name}: {before[name]} -> {now[name]}" for name in changed])
    if not lines:
        return ""
    return "\n".join([f"{path_of(subject).name} and the code differ:", *lines, remedy])


def _text(contract: Any) -> str:
    return json.dumps(contract, indent=1, sort_keys=True, ensure_ascii=False) + "\n"


def _entries(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return all leaves by path; those of a list of texts are its items, each with the item before it."""
    if isinstance(tree, dict) and tree:
        return {
            name: leaf
            for key in tree
            for name, leaf in _entries(tree[key], f"{prefix}{' / ' * bool(prefix)}{key}").items()
        }
    if isinstance(tree, list) and tree and all(isinstance(item, str) for item in tree):
        return {f"{prefix} / {item}": f"after {before}" for before, item in itertools.pairwise(["nothing", *tree])}
    return {prefix: tree}


def _listed(kind: str, entries: list[str]) -> list[str]:
    more = [f"  {kind}: {len(entries) - _MAX_LISTED} more"] if len(entries) > _MAX_LISTED else []
    return [*(f"  {kind}: {entry}" for entry in entries[:_MAX_LISTED]), *more]
