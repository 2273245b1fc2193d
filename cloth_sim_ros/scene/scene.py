# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scene: frozen, checked configuration, and the model built from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from cloth_sim_ros.physics.control.automatic import INTEGRATORS, make_integrator
from cloth_sim_ros.physics.integrators.base import TOLERANCE, Integrator
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.material import ThreadStiffness
from cloth_sim_ros.physics.model.sheets.mesh import POISSON_RATIO, MeshSheet
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.physics.plan.gripper_path import normalized, rotation_matrix
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import SleepState
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene import cameras as scene_cameras
from cloth_sim_ros.scene import coverage, fabrics, gripper_parameters, keypoints, limits, relaxation, sections
from cloth_sim_ros.scene import files as scene_files
from cloth_sim_ros.scene import gripper_pads as scene_pinch
from cloth_sim_ros.scene import obstacles as scene_obstacles
from cloth_sim_ros.scene.build import (
    anchored_particles,
    build_model,
    build_plan,
    build_sheet,
    grid_threads_of,
    obstacle_joints,
)
from cloth_sim_ros.scene.camera_section import CameraParameters
from cloth_sim_ros.scene.gripper_section import NO_ACTION, PINCH, PRESCRIBED
from cloth_sim_ros.scene.parameters import declare as parameters
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.parameters.declare import ParameterError, parameter, section
from cloth_sim_ros.scene.parameters.unknown_parameters import is_ros_parameter
from cloth_sim_ros.scene.physics_scene import Sheet
from cloth_sim_ros.scene.recorded_scene import merge_hint
from cloth_sim_ros.scene.sections import (
    AirParameters,
    BendingParameters,
    ClothParameters,
    ContactParameters,
    CoverageParameters,
    DiagnosticsParameters,
    EnsembleParameters,
    GripperParameters,
    MaterialParameters,
    MembraneParameters,
    PointsParameters,
    RecordParameters,
    RobotParameters,
    TfParameters,
    WindParameters,
)
from cloth_sim_ros.scene.sheet_checks import check_sheet, raw_springs_defaults
from cloth_sim_ros.scene.topology_id import difference, topology_id
from cloth_sim_ros.scene.value_checks import check_values

if TYPE_CHECKING:
    from cloth_sim_ros.physics.contact.obstacles import Obstacle
    from cloth_sim_ros.scene.distribution import Distribution

#: Parameters and groups of parameters that rclpy declares by itself.
_ROS_GROUPS = ("use_sim_time", "qos_overrides", "start_type_description_service")


