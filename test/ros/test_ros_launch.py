# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The launch file, and several cloths by name, namespace, remapping and parameter file.

`launch` is not on PyPI. If it is missing, stubs of the classes that the file uses build the command line of launch_ros
(its Node action: name, namespace, parameters, in this order).
"""

from __future__ import annotations

import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Bool
from support.ros_client import Client, pose, positions

from cloth_sim_ros.ros.io.qos_rules import topics_of
from cloth_sim_ros.scene.parameters.parameter_file import read
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

ROOT = Path(__file__).resolve().parents[2]
LAUNCH = ROOT / "launch" / "cloth_sim.launch.py"


class Substitution:
    """A text that is resolved from the launch arguments."""

    def __init__(self, resolve: Callable[[dict[str, str]], str]) -> None:
        self._resolve = resolve

    def perform(self, context: Any) -> str:
        return self._resolve(context.launch_configurations)


def text_of(value: Any, arguments: dict[str, str]) -> str:
    """Resolve a text, a substitution, or a list of them, like launch."""
    if isinstance(value, Substitution):
        return value.perform(SimpleNamespace(launch_configurations=arguments))
    return "".join(text_of(item, arguments) for item in value) if isinstance(value, list) else str(value)


class Launched:
    """The launch file, run with launch arguments `name:=value` and stubs for its imports.

    Args:
        packages: packages of viewers that are installed.

    Attributes:
        declared: options of each declared argument.
        nodes: options of each node.
        words: log messages.
    """

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, packages: tuple[str, ...] = ("foxglove_bridge", "rviz2"), **given: str
    ) -> None:
        self._packages = packages
        self.declared: dict[str, Any] = {}
        self.nodes: list[dict[str, Any]] = []
        self.words: list[str] = []
        with monkeypatch.context() as patch:
            for name, module in self._stand_ins().items():
                patch.setitem(sys.modules, name, module)
            actions = runpy.run_path(str(LAUNCH))["generate_launch_description"]()
            values = {name: text_of(options["default_value"], {}) for name, options in self.declared.items()} | given
            for name, options in self.declared.items():
                assert values[name] in options.get("choices", [values[name]]), f"launch refuses {name}"
            for action in actions:
                if callable(action):
                    action(SimpleNamespace(launch_configurations=values))

    def _stand_ins(self) -> dict[str, ModuleType]:
        def module(name: str, **members: Any) -> ModuleType:
            stub = ModuleType(name)
            vars(stub).update(members)
            return stub

        def path_join(parts: list[Any]) -> Substitution:
            return Substitution(lambda given: str(Path(*(text_of(part, given) for part in parts))))

        return {
            "launch": module("launch", LaunchContext=object, LaunchDescription=lambda entities: entities),
            "launch.actions": module(
                "launch.actions",
                DeclareLaunchArgument=lambda name, **options: self.declared.__setitem__(name, options),
                LogInfo=lambda *, msg: self.words.append(msg),
                OpaqueFunction=lambda *, function: function,
            ),
            "launch.substitutions": module(
                "launch.substitutions",
                LaunchConfiguration=lambda name: Substitution(lambda given: given[name]),
                PathJoinSubstitution=path_join,
            ),
            "launch_ros": module("launch_ros"),
            "launch_ros.actions": module("launch_ros.actions", Node=lambda **options: self.nodes.append(options)),
            "launch_ros.substitutions": module(
                "launch_ros.substitutions",
                FindPackageShare=lambda package: Substitution(lambda given: str(ROOT)),
                FindPackagePrefix=lambda package: Substitution(lambda given: self._prefix(package)),
            ),
        }

    def _prefix(self, package: str) -> str:
        if package not in self._packages:
            # ament_index_python.packages.PackageNotFoundError is a KeyError.
            raise KeyError(f"package '{package}' not found")
        return str(ROOT)


def command_line(monkeypatch: pytest.MonkeyPatch, **given: str) -> list[str]:
    """Return the node's command line for launch arguments `name:=value`, like launch_ros."""
    launched = Launched(monkeypatch, **given)
    assert given.keys() <= launched.declared.keys()
    assert all(options["description"] for options in launched.declared.values())
    (node,) = launched.nodes
    assert (node["package"], node["executable"]) == ("cloth_sim_ros", "cloth_sim")
    arguments = ["--ros-args", *node["ros_arguments"], "-r", f"__node:={node['name']}"]
    if node["namespace"]:
        arguments += ["-r", f"__ns:=/{node['namespace'].strip('/')}"]
    for entry in node["parameters"]:
        if isinstance(entry, dict):
            arguments += [word for name, value in entry.items() for word in ("-p", f"{name}:={str(value).lower()}")]
        else:
            arguments += ["--params-file", text_of(entry, {})]
    return ["-m", "cloth_sim_ros.ros.main", *arguments]


