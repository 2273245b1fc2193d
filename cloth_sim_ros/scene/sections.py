# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sections of a scene: each parameter with default, unit, limits and description.

Nothing of this is declared elsewhere.
"""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics.contact.obstacle_shapes import MAX_SIZE, SHAPES
from cloth_sim_ros.physics.model.sheets.surface import LAYOUTS
from cloth_sim_ros.scene.gripper_section import GripperParameters as GripperParameters
from cloth_sim_ros.scene.limits import FRAME, FRICTION, MAX_PARTICLES, QUATERNION
from cloth_sim_ros.scene.parameters.declare import parameter
from cloth_sim_ros.scene.robot_section import RobotParameters as RobotParameters


@attrs.frozen(kw_only=True)
class ClothParameters:
    """Parameters `cloth.*`: geometry, initial pose, anchors and joints of the sheet."""

    size: tuple[float, ...] = parameter(
        "double[]",
        (1.0, 1.0),
        "Height (along a column) and width (along a row) of the sheet",
        unit="m",
        length=2,
        min=1e-6,
        max=100.0,
    )
    resolution: tuple[int, ...] = parameter(
        "int[]",
        (30, 30),
        "Particles along height and width: rows, columns",
        length=2,
        min=2,
        max=4096,
        constraint=f"at most {MAX_PARTICLES} particles",
    )
    mesh: str = parameter("string", "", "Triangle mesh file (OBJ, PLY, STL) instead of size and resolution")
    merge: bool = parameter(
        "bool",
        True,
        "Merge a mesh's vertices closer than 1e-7 of its extent, as copies of one vertex; false merges only vertices "
        "at exactly one position",
    )
    scale: float = parameter(
        "double",
        1.0,
        "Factor from a mesh file's unit to metres, e.g. 0.001 for a file in millimetres",
        min=0.0,
        max=1e6,
        excludes_min=True,
    )
    springs: str = parameter("string", "", "File of raw springs (YAML, npz), for experts, instead of a sheet")
    position: tuple[float, ...] = parameter(
        "double[]", (0.0, 0.0, 1.0), "Initial position of the sheet's centre", unit="m", length=3, min=-1e4, max=1e4
    )
    orientation: tuple[float, ...] = parameter(
        "double[]",
        (0.7071067811865476, 0.0, 0.0, 0.7071067811865476),
        "Quaternion x, y, z, w that rotates the sheet from the x-y plane, top edge towards +y; the default hangs it",
        length=4,
        constraint=QUATERNION,
    )
    anchors: tuple[str, ...] = parameter(
        "string[]",
        ("top",),
        "Fixed particles: edges (top, bottom, left, right), corners (top_left, ...), particle indices; none: ['']",
        live=True,
    )
    joints: tuple[str, ...] = parameter(
        "string[]",
        ("",),
        "Joints (S4), springs of zero length, each between two particles, 12-340, two edges or corners of a grid, "
        "left-right, or one of them and an obstacle, top-table; a mesh of several pieces needs them or contact.self; "
        "none: ['']",
    )
    joint_stiffness: float = parameter(
        "double",
        1000.0,
        "Stiffness of each joint",
        unit="N/m",
        min=0.0,
        max=1e8,
        excludes_min=True,
        live=True,
    )
    joint_damping: float = parameter(
        "double",
        0.5,
        "Dimensionless damping of each joint; sqrt(2) is critical for two free particles of equal mass",
        min=0.0,
        max=10.0,
        live=True,
    )
    shear_layout: str = parameter(
        "string", "both", "Diagonals of the grid's cells that are shear springs", choices=LAYOUTS
    )


@attrs.frozen(kw_only=True)
class MaterialParameters:
    """Parameters `material.*`: fabric, density, moduli and damping of the sheet."""

    fabric: str = parameter(
        "string",
        "",
        "Fabric whose values are the defaults of the material: denim, ..., or the path of a fabric file (YAML); other "
        "parameters that are set override it; empty: none",
    )
    density: float = parameter("double", 0.2, "Mass per area", unit="kg/m^2", min=1e-9, max=1e3, live=True)
    stretch_modulus: float = parameter(
        "double",
        1000.0,
        "Young's modulus of the sheet along its threads: warp, and weft unless stretch_modulus_weft is set",
        unit="N/m",
        min=0.0,
        max=1e9,
        excludes_min=True,
        live=True,
    )
    stretch_modulus_weft: float = parameter(
        "double",
        0.0,
        "Young's modulus of the sheet along its weft; 0: that of the warp. Springs of a mesh are alike in all "
        "directions; membrane.model triangles is not",
        unit="N/m",
        min=0.0,
        max=1e9,
        live=True,
    )
    poisson_ratio: float = parameter(
        "double",
        0.0,
        "Poisson's ratio of membrane.model triangles: contraction along the weft over strain, in a pull along the "
        "warp; its square is below warp over weft modulus. That of springs follows from their network",
        min=-10.0,
        max=10.0,
        live=True,
    )
    warp_direction: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 1.0, 0.0),
        "Direction of the warp at rest, projected onto each triangle: in the sheet's own plane, x along a row, y "
        "towards the top edge, or in the frame of the mesh file. The weft is perpendicular to it. Springs of a grid "
        "need a direction along its rows or columns",
        length=3,
        min=-1e4,
        max=1e4,
        constraint="not all 0",
    )
    shear_modulus: float = parameter(
        "double", 100.0, "Shear modulus of the sheet", unit="N/m", min=0.0, max=1e9, live=True
    )
    warp_stiffening: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 1.0),
        "Strain of a pull along the warp at which its modulus stops growing, and factor by which it then has grown. "
        "The modulus grows with the square of the strain, for membrane.model triangles; [0.0, 1.0]: constant",
        length=2,
        min=0.0,
        max=1e6,
        live=True,
    )
    weft_stiffening: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 1.0),
        "The same as warp_stiffening in a pull along the weft",
        length=2,
        min=0.0,
        max=1e6,
        live=True,
    )
    shear_stiffening: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 1.0),
        "The same as warp_stiffening in shear; its strain is the cosine of the angle between the threads",
        length=2,
        min=0.0,
        max=1e6,
        live=True,
    )
    bending_modulus: float = parameter(
        "double",
        0.0,
        "Moment per width and curvature; required by crossed, altitude, quadratic and shape_operator bending, "
        "unused by other models",
        unit="N m",
        min=0.0,
        max=1e6,
        live=True,
    )
    bending_modulus_weft: float = parameter(
        "double",
        0.0,
        "Moment per width and curvature of a strip along the weft; 0: that of the warp, which bending_modulus then is",
        unit="N m",
        min=0.0,
        max=1e6,
        live=True,
    )
    damping: float = parameter(
        "double",
        0.1,
        "Dimensionless damping k_d0 of every spring; 1 is critical for the shortest wave",
        min=0.0,
        max=10.0,
        live=True,
    )
    viscosity: float = parameter(
        "double",
        0.0,
        "Viscosity of the sheet along its threads, instead of damping in stretch and shear: k_d = k_s / l0 viscosity / "
        "stretch_modulus; 0: damping is used",
        unit="N s/m",
        min=0.0,
        max=1e4,
        live=True,
    )


@attrs.frozen(kw_only=True)
class MembraneParameters:
    """Parameter `membrane.model` of the resistance to stretch and shear: springs or triangles."""

    model: str = parameter(
        "string",
        "springs",
        "Elements that resist stretch and shear: springs along edges and diagonals; triangles of constant strain, "
        "which have warp, weft and shear moduli in any direction of the threads, on grids and meshes",
        choices=("springs", "triangles"),
    )


#: Models of bending that take a bending modulus.
MODULUS_MODELS = ("crossed", "altitude", "quadratic", "shape_operator")


@attrs.frozen(kw_only=True)
class BendingParameters:
    """Parameters `bending.*`: model, rest angles and friction of bending."""

    model: str = parameter(
        "string",
        "axial",
        "Springs that resist bending: none; axial (two apart along a grid's axes); opposite (S7); crossed (S7 and S8); "
        "altitude (S7 and S9); quadratic (hinges that are flat at rest); shape_operator (curvatures of triangles that "
        "are flat at rest, on any mesh and for any direction of the threads)",
        choices=("none", "axial", "opposite", "crossed", "altitude", "quadratic", "shape_operator"),
    )
    stiffness: float = parameter(
        "double",
        2.0,
        "Stiffness of axial and opposite springs: k_s per thread spacing; it is subtracted from edge springs",
        unit="N/m",
        min=0.0,
        max=1e8,
        live=True,
    )
    stiffness_weft: float = parameter(
        "double",
        0.0,
        "Stiffness of axial springs along the weft; 0: that of the warp, which bending.stiffness then is",
        unit="N/m",
        min=0.0,
        max=1e8,
        live=True,
    )
    friction_moment: float = parameter(
        "double",
        0.0,
        "Moment per width of the internal friction of bending, half of the width 2HB of the loop of moment over "
        "curvature, for crossed, altitude and quadratic; 0: none",
        unit="N",
        min=0.0,
        max=1e3,
        live=True,
    )
    yield_curvature: float = parameter(
        "double",
        20.0,
        "Change of curvature up to which the internal friction of bending is elastic",
        unit="1/m",
        min=0.01,
        max=1e5,
        live=True,
    )
    rest_angle: float = parameter(
        "double",
        0.0,
        "Rest angle of every hinge, for opposite, crossed and altitude; 0: the angles of the rest shape, or flat",
        unit="rad",
        min=-3.14,
        max=3.14,
    )
    flat: bool = parameter(
        "bool",
        False,
        "Hinges are flat at rest, also those of a curved mesh; bending.rest_angle is then 0",
    )
    rest_angles: str = parameter(
        "string",
        "",
        "File of rest angles of single hinges (YAML, npz): tables edges, two particles a row, and angles, in rad; the "
        "other hinges follow bending.flat and bending.rest_angle",
    )


@attrs.frozen(kw_only=True)
class AirParameters:
    """Parameters `air.*`: drag by still air, and the mass of air that the cloth carries along."""

    drag: float = parameter("double", 0.2, "Linear drag: acceleration -drag v", unit="1/s", min=0.0, max=1e4, live=True)
    added_mass: float = parameter(
        "double",
        0.0,
        "Mass per area of the air that moves with the cloth across its surface. It adds inertia, not weight. Raw "
        "springs have no surface. 0: none",
        unit="kg/m^2",
        min=0.0,
        max=10.0,
        live=True,
    )


@attrs.frozen(kw_only=True)
class WindParameters:
    """Parameters `wind.*` of moving air. Drag is relative to it: acceleration -air.drag (v - velocity)."""

    velocity: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, 0.0),
        "Velocity of the air, uniform; it acts through air.drag and the coefficients below",
        unit="m/s",
        length=3,
        min=-100.0,
        max=100.0,
        live=True,
    )
    normal_drag: float = parameter(
        "double",
        0.45,
        "Force per area and speed of air across the surface. It depends on the air and the speed, not on the cloth. "
        "The default was identified from recordings of one cloth of 0.3 m at up to 0.8 m/s, where linear drag "
        "suffices; beyond that range it is an extrapolation. 0: no drag across the surface. Raw springs have no "
        "surface; their default is 0",
        unit="N s/m^3",
        min=0.0,
        max=1e3,
        live=True,
    )
    tangential_drag: float = parameter(
        "double", 0.0, "Force per area and speed of air along the surface", unit="N s/m^3", min=0.0, max=1e3, live=True
    )


@attrs.frozen(kw_only=True)
class ContactParameters:
    """Parameters `contact.*` of contact of the cloth with obstacles and with itself."""

    self_: bool = parameter(
        "bool", False, "Contact of the cloth with itself: layers keep the thickness and do not intersect"
    )
    thickness: float = parameter(
        "double",
        0.003,
        "Distance from an obstacle's surface, or from another part of the cloth, below which contact pushes the "
        "cloth's middle surface away; at most half the shortest edge of the cloth",
        unit="m",
        min=1e-6,
        max=1.0,
        live=True,
    )
    friction: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0),
        "Coefficients of friction between layers of the cloth, with contact.self: static (sliding below 0.01 m/s) and "
        "kinetic (above 0.02 m/s), the latter no larger; one number sets both; 0: no friction",
        min=0.0,
        max=1e3,
        constraint=FRICTION,
        live=True,
    )
    damping: float = parameter(
        "double",
        10.0,
        "Damping of contact: impacts faster than 1 / damping lose much of their energy; 0: elastic",
        unit="s/m",
        min=0.0,
        max=1e4,
        live=True,
    )


@attrs.frozen(kw_only=True)
class ObstacleParameters:
    """Parameters `<obstacle>.*` of one obstacle, e.g. `table.size`; it is present only if `obstacles` lists it.

    Some may change only while `obstacles` does not name it; their description says so.
    """

    shape: str = parameter(
        "string",
        "box",
        "Shape: the half space below a plane (normal z), or a solid centred on the obstacle's frame, axis z; set it "
        "together with the obstacle, or before its other parameters; changes only while it is not in obstacles",
        choices=tuple(SHAPES),
        live=True,
    )
    size: tuple[float, ...] = parameter(
        "double[]",
        (0.1, 0.1, 0.1),
        "box: x, y, z; sphere: radius; capsule and cylinder: radius, length (a capsule's without its round ends); "
        "a plane and a mesh have none; changes only while it is not in obstacles",
        unit="m",
        min=0.0,
        max=MAX_SIZE,
        excludes_min=True,
        live=True,
    )
    mesh: str = parameter(
        "string",
        "",
        "File of a mesh (OBJ, PLY, STL) in metres and in the obstacle's frame: closed, its triangles counterclockwise "
        "seen from outside; read-only while the cloth runs",
        live=True,
    )
    scale: float = parameter(
        "double",
        1.0,
        "Factor from its mesh file's unit to metres, e.g. 0.001 for a file in millimetres; changes only while it is "
        "not in obstacles",
        min=0.0,
        max=1e6,
        excludes_min=True,
        live=True,
    )
    position: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, 0.0),
        "Initial position; changes only while it is not in obstacles; otherwise use ~/<obstacle>/target",
        unit="m",
        length=3,
        min=-1e4,
        max=1e4,
        live=True,
    )
    orientation: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, 0.0, 1.0),
        "Initial orientation, a quaternion x, y, z, w; changes only while it is not in obstacles",
        length=4,
        constraint=QUATERNION,
        live=True,
    )
    friction: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0),
        "Coefficients of friction between it and the cloth: static (sliding below 0.01 m/s) and kinetic (above "
        "0.02 m/s), the latter no larger; one number sets both; 0: no friction",
        min=0.0,
        max=1e3,
        constraint=FRICTION,
        live=True,
    )
    frame: str = parameter(
        "string", "", "TF frame that it follows; empty: none. Needs tf2_ros", constraint=FRAME, live=True, observes=True
    )
    link: str = parameter(
        "string", "", "Link of the robot that it is part of and follows; set by robot.enabled, not by hand", live=True
    )


@attrs.frozen(kw_only=True)
class PointsParameters:
    """Parameters `points.*`: optional fields and precision of the cloud on ~/points."""

    velocity: bool = parameter(
        "bool", False, "Fields vx, vy, vz [m/s] after x, y, z; the cloud is twice as large", live=True, observes=True
    )
    double: bool = parameter(
        "bool",
        False,
        "Fields in double precision, for a cloth far from the frame's origin; the cloud is twice as large, and RViz "
        "does not show it",
        live=True,
        observes=True,
    )
    normal: bool = parameter(
        "bool",
        False,
        "Fields normal_x, normal_y, normal_z: unit normal of the surface, by the right-hand rule of the triangles of "
        "~/topology; 0 without a triangle",
        live=True,
        observes=True,
    )
    id: bool = parameter(
        "bool",
        False,
        "Field id (uint32): index of the particle, which survives a filter that removes points",
        live=True,
        observes=True,
    )

    @property
    def fields(self) -> dict[str, bool]:
        """Keyword arguments of an encoder of clouds: flags of velocity, normals, ids, and double precision."""
        return {"velocity": self.velocity, "normal": self.normal, "ids": self.id, "double": self.double}


@attrs.frozen(kw_only=True)
class CoverageParameters:
    """Parameters `coverage.*`: plane, rectangle and resolution of the covered area on ~/coverage."""

    obstacle: str = parameter(
        "string",
        "",
        "Plane or box onto which the cloth is projected, along the z axis of its frame; described by <name>.shape, "
        "with contact only if obstacles names it; empty: no topic",
    )
    size: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0),
        "Rectangle about the obstacle's position, along its x and y; the area outside is not counted. 0, 0: all of a "
        "plane, or the top of a box",
        unit="m",
        length=2,
        min=0.0,
        max=100.0,
    )
    resolution: float = parameter(
        "double",
        0.005,
        "Edge length of the cells that are counted if their centre is covered; doubled until the cloth has at most "
        "4096 along either side",
        unit="m",
        min=1e-5,
        max=1.0,
    )


@attrs.frozen(kw_only=True)
class TfParameters:
    """Parameters `tf.*` of the coordinate frames that the node broadcasts."""

    publish: bool = parameter(
        "bool",
        False,
        "Send /tf: every gripper as <node>/<gripper>, the cloth's centre of mass as <node>/cloth. Needs tf2_msgs",
        live=True,
        observes=True,
    )


@attrs.frozen(kw_only=True)
class RecordParameters:
    """Parameters `record.*` of recorded sessions: start, folder, format and limits."""

    enabled: bool = parameter("bool", False, "Record a session from the start")
    folder: str = parameter(
        "string",
        "sessions",
        "Folder for the next recording's files, and for saved states; created if missing",
        live=True,
        observes=True,
    )
    split: int = parameter(
        "int", 0, "File size after which the recording continues in a new file; 0: never", unit="B", min=0, max=1 << 50
    )
    compression: str = parameter("string", "lz4", "Compression of the file's chunks", choices=("lz4", "zstd", "none"))
    least_free_space: int = parameter(
        "int", 100_000_000, "Free disk space below which the recording ends", unit="B", min=0, max=1 << 50
    )
    topics: bool = parameter(
        "bool",
        False,
        "Topics ~/frame and ~/snapshot, sent while ~/frame has subscribers; cloth_verify runs a bag with both again",
    )
    snapshot_period: float = parameter(
        "double",
        10.0,
        "Simulated time between two messages of ~/snapshot; a bag that lost a message is run again from the next one "
        "on. 0: only for each new subscriber",
        unit="s",
        min=0.0,
        max=1e6,
        live=True,
        observes=True,
    )


@attrs.frozen(kw_only=True)
class DiagnosticsParameters:
    """Parameters `diagnostics.*`: optional measurements of energy balance and true error."""

    energy: bool = parameter(
        "bool", False, "Report the energy balance; every frame is then computed a second time, term by term", live=True
    )
    accuracy: bool = parameter(
        "bool",
        False,
        "Report the true error, measured second by second in a separate process; it occupies one core",
        live=True,
        observes=True,
    )


@attrs.frozen(kw_only=True)
class EnsembleParameters:
    """Parameters `ensemble.*` of cloths with uncertain parameters beside the cloth."""

    file: str = parameter(
        "string",
        "",
        "Distribution of uncertain parameters: a file of cloth_fit --json, or YAML. ~/ensemble then has the mean of an "
        "ensemble of cloths and the deviation of each particle, computed in a separate process; empty: no ensemble",
        observes=True,
    )
    members: int = parameter(
        "int",
        0,
        "Number of its cloths: a random sample of at least 2; 0: sigma points, two for each parameter",
        min=0,
        max=1000,
        constraint="0, or at least 2",
        observes=True,
    )
    seed: int = parameter("int", 0, "Seed of the random sample", min=0, max=2**31 - 1, observes=True)
