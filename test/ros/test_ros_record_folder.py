# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recording folder of a running node, and messages if it can't be written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import SetBool, Trigger
from support.ros_client import Client, start_cloth


def test_record_folder_change_applies_and_bad_one_warns_once(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("mcap")
    (tmp_path / "file").write_text("")
    # Without /clock no frame comes for which a change could wait.
    first = f"record.folder:={tmp_path / 'first'}"
    process = start_cloth(start_process, "use_sim_time:=true", "cloth.resolution:=[5, 5]", first, wait="Hz of /clock")
    with Client() as client:

        def set_folder(folder: str) -> None:
            value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=folder)
            request = SetParameters.Request(parameters=[Parameter(name="record.folder", value=value)])
            assert client.call(SetParameters, "/cloth_sim/set_parameters", request).results[0].successful

        def record(begin: bool) -> Any:
            return client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=begin))

        def save() -> Any:
            return client.call(Trigger, "/cloth_sim/save_state")

        set_folder(str(tmp_path / "second"))
        for answer in (save(), record(True), record(False)):
            assert answer.success, answer.message
            assert Path(answer.message).parent == tmp_path / "second"
        assert not (tmp_path / "first").exists()
        for folder, words in (
            (str(tmp_path / "file" / "x"), "it is, or lies under, a file; set record.folder"),
            ("~nobody-of-this-name/x", "there is no such home folder; set record.folder"),
        ):
            set_folder(folder)
            saved, recorded = save(), record(True)
            assert (saved.success, recorded.success) == (False, False)
            assert words in saved.message, saved.message
            assert "Errno" not in saved.message
            assert words in recorded.message, recorded.message
        # The node goes on as before.
        set_folder(str(tmp_path / "third"))
        assert save().success
        process.wait_for_output("nothing is recorded: cannot record into")
    assert process.interrupt() == 0
    assert len([line for line in process.output.splitlines() if "[ERROR]" in line]) == 1, process.output
    assert "Traceback" not in process.output
