# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robot description (URDF): links, joints and collision shapes."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import Any
from xml.etree import ElementTree

import attrs
import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.parameters.declare import ParameterError

#: Joints with one position: an angle [rad] or a displacement [m].
ROTATING, SLIDING = ("revolute", "continuous"), ("prismatic",)
#: Joints of more degrees of freedom, which joint states cannot give.
UNSUPPORTED = ("floating", "planar")
_KINDS = (*ROTATING, *SLIDING, *UNSUPPORTED, "fixed")
#: Largest length of a description [bytes].
MAX_BYTES = 64 << 20
#: Largest coordinate, size and factor [m, rad or 1], and the limit of a joint beyond which it counts as this one.
_MAX_NUMBER, _MAX_LIMIT = 1e4, 1e9


@attrs.frozen(kw_only=True)
class Mimic:
    """Dependence of a joint's position on another joint's: multiplier * position of the other + offset."""

    joint: str
    multiplier: float
    offset: float


@attrs.frozen(kw_only=True, eq=False)
class Joint:
    """Joint of a robot between two links: kind, origin, axis, limits, and the joint that it mimics."""

    name: str
    kind: str
    parent: str
    child: str
    #: Transform from the parent's frame to the joint's, shape (4, 4).
    origin: Array
    #: Unit vector in the joint's frame, shape (3,).
    axis: Array
    #: Limits of the position [rad or m].
    lower: float = -math.inf
    upper: float = math.inf
    mimic: Mimic | None = None

    @property
    def is_movable(self) -> bool:
        """True for a joint with one position: revolute, continuous or prismatic."""
        return self.kind in (*ROTATING, *SLIDING)


@attrs.frozen(kw_only=True, eq=False)
class CollisionShape:
    """One shape of a link's collision geometry: box, sphere, cylinder, capsule or mesh."""

    #: One of box, sphere, cylinder, capsule and mesh.
    shape: str
    #: Transform from the link's frame to the shape's, shape (4, 4).
    origin: Array
    #: Sizes [m] in the order of an obstacle's.
    size: tuple[float, ...] = ()
    #: File or URI of a mesh, and its factors to metres along its axes.
    mesh: str = ""
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)


@attrs.frozen(kw_only=True)
class RobotDescription:
    """A robot's links and joints. The joints form a tree; each one comes after those on which it depends."""

    root: str
    #: Collision shapes by link, for every link.
    shapes: dict[str, tuple[CollisionShape, ...]]
    joints: tuple[Joint, ...]


def parse(text: str | bytes) -> RobotDescription:
    """Parse the text of a URDF as links with collision shapes and a tree of joints; raise ParameterError if invalid.

    Raises:
        ParameterError: naming the element, the fault and the remedy.
    """
    if len(text) > MAX_BYTES:
        raise ParameterError(f"the robot's description has {len(text)} bytes; at most {MAX_BYTES} are read")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ParameterError(f"the robot's description is no XML: {error}; run xacro, and give its output") from error
    if root.tag != "robot":
        raise ParameterError(f"the robot's description begins with <{root.tag}>; a URDF begins with <robot>")
    if any("/xacro" in str(element.tag) for element in root.iter()):
        raise ParameterError("the robot's description holds xacro macros; run xacro, and give its output")
    shapes: dict[str, tuple[CollisionShape, ...]] = {}
    for link in root.findall("link"):
        name = _attribute(link, "name", "a link")
        if name in shapes:
            raise ParameterError(f"the robot's description has two links '{name}'; give each its own name")
        shapes[name] = tuple(_shape(collision, name) for collision in link.findall("collision"))
    joints = [_joint(element) for element in root.findall("joint")]
    if repeated := _first_duplicate([joint.name for joint in joints]):
        raise ParameterError(f"the robot's description has two joints '{repeated}'; give each its own name")
    return _ordered_robot(shapes, joints)


