# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Builds of interface packages that are not on PyPI, by the rosidl generators of the wheels.

A build is kept in build/interfaces and made once. The definitions have the documented fields, written anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.metadata
import os
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from cloth_sim_ros.engine import build

FOLDER = Path(__file__).resolve().parents[2] / "build" / "interfaces"
#: Definitions by file, of each package.
CONTROL_MSGS = {
    "msg/GripperCommand.msg": "float64 position\nfloat64 max_effort\n",
    "action/GripperCommand.action": (
        "GripperCommand command\n---\nfloat64 position\nfloat64 effort\nbool stalled\nbool reached_goal\n"
        "---\nfloat64 position\nfloat64 effort\nbool stalled\nbool reached_goal\n"
    ),
    "action/ParallelGripperCommand.action": (
        "sensor_msgs/JointState command\n---\nsensor_msgs/JointState state\nbool stalled\nbool reached_goal\n"
        "---\nsensor_msgs/JointState state\n"
    ),
}
SIMULATION_INTERFACES = {
    "msg/Result.msg": (
        "uint8 FEATURE_UNSUPPORTED=0\nuint8 OK=1\nuint8 NOT_FOUND=2\nuint8 INCORRECT_STATE=3\n"
        "uint8 OPERATION_FAILED=4\nuint8 result\nstring error_message\n"
    ),
    "msg/SimulationState.msg": (
        "uint8 STATE_STOPPED=0\nuint8 STATE_PLAYING=1\nuint8 STATE_PAUSED=2\nuint8 STATE_QUITTING=3\nuint8 state\n"
    ),
    "msg/SimulatorFeatures.msg": (
        "uint8 SPAWNING=0\nuint8 SIMULATION_RESET=20\nuint8 SIMULATION_RESET_TIME=21\n"
        "uint8 SIMULATION_RESET_STATE=22\nuint8 SIMULATION_STATE_GETTING=24\nuint8 SIMULATION_STATE_SETTING=25\n"
        "uint8 SIMULATION_STATE_PAUSE=26\nuint8 STEP_SIMULATION_SINGLE=31\nuint8 STEP_SIMULATION_MULTIPLE=32\n"
        "uint8 STEP_SIMULATION_ACTION=33\nuint16[] features\nstring[] spawn_formats\nstring custom_info\n"
    ),
    "srv/GetSimulatorFeatures.srv": "---\nSimulatorFeatures features\n",
    "srv/GetSimulationState.srv": "---\nSimulationState state\nResult result\n",
    "srv/SetSimulationState.srv": (
        "SimulationState state\n---\nuint8 ALREADY_IN_TARGET_STATE=101\nuint8 STATE_TRANSITION_ERROR=102\n"
        "uint8 INCORRECT_TRANSITION=103\nResult result\n"
    ),
    "srv/ResetSimulation.srv": (
        "uint8 SCOPE_DEFAULT=0\nuint8 SCOPE_TIME=1\nuint8 SCOPE_STATE=2\nuint8 SCOPE_SPAWNED=4\nuint8 SCOPE_ALL=255\n"
        "uint8 scope\n---\nResult result\n"
    ),
    "srv/StepSimulation.srv": "uint64 steps\n---\nResult result\n",
    "action/SimulateSteps.action": (
        "uint64 steps\n---\nResult result\n---\nuint64 completed_steps\nuint64 remaining_steps\n"
    ),
}
#: Packages whose types the definitions use.
_DEPENDENCIES = (
    "action_msgs",
    "builtin_interfaces",
    "sensor_msgs",
    "service_msgs",
    "std_msgs",
    "unique_identifier_msgs",
)
_GENERATORS = (
    "rosidl-adapter",
    "rosidl-generator-c",
    "rosidl-generator-py",
    "rosidl-generator-type-description",
    "rosidl-typesupport-c",
    "rosidl-typesupport-fastrtps-c",
    "rosidl-typesupport-introspection-c",
)


_PACKAGES = {"control_msgs": CONTROL_MSGS, "simulation_interfaces": SIMULATION_INTERFACES}


def build_package(name: str, definitions: Mapping[str, str]) -> tuple[Path | None, str]:
    """Build an interface package unless it is built already.

    Args:
        name: name of the package.
        definitions: text of each definition, by its path in the package.

    Returns:
        The folder to import it from, or None and the reason why it can't be built.
    """
    try:
        versions = [importlib.metadata.version(f"ros-{generator}") for generator in _GENERATORS]
        compiler = build.find_compiler()
    except (importlib.metadata.PackageNotFoundError, build.BuildError) as error:
        return None, f"{name} can't be built: {error}"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return None, f"{name} can't be built: Python.h is missing"
    parts = [sys.version, *versions, *compiler, *definitions, *definitions.values(), Path(__file__).read_text()]
    folder = FOLDER / f"{name}-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    done = folder / "done"
    with build.lock_folder(folder):
        if not done.exists():
            # A process of its own: the generators read AMENT_PREFIX_PATH and change what the process has imported.
            arguments = [sys.executable, "-m", "support.interface_packages", name, str(folder)]
            environment = {**os.environ, "AMENT_PREFIX_PATH": sys.prefix}
            root = Path(__file__).resolve().parents[1]
            answer = subprocess.run(
                arguments, cwd=root, env=environment, capture_output=True, text=True, check=False, timeout=600
            )
            if answer.returncode:
                return None, f"{name} can't be built: {answer.stderr.strip().splitlines()[-1]}"
            done.touch()
    return folder, ""


