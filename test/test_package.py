# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Packaging: declarations, licence headers, and the documented commands of colcon."""

from __future__ import annotations

import ast
import configparser
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

import cloth_sim_ros

ROOT = Path(__file__).resolve().parent.parent
HEADER = "# Copyright 2026 the cloth_sim_ros authors\n# SPDX-License-Identifier: Apache-2.0\n"
FOLDERS = ("benchmarks", "cloth_sim_ros", "docs", "examples", "launch", "scripts", "test", "validation")
SOURCES = [
    ROOT / "setup.py",
    *sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if "__pycache__" not in path.parts),
]
SHELL = [ROOT / "Makefile", ROOT / ".ci" / "run", *sorted((ROOT / "scripts").glob("*.sh"))]
COMMANDS = {
    "cloth_sim", "cloth_gripper", "cloth_replay", "cloth_verify", "cloth_session", "cloth_bench",
    "cloth_batch", "cloth_fit", "cloth_viewer", "cloth_drape", "cloth_lab",
}  # fmt: skip


@pytest.fixture(scope="module")
def setup_arguments() -> dict[str, object]:
    """Return the arguments of setup.py to setuptools."""
    script = (
        "import json, runpy, setuptools\n"
        "setuptools.setup = lambda **arguments: print(json.dumps(arguments, default=str))\n"
        "runpy.run_path('setup.py')\n"
    )
    pytest.importorskip("setuptools")
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True, capture_output=True, text=True)

    arguments: dict[str, object] = json.loads(done.stdout.splitlines()[-1])
    return arguments


@pytest.mark.parametrize("path", [*SOURCES, *SHELL], ids=lambda path: str(path.relative_to(ROOT)))
def test_every_file_names_its_copyright_and_licence(path: Path) -> None:
    text = path.read_text()
    if text.startswith("#!"):
        text = text.split("\n", 1)[1]
    assert text.startswith(HEADER)


def test_licence_is_whole() -> None:
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text


def test_package_xml_is_valid() -> None:
    catkin_package = pytest.importorskip("catkin_pkg.package")
    warnings: list[str] = []
    package = catkin_package.parse_package(str(ROOT / "package.xml"), warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.package_format == 3
    assert package.get_build_type() == "ament_python"
    assert package.licenses == ["Apache-2.0"]


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("exec_depend>rclpy</exec_depend", "exec_depends>rclpy</exec_depends"),
        ("<version>0.2.0", "<version>0.2"),
        ("<name>cloth_sim_ros", "<name>Cloth Sim"),
        (
            ' email="cloth_sim_ros@example.org">cloth_sim_ros authors</maintainer>',
            ">cloth_sim_ros authors</maintainer>",
        ),
    ],
)
def test_a_package_xml_against_the_schema_is_refused(right: str, wrong: str) -> None:
    # Replacement for xmllint with ROS's schema: the parser of ROS's own tools finds the same faults.
    catkin_package = pytest.importorskip("catkin_pkg.package")
    text = (ROOT / "package.xml").read_text()
    assert right in text
    with pytest.raises(catkin_package.InvalidPackage):
        catkin_package.parse_package_string(text.replace(right, wrong)).validate()


@pytest.mark.parametrize("path", sorted([*ROOT.glob("*.xml"), *ROOT.glob("config/*.xml")]), ids=lambda path: path.name)
def test_xml_is_well_formed(path: Path) -> None:
    ElementTree.parse(path)


def test_package_xml_has_every_ros_package_that_is_imported() -> None:
    declared = {
        element.text for element in ElementTree.parse(ROOT / "package.xml").getroot() if "depend" in element.tag
    }
    # The import tf2_ros comes from the package tf2_ros_py.
    renamed = {"tf2_ros": "tf2_ros_py"}
    ros = re.compile(r".*_(msgs|srvs|interfaces|ros)$|^(rclpy|launch|ament_index_python)$")
    imported = set()
    for path in [*(ROOT / "cloth_sim_ros").rglob("*.py"), *(ROOT / "launch").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_bytes())):
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [node.module]
                if isinstance(node, ast.ImportFrom) and node.module and not node.level
                else []
            )
            imported |= {name.split(".")[0] for name in names}
    needed = {renamed.get(name, name) for name in imported if ros.match(name) and name != "cloth_sim_ros"}
    assert needed <= declared


def test_name_and_version_agree_everywhere(setup_arguments: dict[str, object]) -> None:
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    version = root.findtext("version")
    assert setup_arguments["version"] == version == cloth_sim_ros.__version__
    assert setup_arguments["name"] == root.findtext("name")
    assert setup_arguments["license"] == root.findtext("license")
    assert re.search(rf"^{re.escape(str(version))} \(", (ROOT / "CHANGELOG.rst").read_text(), re.MULTILINE)


def test_every_subpackage_is_a_package(setup_arguments: dict[str, object]) -> None:
    folders = {path.parent for path in (ROOT / "cloth_sim_ros").rglob("*.py")}
    expected = {str(folder.relative_to(ROOT)).replace(os.sep, ".") for folder in folders}
    assert expected == set(setup_arguments["packages"])  # type: ignore[call-overload]


