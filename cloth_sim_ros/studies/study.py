# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checked description of a study: scene, commands, factors and number of runs.

Workers read its JSON form.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.scene import input_file
from cloth_sim_ros.scene.fabrics import with_changes
from cloth_sim_ros.scene.files import FABRIC
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.unknown_parameters import suggestion
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import plain_json
from cloth_sim_ros.simulation.gripper_script import GripperScript
from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.factors import Factor
from cloth_sim_ros.studies.user_code import FunctionSource

VERSION = 1
#: First part of the names of factors that move a script's targets, and of a policy's values.
TARGET, POLICY = "target", "policy"
_ENTRY = re.compile(r"(.+)\[(\d{1,9})\]")
_AXES = ("x", "y", "z")


@attrs.frozen(kw_only=True)
class Study:
    """Checked study: common settings of all runs, and the factors that vary."""

    #: Parameters of the scene by full name.
    parameters: dict[str, Any]
    #: Content of all files that parameters and factors name, by that name.
    files: dict[str, bytes] = attrs.field(repr=False)
    #: Scripted grasps, one for each gripper.
    scripts: tuple[GripperScript, ...]
    #: Policy that replaces scripts, or None.
    policy: FunctionSource | None
    #: Outcome functions of the user.
    outcomes: tuple[FunctionSource, ...]
    #: Simulated time of each run [s].
    duration: float
    factors: tuple[Factor, ...]
    #: Number of runs.
    runs: int
    #: Seed of the sampling and of the runs' random numbers.
    seed: int
    #: Sampling method, one of `SAMPLINGS`.
    sampling: str
    #: True if sessions hold the clouds.
    clouds: bool

    def to_json(self, files: Mapping[str, str]) -> str:
        """Return the study as JSON, the same for equal studies; `files` maps the name of each file to a stored name."""
        content = attrs.asdict(self, filter=lambda field, _: field.name != "files")
        return json.dumps({"version": VERSION, **content, "files": dict(files)}, sort_keys=True, indent=1)

    @classmethod
    def from_json(cls, text: str, files: Mapping[str, bytes]) -> Study:
        """Return a study from the text of `to_json` and the contents of its files. Raises StudyError."""
        content = plain_json.loads(text, max_length=input_file.MAX_TEXT)
        if content.pop("version", None) != VERSION:
            raise StudyError(f"the study's version is not {VERSION}; use the package version that wrote it")
        content["parameters"] = _tuples(content["parameters"])
        content["files"] = dict(files)
        content["scripts"] = tuple(_script(entry) for entry in content["scripts"])
        content["policy"] = FunctionSource(**content["policy"]) if content["policy"] else None
        content["outcomes"] = tuple(FunctionSource(**entry) for entry in content["outcomes"])
        factors = [{**entry, "values": tuple(map(_tuple, entry["values"]))} for entry in content["factors"]]
        content["factors"] = tuple(Factor(**entry) for entry in factors)
        return cls(**content)

    def scene(self, values: Mapping[str, Any]) -> Scene:
        """Return the scene of a run, with factor values by name. Raises ParameterError if one is invalid.

        Args:
            values: values of the factors by name.

        Raises:
            ParameterError: if the values are invalid.
        """
        fabric = {name: value for name, value in values.items() if name == FABRIC}
        changed = with_changes(self.parameters, fabric, self.files)
        # Set entries of an array after the array.
        for name in sorted(values, key=lambda name: "[" in name):
            if name.partition(".")[0] in (TARGET, POLICY):
                continue
            entry = _ENTRY.fullmatch(name)
            if entry is None:
                changed[name] = values[name]
                continue
            array, index = entry.group(1), int(entry.group(2))
            before = changed.get(array)
            if not isinstance(before, tuple | list) or index >= len(before):
                problem = "is no array"
                if isinstance(before, tuple | list):
                    problem = f"has the entries 0 to {len(before) - 1}"
                raise ParameterError(f"unknown parameter '{name}': {array} {problem}")
            changed[array] = (*before[:index], values[name], *before[index + 1 :])
        return Scene.from_parameters(changed, files=self.files)

    def moved_scripts(self, values: Mapping[str, Any]) -> list[GripperScript]:
        """Return the gripper scripts of a run, with positions displaced by the factors `target.*` [m]."""
        scripts = list(self.scripts)
        for name, value in values.items():
            if name.partition(".")[0] == TARGET:
                script_index, waypoint, axis = parse_target(name, self.scripts)
                scripts[script_index] = _move_script(scripts[script_index], waypoint, axis, value)
        return scripts

    def seed_of(self, run: int) -> int:
        """Return the 64-bit seed of a run's random numbers."""
        return int(np.random.SeedSequence([self.seed, run]).generate_state(1, np.uint64)[0])


def parse_target(name: str, scripts: Sequence[GripperScript]) -> tuple[int, int | None, int]:
    """Return indices of script, waypoint (None: all) and axis of ``target.<gripper>[.<number>].<axis>``.

    Raises:
        StudyError: if the name matches no target.
    """
    grippers = [script.gripper for script in scripts]
    parts = name.split(".")[1:]
    if len(parts) not in (2, 3) or parts[-1] not in _AXES:
        raise StudyError(f"vary: '{name}' is no target; give target.<gripper>.<x, y or z>, or target.<gripper>.<n>.<x>")
    if parts[0] not in grippers:
        known = ", ".join(grippers) or "none (a policy moves its grippers itself)"
        known += suggestion(parts[0], grippers)
        raise StudyError(f"vary: '{name}': no script is for a gripper '{parts[0]}'; scripts are for {known}")
    script_index = grippers.index(parts[0])
    if len(parts) == 2:
        return script_index, None, _AXES.index(parts[-1])
    count = len(scripts[script_index].waypoints)
    if not parts[1].isdecimal() or not 1 <= int(parts[1]) <= count:
        raise StudyError(f"vary: '{name}': the script of '{parts[0]}' has the positions 1 to {count}")
    return script_index, int(parts[1]) - 1, _AXES.index(parts[-1])


def _move_script(script: GripperScript, waypoint_index: int | None, axis: int, offset: float) -> GripperScript:
    waypoints = list(script.waypoints)
    for index, waypoint in enumerate(waypoints):
        if waypoint_index in (None, index):
            position = tuple(p + offset if k == axis else p for k, p in enumerate(waypoint.position))
            waypoints[index] = attrs.evolve(waypoint, position=position)
    return attrs.evolve(script, waypoints=tuple(waypoints))


def _script(content: dict[str, Any]) -> GripperScript:
    from cloth_sim_ros.simulation.gripper_script import TimedGrasp, Waypoint

    waypoints = tuple(
        Waypoint(time=entry["time"], position=tuple(entry["position"]), orientation=tuple(entry["orientation"]))
        for entry in content["waypoints"]
    )
    grasps = tuple(TimedGrasp(**entry) for entry in content["grasps"])
    return GripperScript(**{**content, "waypoints": waypoints, "grasps": grasps})


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _tuple(value) for name, value in values.items()}