def write_parameters(path: Path, **nodes: dict[str, Any]) -> Path:
    """Write a parameter file of several nodes."""
    path.write_text(yaml.safe_dump({name: {"ros__parameters": content} for name, content in nodes.items()}))
    return path


def test_without_arguments_the_default_cloth_is_launched(
    ros_domain: int, start_process: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    process = start_process(command_line(monkeypatch))
    process.wait_for_output("900 particles at 60 Hz of wall time, grippers: gripper")
    assert "expected real-time factor: " in process.output
    with Client() as client:
        client.watch("/cloth_sim")
    # As on Ctrl-C: one signal from the terminal, one from ros2 launch.
    process.send_signal(2)
    process.send_signal(2)
    assert process.wait() == 0
    assert "Traceback" not in process.output


def test_every_argument_reaches_the_node(
    ros_domain: int, start_process: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = command_line(monkeypatch, use_sim_time="true", log_level="warn", name="towel")
    process = start_process([*arguments, "-p", "cloth.resolution:=[5, 5]", "-p", "cloth.sizes:=[1.0, 1.0]"])
    process.wait_for_output("did you mean 'cloth.size'?")
    with Client() as client:
        request = GetParameters.Request(names=["use_sim_time"])
        answer = client.call(GetParameters, "/towel/get_parameters", request)
        assert answer.values[0].bool_value
    assert process.interrupt() == 0
    assert "[INFO]" not in process.output


@pytest.mark.parametrize("use_sim_time", ["", "true", "False"])
def test_launch_keeps_use_sim_time_of_parameter_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, use_sim_time: str
) -> None:
    file = str(write_parameters(tmp_path / "own.yaml", cloth_sim={}))
    launched = Launched(monkeypatch, params_file=file, use_sim_time=use_sim_time, viewer="rviz")
    expected = [{"use_sim_time": use_sim_time == "true"}] if use_sim_time else []
    cloth, rviz = launched.nodes
    assert cloth["parameters"] == [file, *expected]
    assert rviz["parameters"] == expected


def test_each_packaged_scene_is_a_launch_argument(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = Launched(monkeypatch).declared["scene"]["choices"]
    for scene in scenes:
        (cloth,) = Launched(monkeypatch, scene=scene).nodes
        path = Path(text_of(cloth["parameters"][0], {}))
        assert path == ROOT / "config" / f"{scene}.yaml"
        Simulation(Scene.from_file(path))
        # Relative names in a scene's file are passed as full paths: a node resolves them in its working directory.
        further = [value for values in cloth["parameters"][1:] for value in values.items()]
        parameters = read(path)
        assert [(name, text_of(value, {})) for name, value in further] == [
            (name, str(path.parent / parameters[name]))
            for name in ("cloth.mesh", "cloth.springs", "robot.description_file", "ensemble.file")
            if name in parameters
        ]


def test_each_documented_scene_is_a_launch_argument(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    documented = {scene for page in pages for scene in re.findall(r"scene:=(\w+)", page.read_text())}
    assert len(documented) > 4
    assert documented <= set(Launched(monkeypatch).declared["scene"]["choices"])


@pytest.mark.parametrize(("namespace", "full"), [("", "/cloth_sim"), ("left_arm", "/left_arm/cloth_sim")])
def test_viewer_is_started_for_the_launched_cloth(namespace: str, full: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(Launched(monkeypatch, viewer="none").nodes) == 1
    _, rerun = Launched(monkeypatch, viewer="rerun", namespace=namespace).nodes
    assert (rerun["package"], rerun["executable"]) == ("cloth_sim_ros", "cloth_viewer")
    assert rerun["arguments"] == ["--node", full]
    _, rviz = Launched(monkeypatch, viewer="rviz", namespace=namespace).nodes
    assert rviz["package"] == "rviz2"
    launched = Launched(monkeypatch, viewer="foxglove", namespace=namespace)
    _, bridge = launched.nodes
    assert (bridge["package"], bridge["executable"]) == ("foxglove_bridge", "foxglove_bridge")
    # Private topics of other robots stay private, and other machines see nothing.
    (parameters,) = bridge["parameters"]
    assert parameters["address"] == "127.0.0.1"
    allowed = [re.compile(pattern) for pattern in parameters["topic_whitelist"]]
    for topic in (f"{full}/points", f"{full}/gripper/wrench", "/tf", "/tf_static", "/rosout", "/diagnostics"):
        assert any(pattern.fullmatch(topic) for pattern in allowed)
    assert not any(pattern.fullmatch("/camera/image") for pattern in allowed)
    text = "".join(text_of(part, {}) for part in launched.words[0])
    assert str(ROOT / "config" / "cloth_sim.foxglove.json") in text
    assert (f"replaced by {full}" in text) == bool(namespace)


def test_foxglove_layout_shows_topics_of_the_node() -> None:
    layout = json.loads((ROOT / "config" / "cloth_sim.foxglove.json").read_text())
    panels = layout["configById"]
    leaves: list[str] = []
    waiting = [layout["layout"]]
    while waiting:
        branch = waiting.pop()
        if isinstance(branch, str):
            leaves.append(branch)
        else:
            assert branch["direction"] in ("row", "column")
            waiting += [branch["first"], branch["second"]]
    assert sorted(leaves) == sorted(panels)
    topics = topics_of(Scene.from_parameters({"obstacles": ["ball"], "ball.shape": "sphere", "ball.size": [0.1]}))
    sent = {topic.replace("~", "/cloth_sim") for topic in topics["publisher"]} | {"/rosout", "/cloth_sim/keypoints"}
    (view,) = (panel for name, panel in panels.items() if name.startswith("3D!"))
    assert {"/cloth_sim/mesh", "/cloth_sim/obstacles"} <= view["topics"].keys() <= sent
    assert view["topics"]["/cloth_sim/mesh"]["visible"]
    commands = {topic.replace("~", "/cloth_sim") for topic in topics["subscription"]}
    assert {view["publish"]["pointTopic"], view["publish"]["poseTopic"]} <= commands
    for panel in (panel for name, panel in panels.items() if name.startswith("Plot!")):
        assert {path["value"].partition(".")[0] for path in panel["paths"]} <= sent


def test_rviz_argument_of_old_still_works(monkeypatch: pytest.MonkeyPatch) -> None:
    launched = Launched(monkeypatch, rviz="true")
    assert [node["package"] for node in launched.nodes] == ["cloth_sim_ros", "rviz2"]
    assert launched.words == ["rviz:=true is the former name of viewer:=rviz, and works for one release"]
    assert len(Launched(monkeypatch, rviz="true", viewer="rviz").nodes) == 2


def test_rviz_shows_the_cloth_that_is_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(Launched(monkeypatch).nodes) == 1
    _, rviz = Launched(monkeypatch, viewer="rviz", namespace="left_arm", name="towel").nodes
    assert (rviz["package"], rviz["executable"]) == ("rviz2", "rviz2")
    option, path = rviz["arguments"]
    assert option == "-d"
    manager = yaml.safe_load(Path(path).read_text())["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "world"
    shown = {entry["Class"].rpartition("/")[2]: entry for entry in manager["Displays"]}
    assert shown.keys() == {"Grid", "TF", "Marker", "MarkerArray", "PointCloud2"}
    topics = {kind: shown[kind]["Topic"] for kind in ("Marker", "MarkerArray", "PointCloud2")}
    assert topics["MarkerArray"]["Durability Policy"] == "Transient Local"
    assert {topic["Reliability Policy"] for topic in topics.values()} == {"Reliable"}
    (tool,) = (entry["Topic"]["Value"] for entry in manager["Tools"] if entry["Class"].endswith("PublishPoint"))
    # The topics of the configuration, remapped to those of the node.
    assert dict(rviz["remappings"]) == {
        topics["PointCloud2"]["Value"]: "/left_arm/towel/points",
        topics["Marker"]["Value"]: "/left_arm/towel/mesh",
        topics["MarkerArray"]["Value"]: "/left_arm/towel/obstacles",
        tool: "/left_arm/towel/gripper/point",
    }
    _, plain = Launched(monkeypatch, viewer="rviz").nodes
    assert all(old == new for old, new in plain["remappings"])


def test_misspelt_launch_argument_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    launched = Launched(monkeypatch, param_file="own.yaml", robot="left")
    assert launched.words == ["cloth_sim.launch.py has no argument 'param_file'; did you mean 'params_file'?"]


def test_missing_parameter_file_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    # launch_ros warns only, and the node would start with its defaults.
    with pytest.raises(FileNotFoundError, match=r"params_file:=towle\.yaml is not a file \(/.*/towle\.yaml\)"):
        Launched(monkeypatch, params_file="towle.yaml")


@pytest.mark.parametrize(
    ("viewer", "package"), [("foxglove", "ros-jazzy-foxglove-bridge"), ("rviz", "ros-jazzy-rviz2")]
)
def test_missing_viewer_is_refused_first(monkeypatch: pytest.MonkeyPatch, viewer: str, package: str) -> None:
    with pytest.raises(RuntimeError, match=f"viewer:={viewer} needs .* apt install {package}, or choose viewer:=rerun"):
        Launched(monkeypatch, packages=(), viewer=viewer)
    assert len(Launched(monkeypatch, packages=(), viewer="rerun").nodes) == 2


def test_two_cloths_are_launched_from_one_parameter_file(
    ros_domain: int, start_process: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    values = {
        "/left_arm/towel": {"cloth": {"resolution": [5, 6]}},
        "/right_arm/sheet": {"cloth": {"resolution": [7, 4]}},
    }
    everyone = {"/**": {"rate": 50.0, "grippers": ["finger"], "gripper": {"radius": 0.3}}}
    file = str(write_parameters(tmp_path / "cloths.yaml", **{**everyone, **values}))
    cloths = {
        name: start_process(command_line(monkeypatch, params_file=file, namespace=name[0], name=name[1]))
        for name in (("left_arm", "towel"), ("right_arm", "sheet"))
    }
    for (_, name), process in cloths.items():
        process.wait_for_output("30 particles" if name == "towel" else "28 particles")
        assert "at 50 Hz" in process.output
    with Client() as client:
        clouds: dict[str, PointCloud2] = {}
        for namespace, name in cloths:
            client.node.create_subscription(
                PointCloud2, f"/{namespace}/{name}/points", lambda cloud, name=name: clouds.__setitem__(name, cloud), 10
            )
        client.spin_until(lambda: len(clouds) == 2, description="both clouds")
        assert {name: (cloud.height, cloud.width) for name, cloud in clouds.items()} == {
            "towel": (5, 6), "sheet": (7, 4),
        }  # fmt: skip
        # Commands of one cloth do not reach the other.
        target = client.publisher(PoseStamped, "/left_arm/towel/finger/target")
        grasp = client.publisher(Bool, "/left_arm/towel/finger/grasp")

        def is_grasped() -> bool:
            return "is closed and holds" in cloths["left_arm", "towel"].output

        target.publish(pose(0.5, 0.0, 0.5))
        grasp.publish(Bool(data=False))
        client.spin_until(lambda: is_grasped() or close(client, target, grasp), description="the grasp")
        target.publish(pose(0.5, -0.4, 0.8))
        client.spin_until(lambda: positions(clouds["towel"])[-1][2] > 0.7, description="one cloth lifted")
        assert positions(clouds["sheet"])[-1][2] < 0.6
    for process in cloths.values():
        assert process.interrupt() == 0
        assert "several nodes" not in process.output


def close(client: Client, target: Any, grasp: Any) -> bool:
    """Send a target, then a grasp. The target is best effort and may be missed until the publisher is matched."""
    target.publish(pose(0.5, 0.0, 0.5))
    for _ in range(10):
        client.executor.spin_once(timeout_sec=0.02)
    grasp.publish(Bool(data=False))
    grasp.publish(Bool(data=True))
    return False


def test_everything_may_be_remapped(ros_domain: int, start_process: Callable[..., Any]) -> None:
    remaps = {
        "~/points": "/perception/cloud", "~/gripper/target": "/arm/commanded", "~/gripper/grasp": "/hand/closed",
        "~/gripper/wrench": "/arm/felt", "~/pause": "/hold_cloth", "/diagnostics": "/health",
    }  # fmt: skip
    arguments = [word for old, new in remaps.items() for word in ("-r", f"{old}:={new}")]
    process = start_process(["-m", "cloth_sim_ros.ros.main", "--ros-args", *arguments, "-p", "gripper.radius:=0.3"])
    process.wait_for_output("wall time")
    with Client() as client:
        client.node.create_subscription(PointCloud2, "/perception/cloud", client.clouds.append, 10)
        client.wait_for_clouds(2)
        target = client.publisher(PoseStamped, "/arm/commanded")
        grasp = client.publisher(Bool, "/hand/closed")
        client.spin_until(
            lambda: "and holds" in process.output or close(client, target, grasp), description="the grasp"
        )
        client.spin_until(
            lambda: {"/arm/felt", "/health"} <= {name for name, _ in client.node.get_topic_names_and_types()},
            description="the remapped outputs",
        )
        client.spin_until(
            lambda: "/hold_cloth" in {name for name, _ in client.node.get_service_names_and_types()},
            description="the remapped service",
        )
    assert process.interrupt() == 0


def test_the_documented_process_of_two_cloths(ros_domain: int, start_process: Callable[..., Any]) -> None:
    page = (ROOT / "docs" / "node" / "many_cloths.md").read_text()
    # With rclpy's own signal handlers, which shut everything down before the cloths are closed.
    (script,) = (block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "ClothNode" in block)
    process = start_process([sys.executable, "-c", script])
    with Client() as client:
        for name in ("towel", "sheet"):
            clouds: list[PointCloud2] = []
            client.node.create_subscription(PointCloud2, f"/robot/{name}/points", clouds.append, 10)
            client.spin_until(lambda clouds=clouds: len(clouds) > 3, description=f"clouds of {name}")
    assert process.interrupt() == 0, process.output
    assert "Traceback" not in process.output
