# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters of a scene: declaration, descriptors and changes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.logging_service import LoggingService
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.parameter_service import ParameterService

from cloth_sim_ros.ros.check.node_refusals import check_values, empty_lists, refuse_long_names
from cloth_sim_ros.ros.check.unknown_overrides import unknown_sentences
from cloth_sim_ros.ros.io.qos_rules import Override, overridable
from cloth_sim_ros.ros.recording.initial_state import session_state
from cloth_sim_ros.ros.timing.sim_time import SIM_TIME, SimTimeNode, check_sim_time
from cloth_sim_ros.scene import frame_ids, gripper_parameters, obstacles
from cloth_sim_ros.scene.fabrics import fabric_parameters
from cloth_sim_ros.scene.mesh_notes import mesh_notes, silence_mesh_log
from cloth_sim_ros.scene.parameters.declare import Faults, Parameter, ParameterError, read_only_message
from cloth_sim_ros.scene.parameters.unknown_parameters import QOS_PREFIX, ROS_PARAMETERS, suggestion
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.scene.sheet_checks import raw_springs_defaults

_SCALARS = {"bool": "BOOL", "int": "INTEGER", "double": "DOUBLE", "string": "STRING"}
_TYPES = {kind: RosParameter.Type[name] for kind, name in _SCALARS.items()}
_TYPES |= {f"{kind}[]": RosParameter.Type[f"{name}_ARRAY"] for kind, name in _SCALARS.items()}


class UnknownParametersError(ParameterNotDeclaredException):
    """Error: parameters that do not exist were set; the message names similar ones."""

    def __init__(self, names: list[str], known: Sequence[str]) -> None:
        super().__init__(names)
        self._sentences = [f"there is no parameter '{name}'{suggestion(name, known)}" for name in names]

    def __str__(self) -> str:
        return "; ".join(self._sentences)