def test_every_file_beside_the_code_is_declared(setup_arguments: dict[str, object]) -> None:
    patterns = [pattern for patterns in setup_arguments["package_data"].values() for pattern in patterns]  # type: ignore[attr-defined]
    for path in (ROOT / "cloth_sim_ros").rglob("*"):
        if path.is_file() and path.suffix not in {".py", ".pyc", ".so", ".o"}:
            assert any(path.match(pattern) for pattern in patterns), f"{path} would not be installed"


def test_every_data_file_is_declared(setup_arguments: dict[str, object]) -> None:
    declared = {file for _, files in setup_arguments["data_files"] for file in files}  # type: ignore[attr-defined]
    present = {
        str(path.relative_to(ROOT))
        for folder in ("config", "launch", "resource")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert present | {"package.xml"} == declared


def test_console_scripts_lead_to_functions(setup_arguments: dict[str, object]) -> None:
    scripts = setup_arguments["entry_points"]["console_scripts"]  # type: ignore[index,call-overload]
    commands = set()
    for script in scripts:
        name, _, target = script.replace(" ", "").partition("=")
        module, _, function = target.partition(":")
        commands.add(name)
        # Modules are read, not imported, because rclpy or rerun may not be installed.
        source = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        definitions = {node.name for node in ast.parse(source.read_bytes()).body if isinstance(node, ast.FunctionDef)}
        assert function in definitions, f"{name} leads to {target}, which is not defined in {source}"
    assert commands == COMMANDS


def test_executables_go_where_ros2_run_looks() -> None:
    settings = configparser.ConfigParser(interpolation=None)
    settings.read(ROOT / "setup.cfg")
    assert settings["develop"]["script_dir"] == "$base/lib/cloth_sim_ros"
    assert settings["install"]["install_scripts"] == "$base/lib/cloth_sim_ros"


def test_core_needs_neither_ros_nor_viewer_nor_tools(setup_arguments: dict[str, object]) -> None:
    def names(requirements: object) -> set[str]:
        return {re.split(r"[^A-Za-z0-9_-]", requirement)[0].lower() for requirement in requirements}  # type: ignore[attr-defined]

    extras: dict[str, object] = setup_arguments["extras_require"]  # type: ignore[assignment]
    assert names(setup_arguments["install_requires"]) <= {
        "numpy", "scipy", "attrs", "pyyaml", "xxhash", "tqdm",
    }  # fmt: skip
    for extra, requirements in extras.items():
        assert ("rerun-sdk" in names(requirements)) == (extra in {"replay", "demo", "dev"})
        ros = {name for name in names(requirements) if name.startswith("ros-") or name in {"rclpy", "sensor_msgs"}}
        assert all(name.startswith("ros-jazzy-") for name in ros), "the bare names also carry later distributions"
        assert bool(ros) == (extra in {"ros", "demo", "dev"})


def test_every_requirement_is_pinned_for_make(setup_arguments: dict[str, object]) -> None:
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line and not line.startswith("#")
    }
    required = [*setup_arguments["install_requires"]]  # type: ignore[misc]
    for requirements in setup_arguments["extras_require"].values():  # type: ignore[attr-defined]
        required += requirements
    names = {re.split(r"[^A-Za-z0-9_-]", requirement)[0].lower().replace("_", "-") for requirement in required}
    assert names <= pinned


def test_pyproject_holds_tools_only() -> None:
    # colcon treats a package with a [project] table as another kind than ament_python's setup.py.
    assert set(tomllib.loads((ROOT / "pyproject.toml").read_text())) == {"tool"}


def test_launch_file_is_well_formed() -> None:
    tree = ast.parse((ROOT / "launch" / "cloth_sim.launch.py").read_text())
    assert "generate_launch_description" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert (ROOT / "config" / "cloth_sim.yaml").is_file(), "the launch file's default parameters"


def documented(program: str) -> list[list[str]]:
    """Return the commands of a program in the documents."""
    texts = [
        path.read_text()
        for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    ]
    shown = re.findall(rf"\b({program} (?:\w[\w-]*)(?: +--?[\w-]+| +[\w./]+)*)", "\n".join(texts))
    return [command.split() for command in sorted(set(shown)) if "--" in command]


def test_documented_colcon_commands_are_there() -> None:
    pytest.importorskip("colcon_core")
    commands = documented("colcon")
    assert ["colcon", "build", "--packages-select", "cloth_sim_ros"] in commands
    helps: dict[str, str] = {}
    for _, verb, *arguments in commands:
        if verb not in helps:
            call = [sys.executable, "-m", "colcon", verb, "--help"]
            helps[verb] = subprocess.run(call, capture_output=True, text=True, check=True, cwd=ROOT).stdout
        for option in (argument for argument in arguments if argument.startswith("--")):
            assert re.search(rf"{option}\b", helps[verb]), f"colcon {verb} has no {option}"
    # The documents continue with `source install/setup.bash`.
    shells = [entry.name for entry in importlib.metadata.entry_points(group="colcon_core.shell")]
    assert "bash" in shells
