# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C during the start of each command except the node: one line, no traceback."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

SESSION = Path(__file__).parent / "data" / "session_0.1.0.mcap"
#: Interrupts itself at the import of its nth module, counted from the command's start.
PROGRAM = """
import os, signal, sys
from {module} import main
class Finder:
    left = {number}
    def find_spec(self, *_):
        Finder.left -= 1
        if not Finder.left:
            os.write(2, b"interrupt\\n")
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
sys.exit(main({arguments}))
"""
#: The drape test imports fewer modules than the largest count, so it ends by itself.
COARSE = ["--specimens", "1", "--edge-length", "0.02", "--no-mesh-error"]
#: For each command: its module, its requirements, and arguments that give it work.
COMMANDS: dict[str, tuple[str, str, list[str]]] = {
    "cloth_sim --check": ("cloth_sim_ros.ros.main", "rclpy", ["--check", "{folder}/scene.yaml"]),
    "cloth_gripper": ("cloth_sim_ros.ros.gripper_main", "rclpy", ["--node", "/nowhere", "--wait", "1.0"]),
    "cloth_viewer": ("cloth_sim_ros.ros.viewer_main", "rclpy", ["--python", "{folder}/python"]),
    "cloth_session": ("cloth_sim_ros.session.command", "mcap", ["info", str(SESSION)]),
    "cloth_verify": ("cloth_sim_ros.verify.command", "mcap", [str(SESSION)]),
    "cloth_replay": ("cloth_sim_ros.replay.command", "rerun", [str(SESSION), "--save", "{folder}/out.rrd"]),
    "cloth_batch": ("cloth_sim_ros.studies.command", "distributed", ["check", "{folder}/scene.yaml"]),
    "cloth_drape": ("cloth_sim_ros.laboratory.drape_command", "scipy", ["denim", *COARSE]),
    "cloth_fit": ("cloth_sim_ros.fit.command", "mcap", [str(SESSION), "--parameters", "stretch"]),
}


@pytest.mark.parametrize("import_count", [1, 40, 500])
@pytest.mark.parametrize("command", COMMANDS)
def test_interrupt_leaves_no_traceback(
    command: str, import_count: int, ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    module, needed, arguments = COMMANDS[command]
    if importlib.util.find_spec(needed) is None:
        pytest.skip(f"{needed} is not there")
    (tmp_path / "scene.yaml").write_text("/**: {ros__parameters: {rate: 60.0}}\n")
    filled = [argument.format(folder=tmp_path) for argument in arguments]
    program = PROGRAM.format(module=module, number=import_count, arguments=filled)
    process = start_process([sys.executable, "-c", program], cwd=tmp_path)
    status = process.wait()
    assert "Traceback" not in process.output
    if "interrupt\n" in process.output:
        # The live viewer returns 1 while it is at work, as for any failure.
        assert status in ((130, 1) if command == "cloth_viewer" else (130,)), process.output
        assert len(process.output.splitlines()) < 8, process.output


#: Interrupts itself at the import of a module, and prints a line if the interpreter then ends as usual.
REPLAY_PROGRAM = """
import atexit, os, signal, sys
from cloth_sim_ros.replay.command import main
atexit.register(lambda: os.write(2, b"usual end\\n"))
class Finder:
    def find_spec(self, name, *_):
        if name == "rerun.components":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
sys.exit(main({arguments}))
"""


def test_interrupt_while_rerun_loads_ends_at_once(start_process: Callable[..., Any], tmp_path: Path) -> None:
    """An interpreter that ends as usual would race with rerun's threads, which its import starts."""
    pytest.importorskip("rerun")
    program = REPLAY_PROGRAM.format(arguments=[str(SESSION), "--save", str(tmp_path / "out.rrd")])
    process = start_process([sys.executable, "-c", program], cwd=tmp_path)
    assert process.wait() == 130
    assert process.output == "cloth_replay: interrupted\n"
    assert not list(tmp_path.glob("*.rrd*"))
