# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old keys of statuses and JSON files, kept for one release.

Writers add the old keys, and readers accept them. docs/migration.md lists them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

_Entry = TypeVar("_Entry")

#: Current keys of the node's diagnostics by old key.
DIAGNOSTICS = {
    "accuracy_allowed_m": "accuracy_bound_m",
    "accuracy_behind_s": "accuracy_lag_s",
    "accuracy_own_error_m": "accuracy_uncertainty_m",
    "accuracy_windows_left_out": "accuracy_windows_skipped",
    "accuracy_windows_not_kept": "accuracy_windows_violated",
    "commands_outdated": "commands_stale",
    "energy_rubbed_j": "energy_friction_j",
    "halted": "stopped_bodies",
    "integrator_why": "integrator_reason",
    "tolerance_in_force_m": "tolerance_effective_m",
    "tolerance_why": "tolerance_reason",
}
#: Current keys of a gripper's state by old key.
GRIPPER_STATE = {"held": "grasped_count"}
#: Current keys of `cloth_verify --json` by old key.
CERTIFICATE = {
    "growth": "amplification",
    "judged": "error_known",
    "kept": "satisfied",
    "later": "later_amplification",
    "number": "index",
    "own": "uncertainty",
    "promise": "error_bound",
    "promise_of_frame": "error_bound_of_frame",
    "session_growth": "session_amplification",
    "session_own": "session_uncertainty",
    "standing_out": "violating_frames",
}
#: Current keys of `cloth_fit --json` by old key.
FIT = {
    "all_told": "all_identified",
    "held": "grasped",
    "lost": "unreadable",
    "parts": "components",
    "sigma_given": "sigma_prescribed",
    "ties": "confounded",
    "told": "identified",
}
#: Current keys of `cloth_session info --json` by old key.
SESSION_SUMMARY = {"least": "min", "most": "max"}


def add_old_keys(tree: Any, current_keys: Mapping[str, str]) -> Any:
    """Return a copy of a JSON tree whose objects have each renamed entry by its old key, too.

    Args:
        tree: JSON objects, lists and scalars.
        current_keys: current keys by old key.
    """
    if isinstance(tree, Mapping):
        content = {key: add_old_keys(entry, current_keys) for key, entry in tree.items()}
        return content | {old: content[key] for old, key in current_keys.items() if key in content}
    if isinstance(tree, list):
        return [add_old_keys(entry, current_keys) for entry in tree]
    return tree


def current_entries(
    entries: Iterable[tuple[str, _Entry]], current_keys: Mapping[str, str]
) -> Iterator[tuple[str, _Entry]]:
    """Yield (key, entry) pairs with old keys renamed; an old key is skipped if its current key is present, too.

    Args:
        entries: pairs of key and entry, with current keys, old keys or both.
        current_keys: current keys by old key.
    """
    pairs = list(entries)
    present = {key for key, _ in pairs}
    for key, entry in pairs:
        current = current_keys.get(key, key)
        if current == key or current not in present:
            yield current, entry
