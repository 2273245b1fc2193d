# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reader and checks of a study's YAML file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cloth_sim_ros.scene import files as scene_files
from cloth_sim_ros.scene import input_file
from cloth_sim_ros.scene.config_files import config_file
from cloth_sim_ros.scene.parameters import parameter_file, ros_yaml
from cloth_sim_ros.scene.parameters.declare import ParameterError
from cloth_sim_ros.scene.parameters.unknown_parameters import is_ros_parameter, suggestion
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.gripper_script import GripperScript, ScriptError
from cloth_sim_ros.studies import factors as factor_kinds
from cloth_sim_ros.studies.errors import StudyError
from cloth_sim_ros.studies.factors import Factor
from cloth_sim_ros.studies.sampling import SAMPLINGS, grid_size
from cloth_sim_ros.studies.study import POLICY, TARGET, Study, parse_target
from cloth_sim_ros.studies.user_code import FunctionSource, load_function, read_source

#: Entries of a study, with descriptions.
ENTRIES = {
    "scene": "a ROS parameter file, in the study's folder or in config/",
    "parameters": "parameters by full name, which replace the scene's",
    "scripts": "scripted grasps, as cloth_gripper plays them, one for each gripper",
    "policy": "file.py:name or module:name, called each frame instead of scripts",
    "duration": "simulated time of a run [s]; by default that of the longest script, its last grasp included",
    "vary": "factors by name: a list of values or a distribution",
    "runs": "number of runs; by default all combinations of a grid",
    "seed": "a whole number, by default 0",
    "sampling": ", ".join(SAMPLINGS),
    "clouds": "true if sessions hold the clouds, false for the data of a rerun alone",
    "outcomes": "outcome functions, file.py:name or module:name",
}
#: Longest duration of a run [s].
_MAX_DURATION = 1e6


def read(path: str | Path) -> Study:
    """Return the checked study of a YAML file; imports the user's functions. Raises StudyError.

    Raises:
        StudyError: if the file is invalid; the text names file, entry and problem.
    """
    import yaml

    path = Path(path)
    try:
        content = ros_yaml.load(input_file.read_text(path))
    except (OSError, yaml.YAMLError, ValueError) as error:
        raise StudyError(f"cannot read the study '{path}': {error}") from error
    try:
        return from_dict(content, folder=path.parent)
    except (StudyError, ParameterError, ScriptError) as error:
        raise StudyError(f"{path}: {error}") from error


def from_dict(content: Any, *, folder: Path) -> Study:
    """Return the checked study of a YAML file's content; imports the user's functions. Raises ValueError.

    Args:
        content: the content.
        folder: folder of relative file names.

    Raises:
        ValueError: if an entry is invalid (StudyError, ParameterError or ScriptError).
    """
    if not isinstance(content, Mapping):
        raise StudyError(f"the study is {str(content)[:40]!r}; it must have entries {', '.join(ENTRIES)}")
    for name in content:
        if name not in ENTRIES:
            hint = suggestion(str(name), ENTRIES)
            raise StudyError(f"there is no entry '{name}'{hint}; a study has {', '.join(ENTRIES)}")
    if "scene" not in content:
        raise StudyError(f"'scene' is missing: {ENTRIES['scene']}")
    scene_path = _find_file(str(content["scene"]), "scene", folder)
    contents = parameter_file.read(scene_path, strict=True)
    parameters = {name: value for name, value in contents.items() if not is_ros_parameter(name)}
    parameters.update(_flatten(content.get("parameters", {}), "parameters"))
    factors = tuple(factor_kinds.read(str(name), entry) for name, entry in _vary(content).items())
    files = _files(parameters, factors, (folder, scene_path.parent))
    scene = Scene.from_parameters(parameters, files=files)
    scripts = _scripts(content.get("scripts"), scene, folder)
    policy = _policy(content.get("policy"), scripts, folder)
    sampling = _parse_choice(content.get("sampling", "sobol"), "sampling", SAMPLINGS)
    study = Study(
        parameters=scene.parameters(),
        files=files,
        scripts=scripts,
        policy=policy,
        outcomes=_outcomes(content.get("outcomes"), folder),
        duration=_duration(content.get("duration"), scripts, scene),
        factors=factors,
        runs=_runs(content.get("runs"), factors, sampling),
        seed=_parse_integer(content.get("seed", 0), "seed", minimum=0, maximum=2**63 - 1),
        sampling=sampling,
        clouds=_parse_bool(content.get("clouds", True), "clouds"),
    )
    _check_factors(study)
    return study


def _find_file(name: str, entry: str, folder: Path) -> Path:
    if (folder / name).is_file():
        return folder / name
    try:
        return config_file(name)
    except FileNotFoundError as error:
        raise StudyError(f"{entry} '{name}' is neither {folder / name} nor in config/: {error}") from None


def _flatten(tree: Any, entry: str, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, Mapping):
        raise StudyError(f"{entry} is {tree!r}; it must hold parameters by name")
    values: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            values.update(_flatten(value, entry, f"{prefix}{key}."))
        else:
            values[f"{prefix}{key}"] = value
    return values


def _vary(content: Mapping[str, Any]) -> Mapping[str, Any]:
    vary = content.get("vary", {})
    if not isinstance(vary, Mapping):
        raise StudyError(f"vary is {vary!r}; it must hold a list or a distribution for each name")
    return vary


