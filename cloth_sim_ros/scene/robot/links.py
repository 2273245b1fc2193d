# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Links of a robot as obstacles of a scene.

A collision shape becomes an obstacle whose parameter `<obstacle>.link` names its link.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene import files as scene_files
from cloth_sim_ros.scene.parameters.declare import NAME, ParameterError
from cloth_sim_ros.scene.parameters.unknown_parameters import suggestion
from cloth_sim_ros.scene.physics_scene import PhysicsScene
from cloth_sim_ros.scene.robot import collision_meshes
from cloth_sim_ros.scene.robot.description import CollisionShape, RobotDescription, parse, transform
from cloth_sim_ros.scene.robot.kinematics import Kinematics, poses_of, transform_of
from cloth_sim_ros.scene.robot_section import TF, RobotParameters

#: End of the names of the parameters that name an obstacle's link.
LINK_SUFFIX = ".link"
#: A cloth that hangs by an edge swings within this many of its largest extents about its centre.
_SWING_EXTENTS = 1.5
#: Largest number of collision shapes.
_MAX_SHAPES = 2000


class RobotScene(PhysicsScene, Protocol):
    """Protocol of a `Scene` beside a robot: the parts on which the obstacles of the links depend."""

    @property
    def robot(self) -> RobotParameters: ...

    @property
    def cameras(self) -> tuple[str, ...]: ...

    @property
    def groups(self) -> Callable[[], frozenset[str]]: ...

    def anchored_particles(self) -> list[int]: ...

    @classmethod
    def from_parameters(cls, values: dict[str, Any], *, files: Mapping[str, bytes] | None = None) -> Self: ...


S = TypeVar("S", bound=RobotScene)


@attrs.frozen(kw_only=True, eq=False)
class _LinkObstacle:
    """Obstacle of a link's shape that has no name yet: parameters, bounding radius, and transform in the link."""

    link: str
    values: dict[str, Any]
    #: Transform from the link's frame to the obstacle's, shape (4, 4).
    origin: Array
    #: Radius of a sphere about the obstacle's origin that contains it [m].
    radius: float
    #: Vertices [m] and triangles of a mesh.
    mesh: tuple[Any, Any] | None = None


