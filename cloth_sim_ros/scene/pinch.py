# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pads of a scene's grippers that pinch."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import attrs

from cloth_sim_ros.scene import parameters, sections
from cloth_sim_ros.scene.parameters import NAME, Parameter, ParameterError

if TYPE_CHECKING:
    from cloth_sim_ros.physics.pinch import Pads


#: What says how one gripper holds.
_LEAF = "mode"


def mode_of(name: str) -> Parameter:
    """The parameter that says how a gripper of a name holds, instead of `gripper.mode`."""
    return attrs.evolve(
        next(entry for entry in parameters.declared(sections.Gripper, "gripper.") if entry.name == "gripper.mode"),
        name=f"{name}.{_LEAF}",
        description="How this gripper holds, instead of gripper.mode",
    )


def with_modes(names: Iterable[str], groups: Collection[str]) -> list[str]:
    """Return the grippers that full names give a mode of their own, in their order.

    Args:
        names: full names.
        groups: first parts of the names of all other parameters.
    """
    split = [name.rpartition(".") for name in names]
    return [name for name, _, leaf in split if leaf == _LEAF and NAME.fullmatch(name) and name not in groups]


def modes(values: Mapping[str, Any], groups: Collection[str]) -> dict[str, str]:
    """Return the modes of grippers that have their own, by name, of checked values by full name."""
    return {name: values[f"{name}.{_LEAF}"] for name in with_modes(values, groups)}


def check_modes(modes: Iterable[str], grippers: Sequence[str]) -> None:
    """Refuse a mode of a gripper that is not there.

    Raises:
        ParameterError: naming it.
    """
    for name in modes:
        if name not in grippers:
            raise ParameterError(
                f"{name}.{_LEAF} is set, and there is no gripper '{name}'; there are {', '.join(grippers) or 'none'}"
            )


class Configuration(Protocol):
    """What of a `Scene` pads are made of."""

    @property
    def gripper(self) -> sections.Gripper: ...

    @property
    def pinching(self) -> list[str]: ...


def pads_of(scene: Configuration, mass: float) -> list[Pads]:
    """Return the pads of each gripper that pinches a cloth of a mass [kg].

    Raises:
        ParameterError: for values that make none.
    """
    if not scene.pinching:
        return []
    from cloth_sim_ros.physics.pinch import Pads, inertia

    gripper = scene.gripper
    if len(gripper.friction) not in (1, 2):
        raise ParameterError(
            f"gripper.friction has {len(gripper.friction)} entries, {list(gripper.friction)}; give one number, or that "
            "at rest and that in motion"
        )
    try:
        return [
            Pads(
                gripper=name,
                size=gripper.pad_size,
                friction=(gripper.friction[0], gripper.friction[-1]),
                force=gripper.force,
                speed=gripper.speed,
                opening=gripper.opening,
                inertia=inertia(mass, gripper.force, gripper.speed),
            )
            for name in scene.pinching
        ]
    except ValueError as error:
        raise ParameterError(str(error)) from error