def _files(parameters: Mapping[str, Any], factors: Sequence[Factor], folders: Sequence[Path]) -> dict[str, bytes]:
    """Return the contents by name of all files that parameters and factors name, from the first folder with each."""
    entries: list[dict[str, Any]] = [{name: value} for name, value in parameters.items()]
    entries += [{factor.name: value} for factor in factors if factor.kind == "choices" for value in factor.values]
    contents: dict[str, bytes] = {}
    for entry in entries:
        ((_, name),) = entry.items()
        base = folders[0]
        if isinstance(name, str) and name and "\0" not in name:
            base = next((folder for folder in folders if (folder / name).is_file()), folders[0])
        contents.update(scene_files.read(entry, contents, base))
    return contents


def _scripts(value: Any, scene: Scene, folder: Path) -> tuple[GripperScript, ...]:
    names = [value] if isinstance(value, str) else value or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise StudyError(f"scripts is {value!r}; it must be a list of files")
    scripts = tuple(GripperScript.from_file(_find_file(name, "script", folder)) for name in names)
    grippers = [script.gripper for script in scripts]
    for script, name in zip(scripts, names, strict=True):
        if script.gripper not in scene.gripper_names:
            known = ", ".join(scene.gripper_names) or "none"
            raise StudyError(f"script '{name}' is for the gripper '{script.gripper}'; the scene has {known}")
        if grippers.count(script.gripper) > 1:
            raise StudyError(f"{grippers.count(script.gripper)} scripts are for the gripper '{script.gripper}'")
        if script.frame_id not in ("", scene.frame_id):
            frames = f"poses in '{script.frame_id}', the cloth is in '{scene.frame_id}'"
            raise StudyError(f"script '{name}' has {frames}; transform the poses, a study has no TF")
    return scripts


def _policy(reference: Any, scripts: Sequence[GripperScript], folder: Path) -> FunctionSource | None:
    if reference is None:
        return None
    if scripts:
        raise StudyError("a study has scripts or a policy, not both; a policy can play scripts itself")
    source = read_source(reference, "policy", folder)
    load_function(source, "policy")
    return source


def _outcomes(references: Any, folder: Path) -> tuple[FunctionSource, ...]:
    names = [references] if isinstance(references, str) else references or []
    if not isinstance(names, list):
        raise StudyError(f"outcomes is {references!r}; it must be a list of file.py:name or module:name")
    sources = tuple(read_source(name, "outcome", folder) for name in names)
    for source in sources:
        load_function(source, "outcome")
    return sources


def _duration(value: Any, scripts: Sequence[GripperScript], scene: Scene) -> float:
    if value is None:
        if not scripts:
            raise StudyError("'duration' is missing: a study without scripts needs it [s]")
        # A grasp takes effect in the first frame that starts at its time or later.
        grasps = [grasp for script in scripts for grasp in script.grasps]
        grasp_ends = [(math.ceil(grasp.time / scene.period - 1e-9) + 1) * scene.period for grasp in grasps]
        return max([*(script.duration for script in scripts), *grasp_ends])
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise StudyError(f"duration is {value!r}; it must be a number of seconds")
    if not scene.period <= value <= _MAX_DURATION:
        limits = f"from one frame ({scene.period:g} s) to {_MAX_DURATION:g} s"
        raise StudyError(f"duration is {value} s; it must be {limits}")
    return float(value)


def _runs(value: Any, factors: Sequence[Factor], sampling: str) -> int:
    size = grid_size(factors) if sampling == "grid" else None
    if value is None:
        if size is None:
            raise StudyError("'runs' is missing: the number of runs")
        return size
    runs = _parse_integer(value, "runs", minimum=1, maximum=2**63 - 1)
    if size is not None and runs != size:
        raise StudyError(f"runs is {runs}, the grid has {size} combinations; omit runs, or use another sampling")
    return runs


def _check_factors(study: Study) -> None:
    """Raise StudyError for unknown names of factors or invalid values; each factor is checked alone.

    Raises:
        StudyError: if a factor is invalid.
    """
    for factor in study.factors:
        first = factor.name.partition(".")[0]
        if first == TARGET:
            parse_target(factor.name, study.scripts)
            _check_numbers(factor)
        elif first == POLICY:
            if study.policy is None:
                raise StudyError(f"vary: '{factor.name}': there is no policy to receive it; give 'policy'")
        else:
            for value in factor.ends() or [factor.value(0.5)]:
                try:
                    study.scene({factor.name: value})
                except ParameterError as error:
                    raise StudyError(f"vary: '{factor.name}' at {value!r}: {error}") from error


def _check_numbers(factor: Factor) -> None:
    for value in factor.values:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise StudyError(f"vary: '{factor.name}' has {value!r}; a displacement must be a number [m]")


def _parse_choice(value: Any, entry: str, known: Sequence[str]) -> str:
    if value not in known:
        raise StudyError(f"{entry} is {value!r}; it must be one of {', '.join(known)}{suggestion(str(value), known)}")
    return str(value)


def _parse_bool(value: Any, entry: str) -> bool:
    if not isinstance(value, bool):
        raise StudyError(f"{entry} is {value!r}; it must be true or false")
    return value


def _parse_integer(value: Any, entry: str, *, minimum: int, maximum: int) -> int:
    # YAML reads 1e9 as a float; here it means a whole number.
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value <= maximum:
        raise StudyError(f"{entry} is {value!r}; it must be a whole number from {minimum} to {maximum}")
    return value
