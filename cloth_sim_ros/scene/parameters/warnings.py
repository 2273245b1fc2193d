# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Valid parameters without effect, because other parameters disable them."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable

from cloth_sim_ros.scene import sections
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.scene.thread_directions import axial_stiffness, bending_moduli, stretch_moduli

#: Names, condition under which they have no effect, and the reason as the end of a sentence.
_RULES: tuple[tuple[tuple[str, ...], Callable[[Scene], bool], str], ...] = (
    (("ensemble.members", "ensemble.seed"), lambda scene: not scene.ensemble.file, "ensemble.file is not set"),
    (("ensemble.seed",), lambda scene: not scene.ensemble.members, "ensemble.members is 0, which takes no sample"),
    (("cloth.merge", "cloth.scale"), lambda scene: not scene.cloth.mesh, "cloth.mesh is not set"),
    (
        ("cloth.size", "cloth.resolution", "cloth.shear_layout"),
        lambda scene: bool(scene.cloth.mesh or scene.cloth.springs),
        "cloth.mesh or cloth.springs is set",
    ),
    (
        ("cloth.joint_stiffness", "cloth.joint_damping"),
        lambda scene: not any(scene.cloth.joints),
        "cloth.joints is not set",
    ),
    (
        (
            "material.density",
            "material.stretch_modulus",
            "material.stretch_modulus_weft",
            "material.shear_modulus",
            "material.viscosity",
        ),
        lambda scene: bool(scene.cloth.springs),
        "cloth.springs has masses and stiffnesses of its own",
    ),
    (
        (
            "material.bending_modulus",
            "material.damping",
            "bending.stiffness",
            "bending.rest_angle",
            "bending.rest_angles",
            "bending.flat",
        ),
        lambda scene: bool(scene.cloth.springs) and scene.bending.model == "none",
        "cloth.springs has stiffnesses and damping of its own, and bending.model is none",
    ),
    (
        ("material.damping",),
        lambda scene: scene.material.viscosity > 0.0 and scene.bending.model in ("none", "axial"),
        "material.viscosity damps instead of it, and bending.model has no damping of its own",
    ),
    (
        ("material.shear_modulus",),
        lambda scene: bool(scene.cloth.mesh) and scene.membrane.model == "springs",
        "the shear modulus of a mesh of springs follows from its stretch modulus; membrane.model triangles uses it",
    ),
    (
        ("material.poisson_ratio",),
        lambda scene: scene.membrane.model == "springs",
        "Poisson's ratio of springs follows from their network; membrane.model triangles uses it",
    ),
    (
        ("material.warp_stiffening", "material.weft_stiffening", "material.shear_stiffening"),
        lambda scene: scene.membrane.model == "springs",
        "the moduli of springs are constant; membrane.model triangles uses it",
    ),
    (
        ("bending.stiffness_weft",),
        lambda scene: scene.bending.model != "axial",
        "only axial bending uses it; others take material.bending_modulus_weft",
    ),
    (
        ("material.bending_modulus_weft",),
        lambda scene: scene.bending.model not in sections.MODULUS_MODELS,
        "only crossed, altitude, quadratic and shape_operator bending use it",
    ),
    (
        ("material.warp_direction",),
        lambda scene: scene.membrane.model == "springs" and not _has_directions(scene),
        "warp and weft are alike",
    ),
    (
        ("bending.stiffness",),
        lambda scene: scene.bending.model not in ("axial", "opposite"),
        "only axial and opposite bending use it; others take material.bending_modulus",
    ),
    (
        ("bending.rest_angle", "bending.rest_angles", "bending.flat"),
        lambda scene: scene.bending.model in ("none", "axial"),
        "only opposite, crossed and altitude bending use it",
    ),
    (("bending.yield_curvature",), lambda scene: not scene.bending.friction_moment, "bending.friction_moment is 0"),
    (("bending.flat",), lambda scene: not (scene.cloth.mesh or scene.cloth.springs), "a grid is flat at rest"),
    (("material.bending_modulus",), lambda scene: scene.bending.model == "none", "bending.model is none"),
    (
        ("wind.velocity",),
        lambda scene: (
            not (scene.air.drag or scene.air.added_mass or scene.wind.normal_drag or scene.wind.tangential_drag)
        ),
        "air.drag, air.added_mass, wind.normal_drag and wind.tangential_drag are all 0",
    ),
    (("tolerance",), lambda scene: scene.step > 0.0, "step is set, and a fixed step holds no tolerance"),
    (
        ("tolerance", "overload", "work_limit"),
        lambda scene: scene.integrator == "symplectic_euler",
        "symplectic_euler has neither an error control nor a work limit",
    ),
    (("overload",), lambda scene: scene.step > 0.0 or not scene.tolerance, "there is no tolerance to relax"),
    (("coverage.size", "coverage.resolution"), lambda scene: not scene.coverage.obstacle, "coverage.obstacle is empty"),
    (("record.snapshot_period",), lambda scene: not scene.record.topics, "record.topics is false"),
    (
        (
            "gripper.model",
            "gripper.radius",
            "gripper.stiffness",
            "gripper.damping",
            "gripper.timeout",
            "gripper.frame",
            "gripper.max_speed",
            "gripper.action",
            "gripper.joint_range",
            "gripper.allow_stalling",
            "gripper.twist_max_speed",
            "gripper.twist_max_rate",
            "gripper.twist_timeout",
            "gripper.sensor_frame",
            "gripper.sensor_position",
            "gripper.sensor_orientation",
        ),
        lambda scene: not scene.gripper_names,
        "there are no grippers",
    ),
    (
        ("gripper.mode", "gripper.pad_size", "gripper.opening", "gripper.force", "gripper.speed", "gripper.friction"),
        lambda scene: not scene.gripper_names,
        "there are no grippers",
    ),
    (
        ("gripper.pad_size", "gripper.force", "gripper.speed", "gripper.friction"),
        lambda scene: not scene.pinching,
        "no gripper pinches (gripper.mode)",
    ),
    (
        ("gripper.opening",),
        lambda scene: not scene.pinching and not scene.has_actions,
        "no gripper pinches (gripper.mode), and none has an action (gripper.action)",
    ),
    (
        ("gripper.joint_range", "gripper.allow_stalling"),
        lambda scene: not scene.has_actions,
        "no gripper has an action (gripper.action)",
    ),
    (
        ("gripper.twist_max_rate", "gripper.twist_timeout"),
        lambda scene: not scene.gripper.twist_max_speed,
        "gripper.twist_max_speed is 0",
    ),
    (
        ("gripper.sensor_position", "gripper.sensor_orientation"),
        lambda scene: not scene.gripper.sensor_frame,
        "gripper.sensor_frame is empty",
    ),
    (
        ("gripper.model", "gripper.radius", "gripper.stiffness", "gripper.damping"),
        lambda scene: bool(scene.pinching) and scene.pinching == scene.gripper_names,
        "no gripper attaches (gripper.mode)",
    ),
    (
        ("gripper.stiffness", "gripper.damping"),
        lambda scene: bool(scene.attaching) and scene.prescribing == scene.attaching,
        "no gripper holds by springs (gripper.model)",
    ),
    (
        ("contact.thickness", "contact.damping"),
        lambda scene: not scene.obstacle_names and not scene.pinching and not scene.contact.self_,
        "there are no obstacles, no gripper pinches, and contact.self is false",
    ),
    (("contact.friction",), lambda scene: not scene.contact.self_, "contact.self is false"),
)


