# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Completeness of the pages on troubleshooting: every text of the node's log and every diagnostics key."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import pytest

from cloth_sim_ros.session import old_keys

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "cloth_sim_ros"
PAGES = [
    ROOT / "docs" / name
    for name in (
        "troubleshooting.md",
        "troubleshooting_start.md",
        "node/cameras.md",
        "node/gripper_action.md",
        "node/simulation_interfaces.md",
        "node/uncertainty.md",
        "node/viewers.md",
        "tutorials/robot.md",
    )
]
PAGE = " ".join(" ".join(path.read_text(encoding="utf-8").replace("<br>", " ") for path in PAGES).split())
#: Modules of `ros` whose texts belong to other commands: the demo, the gripper client, the viewer,
#: `cloth_sim --check`.
OTHER_COMMANDS = re.compile(
    r"demo|options|check|step_limiters|cloth_clock|viewer_(?!feed)\w+|gripper_(?!speed|actions)\w+"
)
#: Modules outside `ros` whose texts the node logs: refused events, grasps, contact, implausible sizes.
LOGGED = {"event_checks", "contact_recovery", "plausibility", "grippers", "parallel_grippers", "initial_penetration"}
#: Not printed: a filter of warnings, and a profile of the middleware.
UNPRINTED = {"Failed to fini rosout publisher", '<?xml version="1.0" encoding="UTF-8"?>'}
LEVELS = {"debug", "info", "warn", "warning", "error"}
#: Shortest text outside a log call that is a sentence; shorter ones are names and units [words].
MIN_WORDS = 4


def constant_parts(text: ast.AST) -> list[str]:
    """Return the constant parts of a string, f-string or expression of them."""
    return [part.value for part in ast.walk(text) if isinstance(part, ast.Constant) and isinstance(part.value, str)]


def key_phrase(parts: list[str]) -> str:
    """Return the first clause of at least 4 words, else of 3, else of 2; empty if there is none."""
    clauses = [" ".join(c.split()).strip(' ".?') for part in parts for c in re.split(r"[;:,()|'\n]|\. ", part)]
    return next((c for count in (4, 3, 2) for c in clauses if len(c.split()) >= count and "{}" not in c), "")


def log_phrases(source: str) -> set[str]:
    """Return the key phrases of all log calls and of all sentences in a module, without its docstrings."""
    tree = ast.parse(source)
    skipped = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    phrases = set()
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in LEVELS
            and node.args
        ):
            phrases.add(key_phrase(constant_parts(node.args[-1])))
        is_text = isinstance(node, ast.JoinedStr | ast.Constant) and node not in skipped
        if is_text and sum(len(part.split()) for part in constant_parts(node)) >= MIN_WORDS:
            phrases.add(key_phrase(constant_parts(node)))
        if isinstance(node, ast.JoinedStr):
            skipped.update(part for part in ast.walk(node) if part is not node)
    return phrases - {"", *UNPRINTED}


def logged_modules() -> list[Path]:
    """Return the modules whose texts the node logs or answers."""
    paths = [path for path in sorted(PACKAGE.rglob("*.py")) if not path.is_relative_to(PACKAGE / "replay")]
    return [
        path
        for path in paths
        if (path.is_relative_to(PACKAGE / "ros") and not OTHER_COMMANDS.fullmatch(path.stem)) or path.stem in LOGGED
    ]


def diagnostics_keys() -> set[str]:
    golden = {
        name: json.loads((ROOT / "test" / "golden" / name).read_text()) for name in ("node.json", "live_session.json")
    }
    keys = {
        *golden["node.json"]["diagnostics"],
        *golden["live_session.json"]["recorded"]["keys of statuses"]["/diagnostics"],
    }
    return keys - old_keys.DIAGNOSTICS.keys()


@pytest.mark.parametrize("path", logged_modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_page_has_each_log_text(path: Path) -> None:
    missing = sorted(phrase for phrase in log_phrases(path.read_text(encoding="utf-8")) if phrase not in PAGE)
    assert not missing, "docs/troubleshooting.md lacks a row with: " + "; ".join(missing)


def test_page_has_each_diagnostics_key() -> None:
    keys = diagnostics_keys()
    assert len(keys) > 40
    assert not sorted(key for key in keys if f"`{key}`" not in PAGE)


def test_page_has_each_reason_of_stopped_time() -> None:
    raised = set()
    for path in (PACKAGE / "physics").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("UnstableError", "NoRoomError"):
                raised.add(key_phrase(constant_parts(node)))
    assert len(raised - {""}) > 4
    assert not sorted(phrase for phrase in raised if phrase not in PAGE)


def test_log_phrases_skip_docstrings_and_names() -> None:
    source = '''"""A module whose docstring is long."""
def check(log, name, n):
    """Log a text that is long."""
    log.warn(f"late {name}", f"'{name}' is late: {n} frames of many were late")
    log.info(f"recording into {name}")
    raise ValueError(f"{name} is not a known name of the cloth; leave it out")
'''
    assert log_phrases(source) == {"frames of many were late", "recording into", "is not a known name of the cloth"}