@attrs.frozen(kw_only=True)
class Scene:
    """Checked, frozen configuration: all parameters of a cloth, its forces, bodies, time stepping and outputs.

    Raises:
        ParameterError: for an invalid value, or an invalid combination of values.
    """

    rate: float = parameter("double", 60.0, "Frame rate, in simulated time", unit="Hz", min=0.1, max=10000.0)
    frame_id: str = parameter(
        "string", "world", "Coordinate frame of the cloth and of commands", constraint=f"not empty, {limits.FRAME}"
    )
    initial_state: str = parameter(
        "string", "", "Initial state: a file of ~/save_state, or session.mcap@frame; empty: the flat sheet"
    )
    cloth: ClothParameters = section(ClothParameters)
    material: MaterialParameters = section(MaterialParameters)
    membrane: MembraneParameters = section(MembraneParameters)
    bending: BendingParameters = section(BendingParameters)
    gravity: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, -9.81),
        "Gravitational acceleration",
        unit="m/s^2",
        length=3,
        min=-1e4,
        max=1e4,
        live=True,
    )
    air: AirParameters = section(AirParameters)
    wind: WindParameters = section(WindParameters)
    grippers: tuple[str, ...] = parameter(
        "string[]", ("gripper",), "Names of the grippers; none by ['']", constraint=limits.NAMES
    )
    gripper: GripperParameters = section(GripperParameters)
    obstacles: tuple[str, ...] = parameter(
        "string[]",
        ("",),
        "Names of the present obstacles, each described by <name>.shape and further parameters; none by ['']",
        constraint=limits.NAMES,
        live=True,
    )
    robot: RobotParameters = section(RobotParameters)
    contact: ContactParameters = section(ContactParameters)
    cameras: tuple[str, ...] = parameter(
        "string[]",
        ("",),
        "Names of the depth cameras, each with parameters <name>.width and further; none by ['']",
        constraint=limits.NAMES,
        observes=True,
    )
    integrator: str = parameter(
        "string", "auto", "Time integrator; auto chooses by stiffness and tolerance", choices=INTEGRATORS, live=True
    )
    tolerance: float = parameter(
        "double",
        TOLERANCE,
        "Error bound: over every second, started from the full state, positions stay within this times max(1, g) of "
        "the exact motion. g is the amplification of a small perturbation of position or velocity in that second. "
        "Frames that exceed their part of the bound are flagged. 0: no bound. At 1e-4 frames of a swung cloth of "
        "30 x 30 in which a fold snaps take longer than 1/60 s on two cores",
        unit="m",
        min=0.0,
        max=1.0,
        constraint=f"0.0, or at least {limits.MIN_TOLERANCE}",
        live=True,
    )
    step: float = parameter(
        "double",
        0.0,
        "Fixed time step, without error control; 0: chosen by tolerance and stability",
        unit="s",
        min=0.0,
        max=1.0,
        live=True,
    )
    work_limit: float = parameter(
        "double",
        10.0,
        "Work limit of a frame: estimated cost over the frame's real time, counted without a clock. A frame that would "
        "need more misses the tolerance and is flagged with the reason; 0: no limit",
        min=0.0,
        max=1e6,
        live=True,
    )
    overload: str = parameter(
        "string",
        "slow",
        "Reaction to a machine too slow for real time: slow: frames are late; relax: the tolerance is relaxed, at most "
        "ten times and to 0.01 m, and tightened again when time permits",
        choices=("slow", "relax"),
        live=True,
        observes=True,
    )
    on_failure: str = parameter(
        "string",
        "stop",
        "Reaction to an exception in a frame: stop: time stops at the last good frame until ~/reset; exit: the node "
        "ends with status 1, for a supervisor that restarts it",
        choices=("stop", "exit"),
        live=True,
        observes=True,
    )
    simulation_interfaces: bool = parameter(
        "bool",
        False,
        "Serve the package simulation_interfaces: ~/get_simulator_features, ~/reset_simulation, ~/step_simulation, "
        "~/simulate_steps, ~/get_simulation_state and ~/set_simulation_state",
    )
    publish_clock: bool = parameter(
        "bool",
        False,
        "Publish the simulated time on /clock and stamp messages with it, for nodes with use_sim_time; for a graph "
        "whose slowest simulator is the cloth",
    )
    points: PointsParameters = section(PointsParameters)
    keypoints: tuple[str, ...] = parameter(
        "string[]",
        ("",),
        "Particles whose poses are on ~/keypoints, in this order: 'corners' of a grid, or one of them (top_left, ...), "
        "a particle's number, <name>=<number> to name it; no topic: ['']",
    )
    coverage: CoverageParameters = section(CoverageParameters)
    tf: TfParameters = section(TfParameters)
    record: RecordParameters = section(RecordParameters)
    diagnostics: DiagnosticsParameters = section(DiagnosticsParameters)
    ensemble: EnsembleParameters = section(EnsembleParameters)
    #: Described obstacles by name: those in `obstacles`, and those that can be added to it.
    described: dict[str, sections.ObstacleParameters] = attrs.field(factory=dict)
    #: Parameters of the depth cameras by name.
    views: dict[str, CameraParameters] = attrs.field(factory=dict)
    #: Parameters of single grippers, by full name.
    individual: dict[str, Any] = attrs.field(factory=dict)
    #: Content of the files that parameters name, by that name; a recording needs it to run again.
    files: dict[str, bytes] = attrs.field(factory=dict, repr=False)

    def __attrs_post_init__(self) -> None:
        """Raise ParameterError for invalid values, and for values that are invalid together."""
        parameters.check(self.entries, self.parameters())
        check_values(self)
        check_sheet(self)
        keypoints.keypoint_particles(self)
        coverage.check_coverage(self)
        if self.initial_state:
            self._loaded_state()
        if self.ensemble.file:
            self.distribution()
        if scene_pinch.pads_of(self, 1.0) or (self.obstacle_names and self.solids) or self.contact.self_:
            scene_obstacles.check_cloth(self.sheet, self.contact.thickness, touches_itself=self.contact.self_)

    @classmethod
    def declared(
        cls, obstacles: Iterable[str] = (), individual: Iterable[str] = (), cameras: Iterable[str] = ()
    ) -> tuple[parameters.Parameter, ...]:
        """Return the declarations of all parameters of a scene with given obstacles, grippers and cameras.

        Args:
            obstacles: names of described obstacles.
            individual: full names of single grippers' parameters.
            cameras: names of cameras.
        """
        entries = [entry for name in obstacles for entry in scene_obstacles.declarations(name)]
        entries += [entry for name in cameras for entry in scene_cameras.declarations(name)]
        return (*parameters.declarations(cls), *entries, *map(gripper_parameters.declaration, individual))

    @classmethod
    def declared_for(cls, names: Iterable[str]) -> tuple[parameters.Parameter, ...]:
        """Return the declarations of all parameters of a scene and of obstacles and grippers that `names` mention.

        If `names` are values by full name, they include those of the cameras in `cameras`.
        """
        full_names = list(names)
        described = scene_obstacles.described_obstacles(full_names, cls.groups())
        cameras = scene_cameras.camera_names(names, cls.groups())
        individual = gripper_parameters.individual_names(full_names, cls.groups(), [*described, *cameras])
        return cls.declared(described, individual, cameras)

    @property
    def entries(self) -> tuple[parameters.Parameter, ...]:
        """Declarations of all parameters of this scene."""
        return self.declared(self.described, self.individual, self.views)

    @staticmethod
    @cache
    def groups() -> frozenset[str]:
        """Return the first parts of all parameters' names, e.g. `cloth`: no obstacle or camera may be named so."""
        return frozenset(entry.name.partition(".")[0] for entry in Scene.declared()).union(_ROS_GROUPS)

    @classmethod
    def from_parameters(
        cls, values: dict[str, Any], *, files: Mapping[str, bytes] | None = None, folder: str | Path = "."
    ) -> Scene:
        """Build a scene from values by full name (``{"cloth.size": [1.0, 1.0]}``) and files that they name, or raise.

        Args:
            values: parameters; missing ones take their default.
            files: content of files that the values name, if it is already loaded; other files are read.
            folder: base of relative file names.

        Raises:
            ParameterError: for an unknown name, an invalid value, or a file that can't be read.
        """
        names, cameras = (
            scene_obstacles.described_obstacles(values, cls.groups()),
            scene_cameras.camera_names(values, cls.groups()),
        )
        fabric_values, fabric_files = fabrics.fabric_parameters(values, files or {}, folder)
        checked = parameters.check(
            cls.declared_for(values),
            {**fabric_values, **raw_springs_defaults(values), **values},
            hint=lambda name: scene_obstacles.hint(name, cls.groups()) or scene_cameras.hint(name, cls.groups()),
        )
        content = scene_files.read(checked, {**(files or {}), **fabric_files}, folder)
        described = scene_obstacles.build_descriptions(checked, names)
        owners = [*names, *cameras]
        individual = {
            name: checked[name] for name in gripper_parameters.individual_names(checked, cls.groups(), owners)
        }
        views = scene_cameras.build_cameras(checked, cameras)
        scene: Scene = parameters.build(
            cls, checked, described=described, views=views, individual=individual, files=content
        )
        return scene

    @classmethod
    def from_file(cls, path: str | Path, *, node: str = "cloth_sim") -> Scene:
        """Read a scene from a ROS parameter file, and the files that it names, relative to its folder; or raise.

        ROS's own entries of a parameter dump (`use_sim_time`, `qos_overrides`) are ignored. With `robot.enabled`, the
        links in `robot.description_file` become obstacles.

        Raises:
            ParameterError: as `from_parameters`, or if the file can't be read, or sets parameters only for other nodes.
        """
        values = parameter_file.read(path, node=node, strict=True)
        cloth_values = {name: value for name, value in values.items() if not is_ros_parameter(name)}
        if cloth_values.get("robot.enabled") is True:
            from cloth_sim_ros.scene.robot.links import scene_with_links, without_links

            scene = cls.from_parameters(without_links(cloth_values), folder=Path(path).parent)
            return scene_with_links(scene, cloth_values, folder=Path(path).parent)[0]
        return cls.from_parameters(cloth_values, folder=Path(path).parent)

    def parameters(self) -> dict[str, Any]:
        """Return every parameter's value by full name, in a new dict, those of obstacles and cameras included."""
        values = parameters.flatten(self)
        for name, obstacle in self.described.items():
            values.update(parameters.flatten(obstacle, f"{name}."))
        for name, camera in self.views.items():
            values.update(parameters.flatten(camera, f"{name}."))
        return values | self.individual

    def changed(self, values: dict[str, Any]) -> Scene:
        """Return a new scene with the values of live parameters replaced; raise ParameterError for others.

        Raises:
            ParameterError: for an unknown name, a read-only parameter, or an invalid value.
        """
        described = scene_obstacles.described_obstacles([*self.parameters(), *values], self.groups())
        individual = gripper_parameters.individual_names(values, self.groups(), [*described, *self.views])
        known = {entry.name: entry for entry in self.declared(individual=individual)}
        for name in values:
            if name in known and not known[name].live:
                raise ParameterError(parameters.read_only_message(name))
        scene_obstacles.check_meshes(values, self.parameters())
        scene = self.from_parameters({**self.parameters(), **values}, files=self.files)
        for name in self.obstacle_names:
            if name in scene.obstacle_names:
                scene_obstacles.check_change(name, self.described[name], scene.described[name])
        for name, camera in self.views.items():
            scene_cameras.check_change(name, camera, scene.views[name])
        return scene

    @property
    def period(self) -> float:
        """Simulated time of one frame [s]."""
        return 1.0 / self.rate

    @property
    def gripper_names(self) -> list[str]:
        """Names of the grippers."""
        return [name for name in self.grippers if name]

    @property
    def pinching(self) -> list[str]:
        """Names of the grippers in mode pinch."""
        return [name for name in self.gripper_names if self.pinches(name)]

    @property
    def prescribing(self) -> list[str]:
        """Names of the grippers that prescribe the motion of the particles that they grasp."""
        return [name for name in self.attaching if self.of_gripper(name, "model") == PRESCRIBED]

    @property
    def attaching(self) -> list[str]:
        """Names of the grippers in mode attach."""
        return [name for name in self.gripper_names if not self.pinches(name)]

    def pinches(self, gripper: str) -> bool:
        """Return True if a gripper is in mode pinch."""
        return bool(self.of_gripper(gripper, "mode") == PINCH)

    @property
    def has_actions(self) -> bool:
        """True if at least one gripper has an action server, by the parameter `action`."""
        return any(self.of_gripper(name, "action") != NO_ACTION for name in self.gripper_names)

    def of_gripper(self, gripper: str, leaf: str) -> Any:
        """Return the value of `<gripper>.<leaf>` if set, else of `gripper.<leaf>`; see `gripper_parameters.LEAVES`."""
        return gripper_parameters.value(self.individual, self.gripper, gripper, leaf)

    @property
    def camera_names(self) -> list[str]:
        """Names of the depth cameras."""
        return [name for name in self.cameras if name]

    @property
    def obstacle_names(self) -> list[str]:
        """Names of the present obstacles, which the parameter `obstacles` lists."""
        return [name for name in self.obstacles if name]

    @property
    def link_names(self) -> list[str]:
        """Names of the present obstacles that are links of a robot."""
        return [name for name in self.obstacle_names if self.described[name].link]

    @property
    def unlinked_names(self) -> list[str]:
        """Names of the described obstacles, present or not, that are no links of a robot: these have topics."""
        return [name for name, obstacle in self.described.items() if not obstacle.link]

    @property
    def joined_obstacles(self) -> frozenset[str]:
        """Names of the present obstacles that joints hold to the cloth."""
        return frozenset(name for name, _ in obstacle_joints(self, self.sheet))

    @property
    def solids(self) -> list[Obstacle]:
        """Rigid shapes of the present obstacles, in the order of `obstacle_names`."""
        names = self.obstacle_names
        return [scene_obstacles.build_solid(name, self.described[name], self.files) for name in names]

    @property
    def sheet(self) -> Sheet:
        """Geometry of the cloth: a grid (built at each access), a mesh, or raw springs.

        Raises:
            ParameterError: for a mesh or springs file with invalid content.
        """
        return build_sheet(self)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a grid; 1 and the number of particles of other sheets."""
        sheet = self.sheet
        return (sheet.rows, sheet.columns) if isinstance(sheet, GridSheet) else (1, len(sheet.positions()))

    def threads(self) -> ThreadStiffness:
        """Return the spring stiffnesses of a grid, force per strain [N], and Poisson's ratio; raise for other sheets.

        Raises:
            ParameterError: if the moduli can't be met, or the cloth is no grid.
        """
        sheet = self.sheet
        if not isinstance(sheet, GridSheet) or self.membrane.model == "triangles":
            raise ParameterError("only a grid of springs has threads; this cloth is a mesh, triangles or raw springs")
        return grid_threads_of(self, sheet)

    @property
    def poisson_ratio(self) -> float | None:
        """Poisson's ratio of the sheet along its axes, as network and moduli determine it; None for raw springs."""
        sheet = self.sheet
        if self.membrane.model == "triangles":
            return self.material.poisson_ratio
        if isinstance(sheet, GridSheet):
            return grid_threads_of(self, sheet).poisson_ratio
        return POISSON_RATIO if isinstance(sheet, MeshSheet) else None

    def distribution(self) -> Distribution:
        """Parse the distribution of uncertain parameters in `ensemble.file`; raise ParameterError if that is unset.

        Raises:
            ParameterError: if there is none, its content is invalid, or its parameters cannot vary in this scene.
        """
        from cloth_sim_ros.scene.distribution import Distribution

        if not self.ensemble.file:
            raise ParameterError("ensemble.file is empty; name a file of cloth_fit --json")
        subject = f"ensemble.file '{self.ensemble.file}'"
        distribution = Distribution.from_bytes(self.files[self.ensemble.file], subject)
        try:
            distribution.check(self)
        except ParameterError as error:
            raise ParameterError(f"{subject}: {error}") from error
        return distribution

    def anchored_particles(self) -> list[int]:
        """Return the sorted indices of the particles that `cloth.anchors` names."""
        return anchored_particles(self, self.sheet)

    def model(self) -> Model:
        """Build a new model: masses, forces, anchors. Forces that the scene does not use are left out."""
        return build_model(self)

    def plan(self) -> Plan:
        """Build the model and compile it into a new plan for the engine."""
        return build_plan(self)

    def initial_positions(self) -> Array:
        """Return particle positions of the sheet at its initial pose [m], (particle_count, 3), no `initial_state`."""
        return self._rotate(self.sheet.positions()) + np.asarray(self.cloth.position)

    def _rotate(self, vectors: Array) -> Array:
        """Rotate vectors (n, 3) from the sheet's axes to the world's, with a fixed order of sums."""
        rotation = rotation_matrix(normalized(self.cloth.orientation))
        x, y, z = np.asarray(vectors, dtype=np.float64).T
        return np.stack([row[0] * x + row[1] * y + row[2] * z for row in rotation], axis=1)

    def starting_state(self) -> State:
        """Return a new starting state: that of `initial_state`, at frame 0 and running; else the sheet at rest.

        A springs file gives velocities of its own.

        Raises:
            ParameterError: for a state that does not fit the cloth.
        """
        if self.initial_state:
            return self._loaded_state()
        sheet = self.sheet
        velocities = None
        if isinstance(sheet, RawSprings):
            velocities = self._rotate(sheet.velocities)
        return State(self.initial_positions(), velocities, cloth=topology_id(sheet))

    def build_integrator(self, *, factor: float = 1.0) -> Integrator:
        """Build the scene's integrator, with its tolerance relaxed by a factor, see `relaxed_tolerance`."""
        tolerance = relaxation.relaxed_tolerance(self.tolerance, factor) or None
        return make_integrator(self.integrator, step=self.step or None, tolerance=tolerance, work=self.work_limit)

    def _loaded_state(self) -> State:
        subject = f"initial_state '{self.initial_state}'"
        try:
            state = State.from_bytes(self.files[self.initial_state])
        except ValueError as error:
            raise ParameterError(f"{subject} is no state file of ~/save_state: {error}") from error
        cloth = topology_id(self.sheet)
        mismatch = difference(state, cloth)
        if mismatch:
            raise ParameterError(f"{subject} {mismatch}{merge_hint(self)}")
        state.cloth = cloth
        # A state that never ran has no gripper memory and fits any number. A run without grippers leaves 0 poses.
        poses = state.memory.get("gripper.pose")
        if poses is not None and len(poses) != len(self.gripper_names):
            raise ParameterError(f"{subject} has {len(poses)} grippers, the cloth {len(self.gripper_names)}")
        if SleepState.key in state.memory:
            sleep = SleepState.load(state)
            sleep.wake_frame = max(0.0, sleep.wake_frame - state.frame)
            sleep.store(state)
        state.frame = 0
        state.memory.pop("paused", None)
        relaxation.set_factor(state, 1.0)
        return state
