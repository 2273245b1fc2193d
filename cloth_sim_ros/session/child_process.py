# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Child Python processes without the working directory on their import path.

`python -m` and `python -c` put the working directory first on the import path, and an empty entry of PYTHONPATH means
the working directory too. A folder of foreign recordings may hold an `argparse.py`.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator

_SAFE, _PATH = "PYTHONSAFEPATH", "PYTHONPATH"
#: Interval at which a child looks for its parent [s].
_POLL_SECONDS = 0.25


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the argument list that runs a module in a separate Python, with `child_environment()` as environment."""
    return [sys.executable, "-P", "-m", module, *arguments]


def overrides() -> dict[str, str]:
    """Return the environment variables to set so that a Python imports nothing from its working directory."""
    changed = {_SAFE: "1"}
    if _PATH in os.environ:
        changed[_PATH] = os.pathsep.join(filter(None, os.environ[_PATH].split(os.pathsep)))
    return changed


def child_environment() -> dict[str, str]:
    """Return a copy of this process's environment for a child that imports nothing from the working directory."""
    return {**os.environ, **overrides()}


@contextlib.contextmanager
def safe_imports() -> Iterator[None]:
    """Context that changes os.environ, so that processes started in it import nothing from the working directory."""
    changed = overrides()
    before = {name: os.environ.get(name) for name in changed}
    os.environ.update(changed)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def exit_with_parent(parent: int) -> None:
    """Start a thread that ends this process as soon as its parent has ended, which SIGKILL may have ended.

    Args:
        parent: process id of the parent.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_POLL_SECONDS)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()
