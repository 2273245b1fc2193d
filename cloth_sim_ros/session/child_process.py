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
from collections.abc import Iterator

_SAFE, _PATH = "PYTHONSAFEPATH", "PYTHONPATH"


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command line that runs a module in a separate Python; use it with `child_environment`."""
    return [sys.executable, "-P", "-m", module, *arguments]


def overrides() -> dict[str, str]:
    """Return environment variables that keep the working directory off the import path of a Python process."""
    changed = {_SAFE: "1"}
    if _PATH in os.environ:
        changed[_PATH] = os.pathsep.join(filter(None, os.environ[_PATH].split(os.pathsep)))
    return changed


def child_environment() -> dict[str, str]:
    """Return this process's environment variables, changed to keep the working directory off the import path."""
    return {**os.environ, **overrides()}


@contextlib.contextmanager
def safe_imports() -> Iterator[None]:
    """Keep the working directory off the import path of processes that libraries (Dask, loky) start meanwhile."""
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
