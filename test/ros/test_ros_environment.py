# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Environments in which no node can start: one sentence with the remedy, from node, gripper client and viewer."""

from __future__ import annotations

import argparse
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cloth_sim_ros.ros.process.arguments import ArgumentsError, check_environment, explain_error, read_and_start

COMMANDS = {
    "cloth_sim": "cloth_sim_ros.ros.main",
    "cloth_gripper": "cloth_sim_ros.ros.gripper_main",
    "cloth_viewer": "cloth_sim_ros.ros.viewer_main",
}
#: Without it the viewer also says that there is no screen.
ARGUMENTS = {"cloth_viewer": ["--connect", "rerun+http://127.0.0.1:1/proxy"]}
LOG_REMEDY = "set ROS_LOG_DIR to a folder that can be written"
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("command", COMMANDS)
def test_no_log_folder_gives_one_sentence(start_process: Callable[..., Any], command: str) -> None:
    variables = {"HOME": "", "ROS_LOG_DIR": "", "ROS_HOME": ""}
    process = start_process(["-m", COMMANDS[command], *ARGUMENTS.get(command, [])], env=variables)
    assert process.wait() == 1
    (line,) = process.output.strip().splitlines()
    assert line.startswith(f"{command}: HOME is not set, so the log has no folder ~/.ros/log")
    assert line.endswith(LOG_REMEDY)


def test_unwritable_log_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    below = str(tmp_path / "file" / "below")
    for variables, words in (
        ({"HOME": ""}, "HOME is not set, so the log has no folder ~/.ros/log"),
        ({"HOME": below, "ROS_LOG_DIR": "", "ROS_HOME": ""}, f"the log's folder {below}/.ros/log can't be made"),
        ({"ROS_LOG_DIR": below}, f"the log's folder {below} can't be made, Not a directory"),
        ({"ROS_LOG_DIR": str(tmp_path / "file")}, f"the log's folder {tmp_path / 'file'} can't be made, File exists"),
        ({"ROS_LOG_DIR": "", "ROS_HOME": below}, f"the log's folder {below}/log can't be made"),
    ):
        with pytest.raises(ArgumentsError) as refused:
            check_environment(variables, [])
        assert str(refused.value).startswith(words)
        assert str(refused.value).endswith(LOG_REMEDY)


def test_missing_log_folder_is_created(tmp_path: Path) -> None:
    check_environment({"ROS_LOG_DIR": "~/log", "HOME": str(tmp_path)}, [])
    assert (tmp_path / "log").is_dir()
    # Without a log file there is no folder to check.
    check_environment({}, ["cloth_sim", "--ros-args", "--disable-external-lib-logs"])


def test_security_without_keystore_gives_one_sentence(tmp_path: Path) -> None:
    log = {"ROS_LOG_DIR": str(tmp_path)}
    secure = {**log, "ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}
    with pytest.raises(ArgumentsError, match="ROS_SECURITY_KEYSTORE is not set"):
        check_environment(secure, [])
    keys = tmp_path / "keys"
    with_keys = {**secure, "ROS_SECURITY_KEYSTORE": str(keys)}
    with pytest.raises(ArgumentsError, match="there is no enclave '/towel', which would be in "):
        check_environment(with_keys, ["cloth_sim", "--ros-args", "--enclave", "/towel"])
    (keys / "enclaves" / "towel").mkdir(parents=True)
    check_environment(with_keys, ["cloth_sim", "--ros-args", "--enclave", "/towel"])
    check_environment({**with_keys, "ROS_SECURITY_ENCLAVE_OVERRIDE": "/towel"}, ["cloth_sim"])
    # rcl continues without security, or ignores the setting.
    for variables in ({"ROS_SECURITY_STRATEGY": "Permissive"}, {"ROS_SECURITY_ENABLE": "false"}):
        check_environment({**secure, **variables}, [])


def test_unknown_ros_argument_is_named() -> None:
    with pytest.raises(ArgumentsError, match=re.escape("['--bogus'] are no ROS arguments: see 'ros2 run'")):
        read_and_start(argparse.ArgumentParser(), ["cloth_sim", "--ros-args", "--bogus"])


def test_middleware_without_security_is_explained() -> None:
    explanation = explain_error(
        "error creating node: This Fast DDS version doesn't have the security libraries, Please compile"
    )
    assert "ROS_SECURITY_ENABLE is true, and the Fast DDS of this environment was built without security" in explanation
    assert "unset ROS_SECURITY_ENABLE" in explanation
    assert explain_error("failed to parse arguments") == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_secured_environment_gives_no_traceback(
    start_process: Callable[..., Any], tmp_path: Path, command: str
) -> None:
    variables = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}
    arguments = ["-m", COMMANDS[command], *ARGUMENTS.get(command, [])]
    process = start_process(arguments, env=variables)
    assert process.wait() == 1
    (line,) = process.output.strip().splitlines()
    assert line.startswith(f"{command}: ROS_SECURITY_ENABLE is true and ROS_SECURITY_STRATEGY is Enforce, but ")
    # Without keys: a middleware with security refuses to start, one without reports the missing support.
    (tmp_path / "enclaves").mkdir()
    process = start_process(arguments, env={**variables, "ROS_SECURITY_KEYSTORE": str(tmp_path)})
    assert process.wait() == 1
    lines = [line for line in process.output.strip().splitlines() if line.startswith(f"{command}: ")]
    assert len(lines) == 1
    assert "Traceback" not in process.output
    assert "RuntimeWarning" not in process.output


def test_make_hides_security_and_says_so() -> None:
    script = 'print-secure:\n\t@echo "[$${ROS_SECURITY_ENABLE}$${ROS_SECURITY_KEYSTORE}]"\n'
    done = subprocess.run(
        ["make", "--no-print-directory", "-f", "Makefile", "-f", "-", "print-secure"],
        cwd=ROOT, input=script, text=True, capture_output=True, check=True,
        env={"PATH": "/usr/bin:/bin", "ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_KEYSTORE": "/keys"},
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "[]"
    assert "without security" in done.stderr
