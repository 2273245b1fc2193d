# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Location of the package's configuration files.

They are in a source tree, under a colcon prefix, or in a pip environment.
"""

from __future__ import annotations

import sys
from pathlib import Path

_PACKAGE = "cloth_sim_ros"


def config_file(name: str) -> Path:
    """Return the path of the package's configuration file `name`, e.g. `grasp.yaml`, or raise FileNotFoundError.

    Raises:
        FileNotFoundError: if no location has it; the message names the locations.
    """
    candidates = [Path(__file__).resolve().parents[2] / "config" / name]
    candidates += _ament_paths(name)
    candidates.append(Path(sys.prefix) / "share" / _PACKAGE / "config" / name)
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f"{name} is none of {', '.join(str(candidate) for candidate in candidates)}")


def _ament_paths(name: str) -> list[Path]:
    try:
        from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

        return [Path(get_package_share_directory(_PACKAGE)) / "config" / name]
    except ImportError:
        return []
    except (PackageNotFoundError, OSError):
        # The package is missing, or (OSError) no prefix is set: the wheels set none.
        return []
