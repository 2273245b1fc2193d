# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files that a scene names: devices, pipes and oversized files are refused unread."""

import os
import subprocess
import sys

import pytest

from cloth_sim_ros.scene import files
from cloth_sim_ros.scene.parameters.declare import ParameterError


@pytest.mark.parametrize("parameter", ["cloth.mesh", "cloth.springs", "initial_state", "table.mesh"])
def test_a_device_is_refused(parameter):
    with pytest.raises(ParameterError, match=rf"^{parameter} '/dev/null' is a device or a pipe; name a file on disk"):
        files.read({parameter: "/dev/null"}, {}, ".")


def test_a_pipe_is_refused_without_waiting_for_its_writer(tmp_path):
    os.mkfifo(tmp_path / "mesh.obj")
    code = f"from cloth_sim_ros.scene import files\nfiles.read({{'cloth.mesh': 'mesh.obj'}}, {{}}, {str(tmp_path)!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert "is a device or a pipe" in done.stderr


def test_size_limit_ignores_claimed_size(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "MAX_BYTES", 1000)
    (tmp_path / "small").write_bytes(b"x" * 1000)
    (tmp_path / "large").write_bytes(b"x" * 1001)
    assert files.read({"cloth.mesh": "small"}, {}, tmp_path) == {"small": b"x" * 1000}
    with pytest.raises(ParameterError, match="has 1001 bytes; at most 1000 are read"):
        files.read({"cloth.mesh": "large"}, {}, tmp_path)
    # The file claims a size of 0.
    if os.path.exists("/proc/self/maps"):
        with pytest.raises(ParameterError, match="has more than 1000 bytes; at most 1000 are read"):
            files.read({"cloth.mesh": "/proc/self/maps"}, {}, tmp_path)


def test_file_larger_than_claimed_is_read_completely():
    name = "/proc/self/status"
    if not os.path.exists(name):
        pytest.skip("no file here claims less than it holds")
    assert b"Pid:" in files.read({"cloth.mesh": name}, {}, ".")[name]
