# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth cameras of a scene: parameters and names. `cameras` names them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from cloth_sim_ros.physics.plan.gripper_path import normalized
from cloth_sim_ros.scene.camera_section import (
    MAX_MILLIMETRES_DEPTH,
    MAX_PIXELS,
    METRES,
    MILLIMETRES,
    MIN_FOCAL_LENGTH,
    CameraParameters,
)
from cloth_sim_ros.scene.obstacles import check_distinct
from cloth_sim_ros.scene.parameters import declare as parameters
from cloth_sim_ros.scene.parameters.declare import NAME, Faults, Parameter, ParameterError


def declarations(name: str) -> tuple[Parameter, ...]:
    """Return the declarations of all parameters of a camera, e.g. `wrist.width` for the name `wrist`."""
    return parameters.declarations(CameraParameters, f"{name}.")


def camera_names(values: Iterable[str], groups: Collection[str]) -> list[str]:
    """Return the valid names of cameras in the parameter `cameras`, each once; invalid ones are ignored.

    Args:
        values: parameters by full name; without values there are no cameras.
        groups: first parts of the names of all other parameters.
    """
    listed = values.get("cameras", ()) if isinstance(values, Mapping) else ()
    names = listed if isinstance(listed, Sequence) and not isinstance(listed, str | bytes) else ()
    valid = [name for name in names if isinstance(name, str) and NAME.fullmatch(name) and name not in groups]
    return list(dict.fromkeys(valid))


def hint(name: str, groups: Collection[str]) -> str:
    """Return advice to name a camera, a sentence for the message on an unknown parameter; empty if unfitting."""
    camera, _, leaf = name.rpartition(".")
    leaves = [entry.name.rpartition(".")[2] for entry in declarations("c")]
    is_camera = leaf in leaves and NAME.fullmatch(camera) and camera not in groups
    return f" If '{camera}' is to be a camera, name it in cameras" if is_camera else ""


def build_cameras(values: Mapping[str, Any], names: Iterable[str]) -> dict[str, CameraParameters]:
    """Build the `CameraParameters` of each named camera from checked values by full name; unset ones take defaults."""
    return {name: parameters.build(CameraParameters, dict(values), f"{name}.") for name in names}


def check_cameras(
    names: Sequence[str],
    cameras: Mapping[str, CameraParameters],
    *,
    grippers: Collection[str],
    obstacles: Collection[str],
    groups: Collection[str],
) -> None:
    """Raise a single ParameterError on all invalid names and parameters of cameras; return nothing if all are valid.

    Args:
        names: names of the cameras.
        cameras: their parameters by name.
        grippers: names of the grippers.
        obstacles: names of the present and of the described obstacles.
        groups: first parts of the names of all other parameters.

    Raises:
        ParameterError: naming the camera or the parameter.
    """
    faults = Faults()
    faults.collect(lambda: check_distinct("camera", names))
    for name in dict.fromkeys(names):
        if name in groups:
            faults.add([f"a camera is named '{name}', as parameters are; give it another name"])
        for kind, reserved in (("gripper", grippers), ("obstacle", obstacles)):
            if name in reserved:
                faults.add([f"'{name}' names a camera and {_article(kind)}; give the camera another name"])
    for name, camera in cameras.items():
        faults.add(_faults(name, camera))
    faults.refuse()


def _article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def _faults(name: str, camera: CameraParameters) -> Iterator[str]:
    if camera.width * camera.height > MAX_PIXELS:
        yield (
            f"{name}.width x {name}.height is {camera.width * camera.height} pixels; an image has at most {MAX_PIXELS}"
        )
    fx, fy, _, _ = camera.intrinsics
    if any(camera.intrinsics) and not min(fx, fy) >= MIN_FOCAL_LENGTH:
        yield (
            f"{name}.intrinsics is {list(camera.intrinsics)}; fx and fy, its first entries, must be at least "
            f"{MIN_FOCAL_LENGTH:g} pixels, or all entries 0.0 for {name}.fov"
        )
    if camera.min_depth >= camera.max_depth:
        yield (
            f"{name}.min_depth is {camera.min_depth:g} m and {name}.max_depth {camera.max_depth:g} m; the first must "
            "be below the second"
        )
    if camera.encoding == MILLIMETRES and camera.max_depth > MAX_MILLIMETRES_DEPTH:
        yield (
            f"{name}.max_depth is {camera.max_depth:g} m; {MILLIMETRES} holds at most {MAX_MILLIMETRES_DEPTH} m: lower "
            f"it, or set {name}.encoding to {METRES}"
        )
    try:
        normalized(camera.orientation)
    except ValueError as error:
        yield f"{name}.orientation: {error}"


def check_change(name: str, before: CameraParameters, now: CameraParameters) -> None:
    """Raise ParameterError if a camera's parameters `before` and `now` differ in one that can be set at start only.

    Raises:
        ParameterError: naming the parameter.
    """
    old, new = parameters.flatten(before), parameters.flatten(now)
    for entry in parameters.declarations(CameraParameters):
        if not entry.live and old[entry.name] != new[entry.name]:
            raise ParameterError(parameters.read_only_message(f"{name}.{entry.name}"))


def optical_frame(node: str, camera: str) -> str:
    """Return the frame_id of a camera that follows no TF frame: `<node's full name>/<camera>_optical_frame`."""
    return f"{node.strip('/')}/{camera}_optical_frame"


def camera_pose(camera: CameraParameters) -> tuple[float, ...]:
    """Return position [m] and unit quaternion x, y, z, w in the scene's `frame_id`, as a camera's parameters set."""
    return (*camera.position, *normalized(camera.orientation).tolist())


def optical_frames(node: str, cameras: Mapping[str, CameraParameters]) -> list[tuple[str, Sequence[float]]]:
    """Return (frame_id, pose of 7 numbers) of the optical frame of each camera that follows no TF frame."""
    return [(optical_frame(node, name), camera_pose(camera)) for name, camera in cameras.items() if not camera.frame]