def transform(position: Sequence[float], rotation: Array) -> Array:
    """Build the homogeneous transform, shape (4, 4), of a position [m] and a rotation matrix (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def rotation_about(axis: Array, angle: float) -> Array:
    """Return the rotation matrix about a unit vector by an angle [rad], shape (3, 3)."""
    return np.eye(3) + math.sin(angle) * cross_matrix(axis) + (1.0 - math.cos(angle)) * _squared(cross_matrix(axis))


def cross_matrix(axis: Array) -> Array:
    """Return the matrix K with K v = axis x v, shape (3, 3)."""
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _squared(matrix: Array) -> Array:
    return matrix @ matrix


def _first_duplicate(names: Sequence[str]) -> str:
    """Return the alphabetically first name that occurs more than once; empty if none does."""
    return min((name for name, count in Counter(names).items() if count > 1), default="")


def _ordered_robot(shapes: dict[str, tuple[CollisionShape, ...]], joints: list[Joint]) -> RobotDescription:
    """Build the robot with its joints ordered from the root; raise ParameterError unless they form a tree.

    Raises:
        ParameterError: unless the joints form a tree over all links, and mimicked joints exist.
    """
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in shapes:
                raise ParameterError(f"joint '{joint.name}' of the robot names the link '{link}', which does not exist")
    if repeated := _first_duplicate([joint.child for joint in joints]):
        raise ParameterError(f"link '{repeated}' of the robot is the child of two joints; a robot is a tree")
    children = {joint.child for joint in joints}
    roots = [link for link in shapes if link not in children]
    if len(roots) != 1:
        raise ParameterError(
            f"the robot's description has {len(roots)} links without a parent ({', '.join(roots[:5]) or 'none'}); a "
            "robot is a tree with one root: connect them by joints"
        )
    of_parents = defaultdict[str, list[Joint]](list)
    for joint in joints:
        of_parents[joint.parent].append(joint)
    ordered: list[Joint] = []
    waiting = [roots[0]]
    while waiting:
        new = of_parents.get(waiting.pop(), [])
        ordered += new
        waiting += [joint.child for joint in new]
    if len(ordered) != len(joints):
        known = {joint.name for joint in ordered}
        missing = next(joint.name for joint in joints if joint.name not in known)
        raise ParameterError(f"joint '{missing}' of the robot is part of a circle of links; a robot is a tree")
    movable = {joint.name: joint for joint in joints if joint.is_movable}
    checked: set[str] = set()
    for joint in joints:
        seen, current = {joint.name}, joint
        while current.mimic is not None and current.name not in checked:
            if current.mimic.joint not in movable:
                raise ParameterError(f"joint '{current.name}' mimics '{current.mimic.joint}', which is no joint")
            current = movable[current.mimic.joint]
            if current.name in seen:
                raise ParameterError(f"joint '{current.name}' mimics itself; remove a <mimic>")
            seen.add(current.name)
        checked |= seen
    return RobotDescription(root=roots[0], shapes=shapes, joints=tuple(ordered))


def _joint(element: ElementTree.Element) -> Joint:
    name = _attribute(element, "name", "a joint")
    subject = f"joint '{name}'"
    kind = _attribute(element, "type", subject)
    if kind not in _KINDS:
        raise ParameterError(f"{subject} of the robot has type '{kind}'; it must be one of {', '.join(_KINDS)}")
    axis = np.array(_numbers(element.find("axis"), "xyz", (1.0, 0.0, 0.0), subject))
    length = math.sqrt(float(axis @ axis))
    if kind in (*ROTATING, *SLIDING) and not length > 0.0:
        raise ParameterError(f"{subject} of the robot has the axis {axis.tolist()}; it must not be 0")
    lower, upper, limit = -math.inf, math.inf, element.find("limit")
    if kind in ("revolute", "prismatic") and limit is not None:
        ends = (_numbers(limit, bound, (0.0,), subject, max_number=math.inf)[0] for bound in ("lower", "upper"))
        lower, upper = (min(max(end, -_MAX_LIMIT), _MAX_LIMIT) for end in ends)
        if lower > upper:
            raise ParameterError(f"{subject} of the robot has the limits {lower:g} to {upper:g}; exchange them")
    mimic, mimicked = None, element.find("mimic")
    if mimicked is not None and kind in (*ROTATING, *SLIDING):
        mimic = Mimic(
            joint=_attribute(mimicked, "joint", f"<mimic> of {subject}"),
            multiplier=_numbers(mimicked, "multiplier", (1.0,), subject)[0],
            offset=_numbers(mimicked, "offset", (0.0,), subject)[0],
        )
    parent, child = (_attribute(element.find(tag), "link", f"<{tag}> of {subject}") for tag in ("parent", "child"))
    return Joint(
        name=name,
        kind=kind,
        parent=parent,
        child=child,
        origin=_origin(element, subject),
        axis=axis / length if length else axis,
        lower=lower,
        upper=upper,
        mimic=mimic,
    )


def _shape(collision: ElementTree.Element, link: str) -> CollisionShape:
    subject, origin = f"a collision of link '{link}'", _origin(collision, f"a collision of link '{link}'")
    geometry = collision.find("geometry")
    for element in () if geometry is None else geometry:
        if element.tag == "mesh":
            scale = _numbers(element, "scale", (1.0, 1.0, 1.0), subject)
            if 0.0 in scale:
                raise ParameterError(f"{subject} has a mesh of scale {list(scale)}; no entry may be 0")
            return CollisionShape(
                shape="mesh", origin=origin, mesh=_attribute(element, "filename", f"the mesh of {subject}"), scale=scale
            )
        if element.tag in _SIZES:
            size = tuple(
                entry for name, count in _SIZES[element.tag] for entry in _sizes(element, name, count, subject)
            )
            return CollisionShape(shape=str(element.tag), origin=origin, size=size)
    raise ParameterError(f"{subject} has no geometry that is known; give box, sphere, cylinder, capsule or mesh")


#: Attributes of the shapes with sizes, and the count of their numbers.
_SIZES = {
    "box": (("size", 3),),
    "sphere": (("radius", 1),),
    "cylinder": (("radius", 1), ("length", 1)),
    "capsule": (("radius", 1), ("length", 1)),
}


def _sizes(element: ElementTree.Element, name: str, count: int, subject: str) -> Iterator[float]:
    for entry in _numbers(element, name, (math.nan,) * count, subject):
        if not entry > 0.0:
            raise ParameterError(f"{subject} is a {element.tag} whose {name} is {entry:g} m; it must be above 0")
        yield entry


def _origin(element: ElementTree.Element, subject: str) -> Array:
    origin = element.find("origin")
    position = _numbers(origin, "xyz", (0.0, 0.0, 0.0), subject)
    roll, pitch, yaw = _numbers(origin, "rpy", (0.0, 0.0, 0.0), subject)
    x, y, z = np.eye(3)
    return transform(position, rotation_about(z, yaw) @ rotation_about(y, pitch) @ rotation_about(x, roll))


def _attribute(element: ElementTree.Element | None, name: str, subject: str) -> str:
    value = None if element is None else element.get(name)
    if not value:
        raise ParameterError(f"{subject} of the robot has no {name}; set it in the description")
    return value


def _numbers(
    element: Any, name: str, default: tuple[float, ...], subject: str, *, max_number: float = _MAX_NUMBER
) -> tuple[float, ...]:
    """Parse an XML attribute as many numbers as the default has; return the default if it is missing, or raise."""
    text = None if element is None else element.get(name)
    if text is None:
        return default
    try:
        numbers = tuple(map(float, text.split()))
    except ValueError:
        numbers = ()
    if len(numbers) != len(default) or not all(math.isfinite(a) and abs(a) <= max_number for a in numbers):
        most = "" if max_number == math.inf else f" of at most {max_number:g}"
        raise ParameterError(
            f"{subject} of the robot has {name} '{text[:80]}'; give {len(default)} finite numbers{most}"
        )
    return numbers