@contextlib.contextmanager
def importable(name: str, *modules: str) -> Iterator[list[Any]]:
    """Import modules of an interface package within a context; build it if it is not installed, or skip the test."""
    folder: Path | None = None
    try:
        importlib.import_module(name)
    except ImportError:
        folder, reason = build_package(name, _PACKAGES[name])
        if folder is None:
            pytest.skip(reason)
        sys.path.append(str(folder))
    yield [importlib.import_module(f"{name}.{module}") for module in modules]
    if folder is not None:
        sys.path.remove(str(folder))
        for loaded in [loaded for loaded in sys.modules if loaded.partition(".")[0] == name]:
            del sys.modules[loaded]


def _build(name: str, folder: Path, definitions: Mapping[str, str]) -> None:
    """Translate, generate, compile and link a package in a folder."""
    import rosidl_generator_c.cli
    from rosidl_adapter.cli import convert_action_to_idl, convert_msg_to_idl, convert_srv_to_idl
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    source, package = folder / "source" / name, folder / name
    files = []
    for path, text in definitions.items():
        (source / path).parent.mkdir(parents=True, exist_ok=True)
        (source / path).write_text(text)
        convert = {".action": convert_action_to_idl, ".msg": convert_msg_to_idl, ".srv": convert_srv_to_idl}[
            Path(path).suffix
        ]
        idl = convert(source, name, Path(path), (source / path).parent)
        files.append(f"{source}:{Path(idl).relative_to(source)}")
    paths = [*(str(Path(sys.prefix) / "share" / dependency) for dependency in _DEPENDENCIES), str(source)]
    c_folder = folder / "rosidl_generator_c" / name
    descriptions = HashTypeDescription("").generate_type_hashes(name, files, paths, c_folder)
    # By kind and name: the generator's own function takes a message for an action of the same name.
    rosidl_generator_c.cli.build_type_description_tuples = lambda idl_files, _: [
        f"{file.rpartition(':')[2]}:{c_folder / Path(file.rpartition(':')[2]).with_suffix('.json')}"
        for file in idl_files
    ]
    rosidl_generator_c.cli.GenerateC("").generate(name, files, paths, c_folder, descriptions)
    supports = {
        "rosidl_typesupport_introspection_c": GenerateIntrospectionCTypesupport(""),
        "rosidl_typesupport_fastrtps_c": GenerateFastRTPSCTypesupport(""),
    }
    dispatch = GenerateCTypesupport("", typesupport_implementations=list(supports))
    for support, generator in {**supports, "rosidl_typesupport_c": dispatch}.items():
        generator.generate(name, files, paths, folder / support / name)
    GeneratePython("", typesupport_implementations=["rosidl_typesupport_c"]).generate(name, files, paths, package)
    (package / "__init__.py").touch()
    libraries: list[str] = []
    for part in ("rosidl_generator_c", *supports):
        target = package / f"lib{name}__{part}.so"
        _link(folder, [folder / part], target, libraries, [f"-Wl,-soname,{target.name}"])
        libraries.append(str(target))
    extension = package / f"{name}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    _link(folder, [folder / "rosidl_typesupport_c", package], extension, libraries, [])


def _link(folder: Path, roots: Sequence[Path], target: Path, libraries: Sequence[str], options: Sequence[str]) -> None:
    """Compile the sources below some folders, and link them to a library that loads its neighbours."""
    wheels, compiler = Path(sys.prefix), build.find_compiler()
    packages = [path for path in (wheels / "include").iterdir() if path.is_dir() and not path.name.startswith("python")]
    generated = [path for path in folder.iterdir() if path.name.startswith("rosidl")]
    includes = [*generated, *packages, wheels / "include", sysconfig.get_paths()["include"], _numpy_include()]
    objects = []
    for suffix, kind in {".c": ["-x", "c"], ".cpp": ["-x", "c++", "-std=c++17"]}.items():
        paths = sorted(path for root in roots for path in root.rglob(f"*{suffix}"))
        # One unit, because headers take most of the time. Descriptions define the same names for a common type.
        units = [path for path in paths if path.stem.endswith("__description")]
        unit = folder / f"{target.stem}{suffix}"
        unit.write_text("".join(f'#include "{path}"\n' for path in paths if path not in units))
        for path in [*units, unit]:
            objects.append(str(path.with_suffix(f"{suffix}.o")))
            flags = ["-fPIC", "-O0", "-w", *(f"-I{include}" for include in includes), "-c", *kind]
            subprocess.run([*compiler, *flags, str(path), "-o", objects[-1]], check=True)
    wheel_libraries = [str(path) for path in (wheels / "lib").glob("*.so")]
    search = ["-Wl,--no-as-needed", f"-Wl,-rpath,$ORIGIN:{wheels / 'lib'}"]
    command = [*compiler, "-shared", *objects, *search, *libraries, "-Wl,--as-needed", *wheel_libraries, *options]
    subprocess.run([*command, "-o", str(target)], check=True)


def _numpy_include() -> str:
    import numpy as np

    return np.get_include()


if __name__ == "__main__":
    _build(sys.argv[1], Path(sys.argv[2]), _PACKAGES[sys.argv[1]])