def _has_directions(scene: Scene) -> bool:
    """Return True if a quantity of the springs differs between warp and weft."""
    pairs = stretch_moduli(scene), bending_moduli(scene), axial_stiffness(scene)
    return any(warp != weft for warp, weft in pairs)


def ineffective_parameters(scene: Scene, set_names: Iterable[str]) -> list[str]:
    """Return a sentence for each set parameter (full name) that is no default and has no effect in a scene.

    Args:
        scene: the scene built with these parameters.
        set_names: full names of the set parameters.
    """
    defaults = {entry.name: entry.default for entry in scene.entries}
    values = scene.parameters()
    sentences: dict[str, str] = {}
    chosen = {name for name in set_names if values[name] != defaults[name]}
    for names, applies, reason in _RULES:
        if applies(scene):
            for name in names:
                if name in chosen:
                    sentences.setdefault(name, f"{name} is set and has no effect: {reason}")
    return [*sentences.values(), *_ineffective_obstacle_parameters(scene, chosen)]


def _ineffective_obstacle_parameters(scene: Scene, chosen: set[str]) -> list[str]:
    """Return a sentence for each set parameter of an obstacle without effect, e.g. the size of a plane."""
    sentences = []
    for name, obstacle in scene.described.items():
        if name not in scene.obstacle_names:
            if name == scene.coverage.obstacle:
                continue
            close = difflib.get_close_matches(name, [*scene.obstacle_names, *scene.groups()], n=1)
            sentences.append(
                f"{name}.shape is set and has no effect: obstacles does not name '{name}'; it may be added while the "
                "cloth runs" + (f". Did you mean '{close[0]}'?" if close else "")
            )
        elif f"{name}.size" in chosen and obstacle.shape in ("plane", "mesh"):
            sentences.append(f"{name}.size is set and has no effect: a {obstacle.shape} has no size")
        elif f"{name}.mesh" in chosen and obstacle.shape != "mesh":
            sentences.append(f"{name}.mesh is set and has no effect: {name}.shape is {obstacle.shape}; set it to mesh")
        elif f"{name}.scale" in chosen and obstacle.shape != "mesh":
            sentences.append(f"{name}.scale is set and has no effect: a {obstacle.shape} has no mesh")
    return sentences