class RobotLinks:
    """Converter of a robot's joint positions to the poses of the obstacles of its links.

    Args:
        description: the robot.
        settings: its parameters.
        obstacles: name, link and transform from the link's frame to the obstacle's, for each obstacle.
        notes: sentences for the log.
    """

    def __init__(
        self,
        description: RobotDescription,
        settings: RobotParameters,
        obstacles: Sequence[tuple[str, str, Array]],
        notes: Sequence[str],
    ) -> None:
        self.kinematics, self.settings, self.notes = Kinematics(description), settings, tuple(notes)
        #: Names of the obstacles, and their links in the same order.
        self.names = tuple(name for name, _, _ in obstacles)
        self.links = tuple(link for _, link, _ in obstacles)
        self._origins = np.array([origin for _, _, origin in obstacles]).reshape(-1, 4, 4)
        placements = [self.kinematics.placements[link] for link in self.links]
        self._bodies = np.array([body for body, _ in placements], dtype=np.int64)
        transforms = [placement @ origin for (_, placement), origin in zip(placements, self._origins, strict=True)]
        self._placements = np.array(transforms).reshape(-1, 4, 4)
        self.mount = transform_of(settings.position, settings.orientation)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of which `poses` needs positions; joints that mimic others follow."""
        return self.kinematics.joint_names

    def poses(self, positions: Mapping[str, float] | Array, base: Array | None = None) -> Array:
        """Return the obstacles' poses in the scene's frame at joint positions: position [m] and quaternion, (count, 7).

        Args:
            positions: positions of joints [rad or m], by name or in the order of `joint_names`. A missing one is 0, or
                the limit that is nearest to 0.
            base: transform of `robot.frame` in the scene's frame, shape (4, 4); by default they agree.
        """
        values = self.kinematics.joint_positions(positions) if isinstance(positions, Mapping) else positions
        bodies = self.kinematics.body_transforms(values, self._root(base))
        return poses_of(bodies[self._bodies] @ self._placements)

    def poses_from_links(self, transforms: Mapping[str, Array]) -> Array:
        """Return the poses of the obstacles, shape (count, 7), from transforms (4, 4) of all their links by name."""
        of_links = np.array([transforms[link] for link in self.links]).reshape(-1, 4, 4)
        return poses_of(of_links @ self._origins)

    def link_pose(self, link: str, positions: Array, base: Array | None = None) -> Array:
        """Return a link's pose in the scene's frame at joint positions, (7,): position [m], quaternion x, y, z, w."""
        body, placement = self.kinematics.placements[link]
        bodies = self.kinematics.body_transforms(positions, self._root(base))
        pose: Array = poses_of((bodies[body] @ placement)[None])[0]
        return pose

    def _root(self, base: Array | None) -> Array:
        return self.mount if base is None else base @ self.mount


def add_links(
    scene: RobotScene, values: Mapping[str, Any], description: str | bytes, *, folder: str | Path = "."
) -> tuple[dict[str, Any], dict[str, bytes], RobotLinks]:
    """Return parameters with a robot's links as obstacles, contents of files, and `RobotLinks`; read meshes, or raise.

    The obstacles are at the poses of joints at 0; `RobotLinks.poses` and `with_poses` place them elsewhere.

    Args:
        scene: the scene without links.
        values: its parameters by full name; those of links that an earlier call added are replaced.
        description: the robot's description (URDF).
        folder: base of relative names of mesh files.

    Returns:
        Parameters by full name, contents of the files that they name, and the links.

    Raises:
        ParameterError: for an invalid description, or a mesh that can't be read; naming the remedy.
    """
    base_values = without_links(values)
    robot = parse(description)
    kinematics = Kinematics(robot)
    links, notes = _selected_links(scene, robot, kinematics)
    candidates: list[_LinkObstacle] = []
    if (count := sum(len(robot.shapes[link]) for link in links)) > _MAX_SHAPES:
        raise ParameterError(
            f"the robot has {count} collision shapes, and at most {_MAX_SHAPES} become obstacles; name fewer links in "
            "robot.links"
        )
    for link in links:
        for shape in robot.shapes[link]:
            candidates += _obstacles_of(scene.robot, link, shape, Path(folder), notes)
    if scene.robot.links == ("",):
        candidates = _within_reach(scene, candidates, kinematics, notes)
    used = {*scene.gripper_names, *scene.cameras, *scene.described, *scene.groups()}
    added: dict[str, Any] = {}
    contents = dict(scene.files)
    obstacles = []
    for candidate, name in zip(candidates, _obstacle_names([entry.link for entry in candidates], used), strict=True):
        entries = {**candidate.values, "link": candidate.link, "friction": _friction(scene, candidate.link)}
        if candidate.mesh is not None:
            entries["mesh"] = _file_name(name, contents)
            contents[entries["mesh"]] = collision_meshes.obj_bytes(*candidate.mesh)
        added |= {f"{name}.{leaf}": value for leaf, value in entries.items()}
        obstacles.append((name, candidate.link, candidate.origin))
    result = RobotLinks(robot, scene.robot, obstacles, notes)
    names = [*scene.obstacle_names, *result.names]
    extended = {**base_values, **added, "obstacles": tuple(names) or ("",)}
    return with_poses(extended, result, result.poses({})), contents, result


def with_poses(values: Mapping[str, Any], links: RobotLinks, poses: Array) -> dict[str, Any]:
    """Return a copy of a scene's parameters with the links' obstacles at poses (count, 7)."""
    placed = dict(values)
    for name, pose in zip(links.names, poses.tolist(), strict=True):
        placed[f"{name}.position"], placed[f"{name}.orientation"] = tuple(pose[:3]), tuple(pose[3:])
    return placed


def scene_with_links(scene: S, values: Mapping[str, Any], *, folder: str | Path = ".") -> tuple[S, RobotLinks]:
    """Build a scene with the links in `robot.description_file` as obstacles; read its files; return it and the links.

    Args:
        scene: the scene without links.
        values: its parameters by full name, as for `add_links`.
        folder: base of the relative name of the description.

    Raises:
        ParameterError: as `add_links`, or if the description can't be read.
    """
    name = str(values.get("robot.description_file", ""))
    description = read_description(name, folder)
    extended, contents, links = add_links(scene, values, description, folder=Path(folder, name).parent)
    return type(scene).from_parameters(extended, files=contents), links


def read_description(name: str, folder: str | Path = ".") -> bytes:
    """Read the bytes of the URDF file `name`, the value of `robot.description_file`; raise ParameterError.

    Raises:
        ParameterError: if no file is named, or it can't be read.
    """
    if not name:
        raise ParameterError("robot.enabled is set without robot.description_file; name the file of the URDF")
    return scene_files.file_content("robot.description_file", Path(folder) / name)


def mesh_files(name: str, folder: str | Path = ".") -> list[Path]:
    """Return the paths of the meshes in the file of a robot's description (URDF), of those that are found.

    Raises:
        ParameterError: if the description can't be read.
    """
    shapes = parse(read_description(name, folder)).shapes.values()
    meshes = (shape.mesh for of_link in shapes for shape in of_link if shape.mesh)
    paths = []
    for mesh in dict.fromkeys(meshes):
        # A mesh of a link that is left out may be missing.
        with suppress(ParameterError):
            paths.append(collision_meshes.find_file(mesh, Path(folder, name).parent))
    return paths


def without_links(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of a scene's parameters without the obstacles that are links of a robot."""
    names = {name.removesuffix(LINK_SUFFIX) for name, value in values.items() if name.endswith(LINK_SUFFIX) and value}
    remaining = {name: value for name, value in values.items() if name.rpartition(".")[0] not in names}
    if names and "obstacles" in remaining:
        remaining["obstacles"] = tuple(name for name in values["obstacles"] if name not in names) or ("",)
    return remaining