class SceneNode(SimTimeNode):
    """rclpy's node for a scene's parameters: its errors name the parameter; `serve` creates its services."""

    def __init__(
        self, name: str, *, start_parameter_services: bool = True, enable_logger_service: bool = True, **options: Any
    ) -> None:
        """Create rclpy's node with its parameter overrides declared, but without services.

        Raises:
            ParameterError: for an empty list, which has no type in ROS, or a use_sim_time that is not a bool.
        """
        self._serves_parameters, self._serves_log_levels = start_parameter_services, enable_logger_service
        super().__init__(
            name, start_parameter_services=False, automatically_declare_parameters_from_overrides=True, **options
        )
        #: True while parameters are being declared; callbacks for changes ignore these.
        self.declaring = False
        #: Declarations of the scene's parameters, by name.
        self.entries: dict[str, Parameter] = {}
        #: Returns values by name that replace or join those that are to be set; raises ValueError to refuse a change.
        self.complete: Callable[[Mapping[str, Any]], dict[str, Any]] = _no_values

    def serve(self) -> None:
        """Create rclpy's services for parameters and log levels, unless the options exclude them."""
        if self._serves_parameters:
            ParameterService(self)
        if self._serves_log_levels:
            LoggingService(self)

    def destroy_node(self) -> None:
        """Destroy rclpy's node, and clear its parameter callbacks so that their objects can be freed."""
        super().destroy_node()
        self.complete = _no_values
        self._pre_set_parameters_callbacks.clear()
        self._on_set_parameters_callbacks.clear()
        self._post_set_parameters_callbacks.clear()

    def declare_parameters(self, namespace: str, parameters: Iterable[Any], *arguments: Any, **options: Any) -> Any:
        """Declare parameters as rclpy does, but first raise one ParameterError for all invalid overrides, if any."""
        listed = list(parameters)
        overrides = {f"{namespace}.{entry[0]}".lstrip("."): entry[1] for entry in listed if len(entry) > 1}
        refused = Faults()
        refused.add(empty_lists([name for name, value in overrides.items() if value is None], overrides))
        if SIM_TIME in overrides and overrides[SIM_TIME] is not None:
            refused.collect(lambda: check_sim_time(overrides[SIM_TIME]))
        if refused:
            # Include the faults that `declare` would find, so that one start reports all of them.
            check_values(
                {name: value for name, value in overrides.items() if value is not None}, refused, convert=_plain
            )
        refused.refuse()
        return super().declare_parameters(namespace, listed, *arguments, **options)

    def set_parameters(self, parameter_list: list[RosParameter]) -> list[SetParametersResult]:
        """Set parameters one after another by `set_parameters_atomically`, as rclpy does; return the result of each.

        Raises:
            UnknownParametersError: names an unknown parameter; those before it stay set.
        """
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set parameters together or not at all; return the result as rclpy does, with the reason of a refusal.

        It differs in five ways. The error names the parameters that do not exist. Setting `<name>.shape` of a new
        obstacle first declares all parameters of that obstacle; the same holds for a parameter of a single gripper. A
        value at the excluded end of a range is refused with that end, while rclpy would name the next number. A
        parameter of the start is refused with that remedy. The values that `complete` returns are set too.

        Raises:
            UnknownParametersError: names each unknown parameter and the known one with the most similar spelling.
        """
        names = [entry.name for entry in parameter_list]
        described = [
            name
            for name in obstacles.described_obstacles(names, Scene.groups())
            if not self.has_parameter(f"{name}.shape")
        ]
        new = [entry for name in described for entry in obstacles.declarations(name)]
        grippers = self.get_parameter_or("grippers").value or ()
        for name in gripper_parameters.individual_names(names, Scene.groups(), described):
            if name.rpartition(".")[0] in grippers and not self.has_parameter(name):
                if not (entry := gripper_parameters.declaration(name)).live:
                    return SetParametersResult(successful=False, reason=read_only_message(name))
                new.append(entry)
        # A camera or a gripper of that name has some of them already. The scene's check refuses it.
        missing = {entry.name: entry for entry in new if not self.has_parameter(entry.name)}
        unknown = [name for name in names if name not in missing and not self.has_parameter(name)]
        if unknown:
            raise UnknownParametersError(unknown, self.list_parameters([], 0).names)
        for parameter in parameter_list:
            declared = self.entries.get(parameter.name)
            if declared is None:
                continue
            if not declared.live:
                return SetParametersResult(successful=False, reason=read_only_message(parameter.name))
            if declared.kind == "double" and declared.excludes_min and parameter.value == declared.min:
                refused = Faults()
                refused.collect(partial(declared.check, parameter.value))
                return SetParametersResult(successful=False, reason="; ".join(refused.sentences))
        try:
            joined = self.complete({parameter.name: parameter.value for parameter in parameter_list})
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        parameter_list = [
            *(parameter for parameter in parameter_list if parameter.name not in joined),
            *(RosParameter(name, value=_listed(value)) for name, value in joined.items()),
        ]
        self.declaring = True
        try:
            for entry in missing.values():
                declare_entry(self, entry, entry.default)
        finally:
            self.declaring = False
        result = super().set_parameters_atomically(parameter_list)
        if not result.successful:
            for name in missing:
                self.undeclare_parameter(name)
        return result


#: Function of a scene's parameters and of contents of files that returns extended ones.
Extension = Callable[[Mapping[str, Any], Mapping[str, bytes]], tuple[dict[str, Any], dict[str, bytes]]]


def declare(node: Node, *, extend: Extension | None = None) -> Scene:
    """Declare all parameters of a scene on a node, with the values of its overrides; return the scene; log warnings.

    Args:
        node: the node.
        extend: adds parameters that follow from others; None for none.

    Raises:
        ParameterError: if the values form no valid scene; the message names the parameters and the reasons.
    """
    overrides = {name: node.get_parameter(name).value for name in node.list_parameters([], 0).names}
    refused = Faults()
    # The override was declared with any type; the check here gives a message with the remedy.
    values = check_values(overrides, refused, convert=_plain)
    refused.refuse()
    for name in values:
        node.undeclare_parameter(name)
    silence_mesh_log()
    files = session_state(str(values.get("initial_state", "")))
    if extend is not None:
        values, files = extend(values, files)
    scene = Scene.from_parameters(values, files=files)
    refuse_long_names(scene, node=node.get_fully_qualified_name())
    known = Scene.declared_for(values)
    defaults = {**fabric_parameters(values, scene.files)[0], **raw_springs_defaults(values)}
    for entry in known:
        declare_entry(node, entry, {entry.name: entry.default, **defaults, **values}[entry.name])
    _warn_of_unknown(node, scene, [entry.name for entry in known])
    notes, warnings = mesh_notes(scene)
    for sentence in notes:
        node.get_logger().info(sentence)
    for sentence in [*warnings, *ineffective_parameters(scene, values)]:
        node.get_logger().warning(sentence)
    return scene


def declare_entry(node: Node, entry: Parameter, value: Any) -> None:
    """Declare one parameter of a scene on a node with a value; overrides are ignored."""
    typed = RosParameter(entry.name, _TYPES[entry.kind], _listed(value)).value
    if isinstance(node, SceneNode):
        node.entries[entry.name] = entry
    node.declare_parameter(entry.name, typed, parameter_descriptor(entry), True)


def parameter_descriptor(entry: Parameter) -> ParameterDescriptor:
    """Return the ROS descriptor of a parameter; `additional_constraints` holds the limits that have no field."""
    constraints = []
    descriptor = ParameterDescriptor(
        name=entry.name, type=_TYPES[entry.kind].value, description=entry.description, read_only=not entry.live
    )
    if entry.unit:
        descriptor.description += f" [{entry.unit}]"
    if entry.choices:
        constraints.append("one of " + ", ".join(entry.choices))
    if entry.length is not None:
        constraints.append(f"{entry.length} entries")
    limited = entry.min is not None or entry.max is not None
    if limited and entry.kind == "double":
        descriptor.floating_point_range = [FloatingPointRange(**_limits(entry, sys.float_info.max, float))]
    elif limited and entry.kind == "int":
        descriptor.integer_range = [IntegerRange(**_limits(entry, 2**63 - 1, int))]
    elif limited:
        prefix = "each " if entry.is_array else ""
        low = f"above {entry.min} and at most" if entry.excludes_min else f"from {entry.min} to"
        constraints.append(f"{prefix}{low} {entry.max}")
    if entry.excludes_min and not entry.is_array:
        constraints.append(f"above {entry.min}")
    if entry.constraint:
        constraints.append(entry.constraint)
    constraints.append(
        "may change while the cloth runs, from the next frame on" if entry.live else "set at start, not changed later"
    )
    descriptor.additional_constraints = "; ".join(constraints)
    return descriptor


class LiveParameters:
    """Validator of changes of ROS parameters; it passes valid ones on, effective with the next frame.

    Args:
        node: the node that owns the parameters.
        scene: the scene in force.
        change: called with the accepted values by name; must not refuse them.
        check: raises ValueError or RuntimeError to refuse a change; takes the values by name and the resulting scene.
        lock: held during each change, because other threads may set parameters while a frame runs.
    """

    def __init__(
        self,
        node: Node,
        scene: Scene,
        change: Callable[[dict[str, Any]], None],
        check: Callable[[dict[str, Any], Scene], None],
        lock: AbstractContextManager[Any],
    ) -> None:
        self._node, self._change, self._check, self._lock = node, change, check, lock
        #: Scene of the present parameters, in force now or from the next frame on, so that two changes before a frame
        #: are checked together.
        self.accepted = scene
        # The last validated values and their scene, so that it is not built twice.
        self._validated: tuple[dict[str, Any], Scene] = ({}, scene)
        self._returning = False
        # Another callback may still refuse a change: only values that were set are applied.
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def return_to(self, scene: Scene) -> list[str]:
        """Set the ROS parameters to a scene's values, because an accepted change could not take effect; return them."""
        before, now = self.accepted.parameters(), scene.parameters()
        previous = self.accepted.entries
        remaining = {entry.name for entry in scene.entries}
        self.accepted = scene
        self._returning = True
        try:
            changed = [entry for entry in scene.entries if before[entry.name] != now[entry.name]]
            added = [entry.name for entry in previous if entry.name not in remaining]
            self._node.set_parameters(
                [RosParameter(entry.name, _TYPES[entry.kind], _listed(now[entry.name])) for entry in changed]
            )
            for name in added:
                self._node.undeclare_parameter(name)
        finally:
            self._returning = False
        return [*(entry.name for entry in changed), *added]

    def _validate(self, changes: Sequence[RosParameter]) -> SetParametersResult:
        for change in changes:
            fixed = change.name == SIM_TIME or change.name.startswith(QOS_PREFIX)
            if fixed and change.value != self._node.get_parameter_or(change.name, change).value:
                reason = f"{change.name} can't change while the cloth runs; set it at start"
                return SetParametersResult(successful=False, reason=reason)
        values = self._values(changes)
        if not values or self._ignores_changes:
            return SetParametersResult(successful=True)
        with self._lock:
            try:
                refused = Faults()
                refused.add(frame_ids.faults(values))
                refused.refuse()
                changed_scene = self.accepted.changed(values)
                self._check(values, changed_scene)
            except ParameterError as error:
                return SetParametersResult(successful=False, reason="; ".join(error.sentences))
            except (ValueError, RuntimeError) as error:
                return SetParametersResult(successful=False, reason=str(error))
            self._validated = (values, changed_scene)
        return SetParametersResult(successful=True)

    def _apply(self, changes: Sequence[RosParameter]) -> None:
        values = self._values(changes)
        if not values or self._ignores_changes:
            return
        with self._lock:
            validated, changed_scene = self._validated
            if validated != values:
                changed_scene = self.accepted.changed(values)
            self.accepted = changed_scene
            self._validated = ({}, changed_scene)
            in_force = changed_scene.parameters()
            self._change({name: in_force[name] for name in values})

    @property
    def _ignores_changes(self) -> bool:
        """True while ROS parameters are declared or set back, which changes nothing in the scene."""
        return self._returning or (isinstance(self._node, SceneNode) and self._node.declaring)

    def _values(self, changes: Sequence[RosParameter]) -> dict[str, Any]:
        # Parameters of single grippers and new obstacles are recognised by their names.
        names = [change.name for change in changes]
        present = self.accepted.parameters()
        known = {entry.name for entry in Scene.declared_for({**dict.fromkeys(names), **present})}
        return {change.name: _plain(change.value) for change in changes if change.name in known}


def _warn_of_unknown(node: Node, scene: Scene, known: Sequence[str]) -> None:
    """Warn of overrides without effect, such as typing errors in a parameter file, and undeclare them."""
    names = node.list_parameters([], 0).names
    full, resolve = node.get_fully_qualified_name(), node.resolve_topic_name
    used = {Override(resolve(topic), kind, policy).name for kind, topic, policy in overridable(scene)}
    for sentence in unknown_sentences(names, known, scene, node=full, resolve=resolve):
        node.get_logger().warning(sentence)
    for name in names:
        if name not in used and name not in known and name not in ROS_PARAMETERS:
            node.undeclare_parameter(name)


def _no_values(_values: Mapping[str, Any]) -> dict[str, Any]:
    return {}


def _limits(entry: Parameter, largest: float, kind: Callable[[float], Any]) -> dict[str, Any]:
    return {
        "from_value": kind(-largest if entry.min_accepted is None else entry.min_accepted),
        "to_value": kind(largest if entry.max is None else entry.max),
    }


def _plain(value: Any) -> Any:
    """Convert an array of a ROS parameter, as rclpy holds it, to a tuple; other values stay unchanged."""
    return value if isinstance(value, bool | int | float | str | bytes | None) else tuple(value)


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
