# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Public contracts, made from the code itself, against the files of test/golden.

A name that users, files or other programs rely on changes on purpose alone. `python test/test_golden.py --write` writes
all files anew, with subjects behind it those alone.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))

from support import golden

#: Functions of `support` that return a contract, by subject: module, function, libraries that they need.
SUBJECTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "api": ("contracts_library", "api", ("gymnasium",)),
    "events": ("contracts_library", "event_fields", ()),
    "parameters": ("contracts_library", "scene_parameters", ()),
    "state_memory": ("contracts_library", "memory", ()),
    "digests": ("contracts_library", "bits", ()),
    "engine_calls": ("contracts_library", "engine_calls", ()),
    "engine_symbols": ("contracts_library", "engine_symbols", ()),
    "package": ("contracts_commands", "package", ("setuptools",)),
    "command_options": ("contracts_commands", "options", ("rclpy", "mcap", "distributed")),
    "environment_variables": ("contracts_commands", "environment_variables", ()),
    "module_names": ("contracts_commands", "module_names", ()),
    "gymnasium": ("contracts_commands", "gymnasium_environments", ("gymnasium",)),
    "session_file": ("contracts_files", "session_file", ("mcap", "rosbags", "rclpy", "pyarrow")),
    "session_info": ("contracts_files", "session_info", ("mcap", "rosbags", "rclpy")),
    "certificate": ("contracts_files", "certificate", ("mcap", "rosbags", "rclpy")),
    "fit": ("contracts_files", "fit", ("mcap", "rosbags", "loky")),
    "study": ("contracts_files", "study", ("mcap", "rosbags", "distributed", "pyarrow", "zarr")),
    "scripts_and_springs": ("contracts_files", "scripts", ("mcap",)),
    "node": ("contracts_ros", "graph", ("rclpy",)),
    "live_session": ("contracts_ros", "live_session", ("rclpy", "mcap", "rosbags")),
}


def gather(subject: str) -> Any:
    """Return the contract of a subject as the code has it."""
    module, function, libraries = SUBJECTS[subject]
    for library in libraries:
        pytest.importorskip(library)
    contract: Callable[[], Any] = getattr(importlib.import_module(f"support.{module}"), function)
    return contract()


@pytest.mark.parametrize("subject", SUBJECTS)
def test_contract_equals_golden_file(subject: str, ros_domain: int) -> None:
    message = golden.differences(subject, gather(subject))
    assert not message, message


def test_every_golden_file_has_a_subject() -> None:
    assert {path.stem for path in golden.FOLDER.iterdir()} == set(SUBJECTS)


def main() -> None:
    """Write golden files anew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", nargs="*", choices=[*SUBJECTS, []], required=True, metavar="SUBJECT")
    subjects = parser.parse_args().write or list(SUBJECTS)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for subject in subjects:
        golden.write(subject, gather(subject))
        print(golden.path_of(subject))


if __name__ == "__main__":
    main()