def _selected_links(scene: RobotScene, robot: RobotDescription, kinematics: Kinematics) -> tuple[list[str], list[str]]:
    """Return the links whose collision shapes may become obstacles, and log sentences; raise for an invalid name."""
    with_shapes = [link for link, shapes in robot.shapes.items() if shapes]
    pads = [name for name in scene.robot.pads if name]
    named = [name for name in scene.robot.links if name]
    for parameter, names in (("robot.links", named), ("robot.pads", pads)):
        for name in names:
            if name not in robot.shapes:
                raise ParameterError(
                    f"{parameter} names '{name}', which is no link of the robot{suggestion(name, list(robot.shapes))}"
                )
            if name not in with_shapes:
                raise ParameterError(
                    f"{parameter} names '{name}', and this link has no collision geometry; take it out"
                )
    unsupported = [joint.name for joint in robot.joints if not joint.is_movable and joint.kind != "fixed"]
    notes = [f"joint '{name}' of the robot has several degrees of freedom: it stays at 0" for name in unsupported]
    if not with_shapes:
        notes.append("the robot's description has no collision geometry: no link is an obstacle")
    chosen = {*named, *pads} if named else set(with_shapes)
    return [link for link in with_shapes if link in chosen], notes


def _obstacles_of(
    settings: RobotParameters, link: str, shape: CollisionShape, folder: Path, notes: list[str]
) -> Iterable[_LinkObstacle]:
    if shape.shape != "mesh":
        from cloth_sim_ros.physics.contact.obstacles import Obstacle

        radius = Obstacle(name=link, shape=shape.shape, size=shape.size).bounding_radius
        values = {"shape": shape.shape, "size": shape.size}
        return [_LinkObstacle(link=link, values=values, origin=shape.origin, radius=radius)]
    mesh = collision_meshes.load(shape.mesh, shape.scale, folder)
    if mesh.note:
        notes.append(f"link '{link}': {mesh.note}")
    obstacles = []
    for vertices, triangles in mesh.parts:
        # The bounding sphere, which decides if an obstacle is far, is smallest about the middle.
        centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        centred = vertices - centre
        obstacles.append(
            _LinkObstacle(
                link=link,
                values={"shape": "mesh"},
                origin=shape.origin @ transform(centre, np.eye(3)),
                radius=math.sqrt(float((centred * centred).sum(axis=1).max())),
                mesh=(centred, triangles),
            )
        )
    return obstacles


