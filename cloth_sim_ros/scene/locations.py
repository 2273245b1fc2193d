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
    """Return the path of one of the package's configuration files.

    Raises:
        FileNotFoundError: if no location has it; the message names the locations.
    """
    places = [Path(__file__).resolve().parents[2] / "config" / name]
    places += _ament_places(name)
    places.append(Path(sys.prefix) / "share" / _PACKAGE / "config" / name)
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(f"{name} is none of {', '.join(str(place) for place in places)}")


def _ament_places(name: str) -> list[Path]:
    try:
        from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

        return [Path(get_package_share_directory(_PACKAGE)) / "config" / name]
    except ImportError:
        return []
    except (PackageNotFoundError, OSError):
        # The package is missing, or (OSError) no prefix is set: the wheels set none.
        return []
