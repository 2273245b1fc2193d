# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files that a scene names, read once and carried with the scene.

A recording stores their content too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cloth_sim_ros.physics.arithmetic.deterministic_math import integer_sum
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.scene.input_file import InputFileError
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Parameters that name a file.
FILE_PARAMETERS = ("cloth.mesh", "cloth.springs", "bending.rest_angles", "initial_state", "ensemble.file")
#: Parameter that names a fabric, or the file of one.
FABRIC = "material.fabric"
#: End of the name of a parameter that names an obstacle's file.
_MESH_SUFFIX = ".mesh"
#: Largest total size of the files of a scene [bytes]. Recordings hold these files, and readers accept that size.
MAX_BYTES = 128 << 20


def read(values: Mapping[str, Any], known: Mapping[str, bytes], folder: str | Path) -> dict[str, bytes]:
    """Read the files that parameter values name, unless `known` has them; return contents by these names, or raise.

    Args:
        values: parameters by full name.
        known: content that is already loaded; these files are not read again.
        folder: base of relative names.

    Raises:
        ParameterError: for a file that can't be read.
    """
    content: dict[str, bytes] = {}
    for parameter, name in named(values):
        content[name] = known[name] if name in known else file_content(parameter, Path(folder) / name)
        n_bytes = integer_sum(map(len, content.values()))
        if n_bytes > MAX_BYTES:
            raise ParameterError(
                f"{parameter} '{name}': the files of the scene have {n_bytes} bytes; at most {MAX_BYTES} are taken"
            )
    return content


def named(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield each of the parameter values that names a file: parameter and name."""
    mesh_parameters = [name for name in values if name.endswith(_MESH_SUFFIX) and name not in FILE_PARAMETERS]
    for parameter in (*FILE_PARAMETERS, FABRIC, *mesh_parameters):
        name = values.get(parameter)
        if isinstance(name, str) and name and (parameter != FABRIC or is_fabric_file(name)):
            yield parameter, name


def is_fabric_file(name: str) -> bool:
    """Return True if a value of `material.fabric` is the path of a file, False if it is the name of a fabric."""
    return "/" in name or name.endswith((".yaml", ".yml"))


def file_content(parameter: str, path: Path) -> bytes:
    """Read the file that a parameter names, at most 128 MiB; raise ParameterError, naming the parameter, if it fails.

    Raises:
        ParameterError: if it can't be read.
    """
    try:
        return input_file.read_bytes(path, max_bytes=MAX_BYTES)
    except InputFileError as error:
        raise ParameterError(f"{parameter} {error}") from error
    except ValueError as error:
        # A null character, or one that the file system's encoding lacks.
        raise ParameterError(f"{parameter} {str(path)!r} is no file name: {error}") from error
    except OSError as error:
        raise ParameterError(f"{parameter}: cannot read '{path}': {error.strerror}") from error
