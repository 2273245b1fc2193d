# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ports of commands: they listen on this machine alone, and a scheduler requires its certificate."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

psutil = pytest.importorskip("psutil")
pytest.importorskip("mcap")

LOOPBACK = ("127.0.0.1", "::1")


def listening(pid: int) -> list[tuple[str, int]]:
    """Addresses and ports that a process and its descendants listen on."""
    root = psutil.Process(pid)
    addresses = []
    for process in (root, *root.children(recursive=True)):
        try:
            connections = process.net_connections(kind="inet")
        except psutil.NoSuchProcess:
            continue
        addresses += [tuple(connection.laddr) for connection in connections if connection.status == psutil.CONN_LISTEN]
    return addresses


def test_study_scheduler_refuses_client_without_certificate() -> None:
    pytest.importorskip("distributed")
    from distributed import Client, Security

    from cloth_sim_ros.studies.cluster import connect, local_scheduler

    with local_scheduler(1, lambda _text: None) as scheduler:
        client = connect(scheduler, wait=30.0)
        try:
            assert client.submit(abs, -3).result(timeout=30) == 3
        finally:
            client.close()
        assert {address for address, _ in listening(os.getpid())} <= set(LOOPBACK)
        host_port = scheduler.address.partition("://")[2]
        for address, security in ((f"tcp://{host_port}", None), (f"tls://{host_port}", Security.temporary())):
            with pytest.raises((OSError, TimeoutError, RuntimeError)):
                Client(address, security=security, timeout="5s", set_as_default=False)


@pytest.fixture
def screen(start_process: Callable[..., Any], wait_until: Callable[..., Any]) -> Iterator[str]:
    """A virtual screen."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed")
    display = 1000 + os.getpid() % 50000
    server = start_process([shutil.which("Xvfb"), f":{display}", "-screen", "0", "640x480x24", "-nolisten", "tcp"])
    wait_until(lambda: Path(f"/tmp/.X11-unix/X{display}").exists(), description="the screen")
    yield f":{display}"
    server.kill()


def test_viewer_window_listens_on_loopback_only(
    screen: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    wait_until: Callable[..., Any],
) -> None:
    pytest.importorskip("rerun")
    from support.session_maker import make_grasp

    from cloth_sim_ros.replay.show import open_viewer
    from cloth_sim_ros.replay.viewer import ViewerError

    monkeypatch.setenv("DISPLAY", screen)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    session = make_grasp(tmp_path, seconds=0.1, cloth__resolution=[4, 4])
    try:
        open_viewer([session])
    except ViewerError as error:
        pytest.skip(f"no window can be painted here: {error}")
    viewers = [child for child in psutil.Process().children(recursive=True) if "rerun" in child.name()]
    try:
        assert viewers
        addresses = [address for viewer in viewers for address, _ in listening(viewer.pid)]
        assert addresses
        assert set(addresses) <= set(LOOPBACK)
    finally:
        for viewer in viewers:
            viewer.kill()
