# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Layers of cloth_sim_ros: permitted imports and libraries of each subpackage.

A subpackage is called a room, and a rule about its imports a wall, as in docs/design.md. Each room is imported in a
fresh interpreter.
"""

from __future__ import annotations

import ast
import functools
import graphlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import cloth_sim_ros

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "cloth_sim_ros"

ROS = {"rclpy", "rosidl_runtime_py", "rpyutils", "sensor_msgs", "std_msgs", "geometry_msgs", "builtin_interfaces"}
VIEWER = {"rerun", "rerun_sdk", "rerun_bindings"}
STUDIES = {"loky", "dask", "distributed", "gymnasium", "zarr", "bokeh", "av"}
# Libraries that load slowly, or that a robot may lack: loaded at their first use.
LATE = {
    "matplotlib",
    "numba",
    "scipy.sparse",
    "scipy.optimize",
    "plyfile",
    "trimesh",
    "sksundae",
    "pyarrow",
    *STUDIES,
    *VIEWER,
}
FILES = {"mcap", "rosbags", "yaml"}
#: Rooms, and `batch`, the old address of three of them.
SUBPACKAGES = (
    *("engine", "physics", "scene", "camera", "simulation", "session", "verify", "replay", "ros"),
    *("studies", "learning", "fit", "laboratory", "batch"),
)

# For each subpackage: the subpackages it may load, and the libraries it must not load.
WALLS: dict[str, tuple[set[str], set[str]]] = {
    # The engine converts arrays to arrays. Its build.py runs before anything is installed.
    "engine": (set(), ROS | LATE | FILES | {"scipy", "tqdm"}),
    "physics": ({"engine"}, ROS | LATE | FILES | {"scipy", "tqdm"}),
    "scene": ({"engine", "physics"}, ROS | LATE | {"mcap", "rosbags"}),
    "camera": ({"engine", "physics", "scene"}, ROS | LATE | {"mcap", "rosbags"}),
    "simulation": ({"engine", "physics", "scene"}, ROS | LATE | {"mcap", "rosbags"}),
    "session": (set(), ROS | LATE | {"scipy"}),
    "replay": ({"session"}, ROS | {"scipy"}),
    "verify": ({"engine", "physics", "scene", "simulation", "session"}, ROS | LATE),
    "studies": ({"engine", "physics", "scene", "simulation", "session"}, ROS | LATE),
    # Environments inherit from gymnasium's classes.
    "learning": ({"engine", "physics", "scene", "simulation", "session"}, ROS | LATE - {"gymnasium"}),
    "fit": ({"engine", "physics", "scene", "simulation", "session"}, ROS | LATE),
    "laboratory": ({"engine", "physics", "scene", "simulation", "session"}, ROS | LATE),
    # Old addresses of the three.
    "batch": (
        {"engine", "physics", "scene", "simulation", "session", "studies", "learning", "fit"},
        ROS | LATE - {"gymnasium"},
    ),
    "ros": ({"engine", "physics", "scene", "camera", "simulation", "session"}, LATE),
}


# Folders at the top of the repository that measure the package and are not installed: the rooms of the package, and the
# folders beside it, that each may import.
_MEASURED = {"engine", "physics", "scene", "simulation", "session", "verify"}
MEASURING_FOLDERS: dict[str, tuple[set[str], set[str]]] = {
    "validation": (_MEASURED | {"fit", "laboratory"}, {"support"}),
    "benchmarks": (_MEASURED | {"camera", "studies", "learning", "ros"}, {"support", "validation"}),
}
#: Folders of the tests of both, without which the product's tests pass.
TESTED = ("benchmarks", "validation")


def room_of(path: Path) -> str:
    """Return the subpackage of a file, or the file's stem if it is in none."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules_of(room: str) -> list[str]:
    """Return the names of all modules of a subpackage."""
    names = []
    for path in sorted((PACKAGE / room).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return [name for name in names if not name.endswith("__main__")]


def loaded_by(modules: list[str], *, absent: set[str] | None = None) -> set[str]:
    """Return the names of all modules that a new interpreter loads with given imports.

    Libraries in `absent` are as if they were not installed.
    """
    script = (
        "import importlib, json, sys\n"
        f"sys.modules.update(dict.fromkeys({sorted(absent or ())!r}))\n"
        "before = set(sys.modules)\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "print(json.dumps(sorted(set(sys.modules) - before)))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def skip_without(room: str) -> None:
    """Skip if a subpackage's libraries are missing, as on a robot without viewer or a desktop without ROS."""
    required_modules = {
        "ros": ["rclpy"],
        "replay": ["mcap", "rerun"],
        "session": ["mcap", "rosbags"],
        "verify": ["mcap", "rosbags"],
    }
    for library in required_modules.get(room, []):
        pytest.importorskip(library)


@pytest.mark.parametrize("importer", WALLS)
def test_subpackage_loads_only_allowed_modules(importer: str) -> None:
    skip_without(importer)
    allowed, forbidden = WALLS[importer]
    loaded = loaded_by(modules_of(importer))
    neighbours = {subpackage for subpackage in SUBPACKAGES if f"cloth_sim_ros.{subpackage}" in loaded} - {importer}
    assert neighbours <= allowed
    assert not loaded & forbidden


def test_only_public_rclpy_api_is_used() -> None:
    # Handles of rcl and private names of rclpy change between distributions.
    for path in sorted((ROOT / "cloth_sim_ros" / "ros").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute):
                is_self_attribute = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls", "os")
                assert node.attr != "handle", f"{path.name}:{node.lineno}"
                assert is_self_attribute or node.attr.endswith("__") or not node.attr.startswith("_"), (
                    f"{path.name}:{node.lineno}"
                )
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rclpy"):
                names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
                assert not [name for name in names if name.startswith("_")], f"{path.name}:{node.lineno}"


@pytest.mark.parametrize(
    "command",
    [
        "session.main",
        "replay.main",
        "verify.main",
        "studies.main",
        "session.moved_bench",
        "laboratory.drape_main",
        "laboratory.lab_main",
        "ros.gripper_main",
        "ros.viewer_main",
    ],
)
def test_command_help_loads_no_heavy_module(command: str) -> None:
    skip_without(command.split(".")[0])
    assert not loaded_by([f"cloth_sim_ros.{command}"]) & LATE


def test_node_loads_without_pip_only_packages() -> None:
    # Recording, replay, mesh files and transforms are then refused with the reason at their use.
    pytest.importorskip("rclpy")
    loaded_by(modules_of("ros"), absent={"mcap", "rosbags", "lz4", "zstandard", "tf2_ros", "launch", *LATE})


def test_node_loads_no_camera_and_no_ensemble_module() -> None:
    # Only a scene with cameras or a distribution does.
    pytest.importorskip("rclpy")
    loaded, unused = loaded_by(["cloth_sim_ros.ros.node"]), {"camera", "ensemble", "distribution"}
    assert not [name for name in loaded if unused & set(name.split("."))], sorted(loaded)


def test_unused_ensemble_is_not_loaded_by_simulation_and_studies() -> None:
    skip_without("verify")
    loaded = loaded_by(["cloth_sim_ros.simulation.simulation", "cloth_sim_ros.studies.study_run"])
    assert not [name for name in loaded if {"ensemble", "distribution"} & set(name.split("."))], sorted(loaded)


def test_replay_loads_without_ros_and_without_scipy() -> None:
    skip_without("replay")
    loaded_by(modules_of("replay"), absent=ROS | {"scipy"})


def test_import_of_the_package_loads_few_modules() -> None:
    loaded = loaded_by(["cloth_sim_ros"])
    heavy = ROS | LATE | FILES | {"numpy", "scipy"}
    assert not loaded & heavy
    assert not {room for room in SUBPACKAGES if f"cloth_sim_ros.{room}" in loaded}


@functools.cache
def imports_of(path: Path) -> frozenset[str]:
    """Return the full names of a file's imports, lazy imports included."""
    imported: set[str] = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name their module in full"
            imported |= {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(imported)


@pytest.mark.parametrize("folder", MEASURING_FOLDERS)
def test_measuring_folders_import_only_what_they_may(folder: str) -> None:
    rooms, allowed_folders = MEASURING_FOLDERS[folder]
    for path in sorted((ROOT / folder).rglob("*.py")):
        imported = imports_of(path)
        tops = {name.split(".")[0] for name in imported}
        assert tops & {*MEASURING_FOLDERS, "support"} - {folder} <= allowed_folders, path
        assert {room for room in SUBPACKAGES if f"cloth_sim_ros.{room}" in imported} <= rooms, path
        if path.parent.name != "ros":
            assert not tops & ROS, f"{path}: ROS is measured in benchmarks/ros alone"


@pytest.mark.parametrize("folder", MEASURING_FOLDERS)
def test_measuring_folders_load_heavy_libraries_late(folder: str) -> None:
    if not (ROOT / folder).is_dir():
        pytest.skip(f"there is no {folder}")
    assert not loaded_by([f"{folder}.__main__"]) & (ROS | LATE | {"numpy", "scipy"})
    paths = [path.relative_to(ROOT).with_suffix("") for path in sorted((ROOT / folder).rglob("*.py"))]
    modules = [".".join(path.parts) for path in paths if path.parts[1] != "ros" and not path.stem.startswith("__")]
    # Problems that scipy solves for comparison import it at the top.
    assert not loaded_by(modules) & (ROS | LATE - {"scipy.sparse", "scipy.optimize"})


def test_the_package_and_its_tests_need_no_measuring_folder() -> None:
    tests = [path for path in (ROOT / "test").rglob("*.py") if path.parent.name not in TESTED]
    for path in [*PACKAGE.rglob("*.py"), *tests]:
        tops = {name.split(".")[0] for name in imports_of(path)}
        assert not tops & {*MEASURING_FOLDERS, *({"support"} if path.is_relative_to(PACKAGE) else ())}, path


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_lazy_imports_respect_the_layers(path: Path) -> None:
    # Lazy imports are not in sys.modules above, but respect the layers too.
    importer = room_of(path)
    imported = imports_of(path)
    if importer != "ros":
        assert not {name for name in imported if name.split(".")[0] in ROS}, "only the room ros imports ROS"
    if importer != "replay":
        assert not {name for name in imported if name.split(".")[0] in VIEWER}, "only the room replay imports a viewer"
    if importer == "physics":
        assert not {name for name in imported if name.split(".")[0] in FILES | {"time", "datetime", "logging"}}
        assert "print(" not in path.read_text(encoding="utf-8")
    if importer in WALLS:
        neighbours = {subpackage for subpackage in SUBPACKAGES if f"cloth_sim_ros.{subpackage}" in imported} - {
            importer
        }
        assert neighbours <= WALLS[importer][0]


def test_subpackages_do_not_import_the_public_api() -> None:
    # `from cloth_sim_ros import Simulation` loads a name from any subpackage, which the tests above don't see.
    public = {f"cloth_sim_ros.{name}" for name in [*cloth_sim_ros.__all__, "__version__", "_MODULES"]}
    paths = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]
    public_imports = {str(path.relative_to(PACKAGE)): imports_of(path) & public for path in paths}
    assert not {name: names for name, names in public_imports.items() if names}


def test_modules_import_each_other_in_no_circle() -> None:
    # Imports for annotations and lazy imports count too; the `__init__.py` of a subpackage imports its own modules.
    paths = [path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"]
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): imports_of(path) for path in paths}
    graph = {name: imported & modules.keys() for name, imported in modules.items()}
    # Raises CycleError, which names the circle.
    graphlib.TopologicalSorter(graph).prepare()


def test_every_subpackage_is_listed() -> None:
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and (path / "__init__.py").is_file()}
    assert folders == set(SUBPACKAGES)
    assert [path.name for path in PACKAGE.glob("*.py")] == ["__init__.py"]
    assert all((PACKAGE / room / "__init__.py").read_text(encoding="utf-8").count('"""') == 2 for room in SUBPACKAGES)