def _within_reach(
    scene: RobotScene, candidates: list[_LinkObstacle], kinematics: Kinematics, notes: list[str]
) -> list[_LinkObstacle]:
    """Return the obstacles that can come within reach of the cloth; add a sentence on the others to `notes`.

    An anchored cloth is within a ball about its initial centre, unless a gripper or a pad carries it. A robot that
    reaches that ball can carry cloth as far as its furthest link. All links that come there are then kept.
    """
    if scene.robot.frame or scene.robot.source == TF or not len(scene.anchored_particles()):
        # Only TF knows the place of the robot, or nothing keeps the cloth in place.
        return candidates
    positions = scene.initial_positions()
    lower, upper = positions.min(axis=0), positions.max(axis=0)
    centre, extent = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
    mount = transform_of(scene.robot.position, scene.robot.orientation)
    balls = []
    for candidate in candidates:
        body, placement = kinematics.placements[candidate.link]
        centre_of_shape = (placement @ candidate.origin)[:3, 3]
        ball = kinematics.bounding_ball(body, math.sqrt(float(centre_of_shape @ centre_of_shape)) + candidate.radius)
        middle, radius = ball if body else (centre_of_shape, candidate.radius)
        balls.append((mount[:3, :3] @ middle + mount[:3, 3], radius))
    zones = [(centre, _SWING_EXTENTS * extent)]
    if scene.gripper_names or any(scene.robot.pads):
        zones += [(middle, radius + extent) for middle, radius in balls if _touches((middle, radius), zones[0])]
    is_near = [any(_touches(ball, zone) for zone in zones) for ball in balls]
    left_out = sorted({entry.link for k, entry in enumerate(candidates) if not is_near[k]})
    if left_out:
        notes.append(
            f"links that cannot reach the cloth are no obstacles: {', '.join(left_out)}; name links in robot.links to "
            "keep them"
        )
    return [entry for k, entry in enumerate(candidates) if is_near[k]]


def _touches(ball: tuple[Array, float], zone: tuple[Array, float]) -> bool:
    offset = ball[0] - zone[0]
    return math.sqrt(float(offset @ offset)) <= ball[1] + zone[1]


def _file_name(name: str, used: Collection[str]) -> str:
    """Return an unused name for the file of an obstacle's mesh."""
    file_name, count = f"{name}.obj", 0
    while file_name in used:
        file_name, count = f"{name}_{count}.obj", count + 1
    return file_name


def _friction(scene: RobotScene, link: str) -> tuple[float, ...]:
    """Return the coefficients of friction of a link, by its name: those of the gripper for a pad."""
    return scene.gripper.friction if link in scene.robot.pads else scene.robot.friction


def _obstacle_names(links: Sequence[str], used: Collection[str]) -> list[str]:
    """Return an unused name, valid in ROS, for the obstacle of each link."""
    names, counts, used = list[str](), Counter(links), set(used)
    for link in links:
        plain = re.sub(r"\W", "_", link, flags=re.ASCII)
        stem = plain if NAME.fullmatch(plain) else f"link_{plain}"
        name, count = stem, 0
        if counts[link] > 1 or name in used:
            name, count = f"{stem}_0", 0
            while name in used:
                count += 1
                name = f"{stem}_{count}"
        used.add(name)
        names.append(name)
    return names