#: Members of ctypes, of named tuples and of the interpreter, which are public despite their names.
PUBLIC_UNDERSCORES = {
    "_restype_",
    "_argtypes_",
    "_fields_",
    "_fields",
    "_name",
    "_replace",
    "_asdict",
    "_exit",
    "_MEIPASS",
}


def private_members(path: Path) -> list[str]:
    """Return the places that read a private member of another object without `# private: reason` nearby."""
    lines = path.read_text(encoding="utf-8").split("\n")
    places = []
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.Attribute):
            is_self = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            names = [] if is_self or isinstance(node.value, ast.Call) else [node.attr]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cloth_sim_ros"):
            names = [alias.name for alias in node.names]
        else:
            continue
        nearby = "\n".join(lines[max(0, node.lineno - 4) : node.end_lineno])
        if "# private: " not in nearby:
            hidden = [name for name in names if name.startswith("_") and not name.startswith("__")]
            places += [f"{path.name}:{node.lineno} {name}" for name in hidden if name not in PUBLIC_UNDERSCORES]
    return places


def test_tests_read_private_members_with_a_reason(tmp_path: Path) -> None:
    sample = tmp_path / "sample.py"
    sample.write_text("from cloth_sim_ros.a import _b\nx = plan._owner\n\n\n\n# private: a reason\ny = plan._owner\n")
    assert private_members(sample) == ["sample.py:1 _b", "sample.py:2 _owner"]
    places = [member for path in sorted((ROOT / "test").rglob("*.py")) for member in private_members(path)]
    assert not places
