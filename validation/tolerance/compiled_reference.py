# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reference solution: a model's equations of motion and an integrator of order 8 in C.

`compiled_reference.c` contains both and none of the engine's code. The machine's C compiler builds it at first use. The
model supplies lists only: particles and coefficients of springs, and masses. `LANES` trajectories of one system advance
in the same steps: the solution and perturbed copies of it. Therefore their deviations grow by the equations, not by
differences of steps.
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from support.reference_kernel import compiled, find_compiler

from cloth_sim_ros import (
    AddedMass,
    AirPanels,
    AltitudeSprings,
    BendingFriction,
    CrossedSprings,
    Drag,
    Gravity,
    GridSprings,
    Grips,
    MembraneTriangles,
    Model,
    PairSprings,
    QuadraticHinges,
    Wind,
)
from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.model.forces.couplings import Couplings
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.hinge_springs import HingeSprings
from cloth_sim_ros.physics.model.parts import ElementList

#: Trajectories side by side: the solution and `LANES` - 1 perturbed ones.
LANES = 4
#: Size of a perturbation: of positions [m], or of velocities [m/s].
PERTURBATION = 1e-9
#: Local error of a perturbed trajectory's deviation, relative to the deviation.
DEVIATION_TOLERANCE = 1e-4
FLAGS = ("-O3", "-march=native", "-std=gnu11", "-fPIC", "-fno-math-errno", f"-DLANES={LANES}")

_SOURCE = Path(__file__).with_name("compiled_reference.c")
#: Kinds of elements in the order of struct `System`, and the cost of one relative to that of a spring.
_KINDS = {"springs": 1, "joints": 1, "crossed": 4, "altitudes": 6, "quadratics": 2, "frictions": 4, "membranes": 3}
_KINDS |= {"panels": 3, "held": 0}
_C_TYPES: dict[str, Any] = {"int64_t": ctypes.c_int64, "double": ctypes.c_double}


@cache
def _c_struct(name: str) -> type[Any]:
    """Return a struct of compiled_reference.c, the only declaration of its fields."""
    declarations = re.sub(r"/\*.*?\*/", "", _SOURCE.read_text(), flags=re.DOTALL)
    (body,) = re.findall(rf"typedef struct {{([^}}]*)}} {name};", declarations)
    fields = []
    for declared_type, declared_names in re.findall(r"(?:const )?(\w+) ([^;]+);", body):
        for pointer, field, shape in re.findall(r"(\*?)(\w+)((?:\[\d+\])*)", declared_names):
            c_type = ctypes.c_void_p if pointer else _C_TYPES.get(declared_type) or _c_struct(declared_type)
            fields.append((field, c_type * math.prod(map(int, re.findall(r"\d+", shape))) if shape else c_type))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


@attrs.frozen(eq=False, kw_only=True)
class GripTable:
    """Particles that grippers hold over one frame, and the grippers' paths."""

    #: Path of each gripper, shape (gripper_count, PATH_NUMBERS), see `Grips`.
    paths: Array
    #: Gripper of each grip, shape (m,).
    grippers: NDArray[np.int64]
    #: Held particles, shape (m,).
    particles: NDArray[np.int64]
    #: k [N/m] and k_d [N s/m], shape (m, 2).
    numbers: Array
    #: Points in their gripper's frame [m], of each trajectory, shape (m, 3, LANES).
    offsets: Array


class ReferenceFailureError(RuntimeError):
    """The reference fails: no step is small enough, or it needs too many evaluations."""


@cache
def _library() -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        raise ValueError("no C compiler found: the reference is compiled at run time; set $CC or install gcc")
    library = compiled(_SOURCE, FLAGS, compiler=compiler)
    pointer, double = ctypes.c_void_p, ctypes.c_double
    library.accelerations.argtypes = [pointer, double, pointer, pointer, pointer]
    library.accelerations.restype = None
    library.advance.argtypes = [pointer, pointer, pointer, double, pointer, pointer]
    library.advance.restype = ctypes.c_int
    return library


@cache
def _method() -> Any:
    from scipy.integrate._ivp import dop853_coefficients as table

    method, stages = _c_struct("Method")(), table.A[:12, :12]
    method.c[:] = table.C[:12].tolist()
    weights = {"a": stages, "b": table.B, "third": table.E3[:12], "fifth": table.E5[:12]}
    for name, array in weights.items():
        getattr(method, name)[:] = array.ravel().tolist()
        getattr(method, f"{name}_place")[:] = (array @ stages).ravel().tolist()
    return method


class ReferenceSystem:
    """The equations of motion of a model.

    Args:
        model: supplies lists of springs, hinges, panels and masses, but no force values.

    Raises:
        ValueError: for an unknown force, or without a C compiler.
    """

    def __init__(self, model: Model) -> None:
        self._library = _library()
        self.model = model
        self._arrays: list[Any] = []
        self._c = system = _c_struct("System")(particles=model.particle_count, corners=3)
        system.inverse_mass = self._store_array(model.inverse_masses, np.float64)
        pairs, lists = list[PairSprings](), dict[str, list[HingeSprings]](crossed=[], altitude=[])
        couplings = list[Couplings]()
        #: Plastic lengths of each trajectory [m], shape (hinges, LANES); none without friction of bending.
        self.plastic_lengths: Array = np.empty((0, LANES))
        for force in model.forces:
            if isinstance(force, GridSprings | PairSprings):
                pairs.append(force.pair_springs if isinstance(force, GridSprings) else force)
            elif isinstance(force, CrossedSprings | AltitudeSprings):
                lists[force.kind].append(force)
            elif isinstance(force, Couplings):
                couplings.append(force)
            elif isinstance(force, QuadraticHinges):
                self._set_quadratics(force)
            elif isinstance(force, BendingFriction):
                self._set_friction(force)
            elif isinstance(force, MembraneTriangles):
                self._set_membrane(force)
            elif isinstance(force, Gravity | Wind):
                for axis in range(3):
                    system.push[axis] += float(force.acceleration[axis])
            elif isinstance(force, Drag):
                system.drag += force.rate
            elif isinstance(force, AddedMass):
                self._set_added_mass(force)
            elif isinstance(force, AirPanels):
                self._set_panels(force)
            elif not isinstance(force, Grips):
                raise ValueError(f"the reference does not know the force '{force.name}'")
        self._set_pairs(pairs, couplings)
        self._set_hinges(lists["crossed"], "crossed")
        self._set_hinges(lists["altitude"], "altitudes")

    def _store_array(self, array: Any, dtype: type) -> int:
        """Store a copy of an array as long as the system lives; return its address."""
        copy: NDArray[Any] = np.array(array, dtype=dtype, order="C")
        self._arrays.append(copy)
        return int(copy.ctypes.data)

    def _set_elements(self, kind: str, particles: Any, numbers: Any) -> None:
        """Set all elements of a kind: their particles, shape (m, corners), and constants, shape (m, constants)."""
        addresses = self._store_array(particles, np.int64), self._store_array(numbers, np.float64)
        setattr(self._c, kind, _c_struct("Elements")(len(particles), *addresses))

    def _set_pairs(self, lists: Sequence[PairSprings], couplings: Sequence[Couplings]) -> None:
        """Set springs and joints. A coupling is a joint, whose constant may be negative."""
        rest_length, stiffness, damping = (
            np.concatenate([np.empty(0), *(getattr(springs, name) for springs in lists)])
            for name in ("rest_length", "stiffness", "damping")
        )
        ends = np.concatenate([np.empty((0, 2), dtype=np.int64), *(springs.pairs for springs in lists)])
        is_joint = rest_length == 0.0
        is_spring = ~is_joint
        joint_ends = np.concatenate([ends[is_joint], *(coupling.pairs for coupling in couplings)])
        joint_numbers = [np.stack([stiffness[is_joint], damping[is_joint]], axis=1)]
        joint_numbers += [np.outer(coupling.constants, [1.0, coupling.damping_time]) for coupling in couplings]
        spring_lengths = rest_length[is_spring]
        coefficients = np.stack([stiffness[is_spring] / spring_lengths, spring_lengths, damping[is_spring]], axis=1)
        self._set_elements("springs", ends[is_spring], coefficients)
        self._set_elements("joints", joint_ends, np.concatenate(joint_numbers))

    def _set_quadratics(self, force: QuadraticHinges) -> None:
        constants = np.stack([force.stiffness, np.full(len(force.hinges), force.damping_time)], axis=1)
        self._set_elements("quadratics", force.hinges, np.concatenate([force.weights, constants], axis=1))

    def _set_friction(self, force: BendingFriction) -> None:
        self._set_elements("frictions", force.hinges, np.stack([force.stiffness, force.reach], axis=1))
        self.plastic_lengths = np.repeat(force.rest_length[:, None], LANES, axis=1)
        self._c.plastic_lengths = self.plastic_lengths.ctypes.data

    def _set_membrane(self, force: MembraneTriangles) -> None:
        (elements,) = [part for part in force.parts(self.model.particle_count) if isinstance(part, ElementList)]
        self._set_elements("membranes", force.triangles, force.coefficients)
        moduli, shared = np.zeros(14), np.asarray(elements.shared_coefficients)
        moduli[: shared.size] = shared
        self._c.membrane_moduli = self._store_array(moduli, np.float64)

    def _set_hinges(self, lists: Sequence[HingeSprings], kind: str) -> None:
        if lists:
            particles = np.concatenate([hinges.hinges for hinges in lists])
            numbers = [np.stack([hinges.rest_length, hinges.stiffness, hinges.damping], axis=1) for hinges in lists]
            self._set_elements(kind, particles, np.concatenate(numbers))

    def _set_panels(self, force: AirPanels | AddedMass) -> None:
        system = self._c
        self._set_elements("panels", force.panels, np.empty(0))
        system.corners = force.panels.shape[1]
        system.wind[:] = force.wind.tolist()
        if isinstance(force, AirPanels):
            system.normal, system.tangential = force.normal, force.tangential

    def _set_added_mass(self, force: AddedMass) -> None:
        """Set the mass of the air at the panels, the same as those of drag."""
        self._set_panels(force)
        self._c.added_mass = force.density
        self._c.blocks = self._store_array(np.zeros((self.model.particle_count, 6, LANES)), np.float64)

    @property
    def evaluation_cost(self) -> float:
        """Cost of one evaluation relative to that of one spring."""
        elements = sum(cost * getattr(self._c, kind).count for kind, cost in _KINDS.items())
        return float(elements + 4 * self.model.particle_count)

    def set_grasped(self, grasped: GripTable | None, t: float) -> None:
        """Set the grasped particles from time t [s] on, which becomes the time origin."""
        system = self._c
        if grasped is None or not len(grasped.particles):
            system.held = _c_struct("Elements")()
            return
        if len(grasped.paths) > len(system.shift) or grasped.paths.shape[1] != PATH_NUMBERS:
            raise ValueError(f"paths have shape {grasped.paths.shape}; there are {len(system.shift)} grippers at most")
        # The arrays must live as long as the system has their addresses.
        self._grasp_arrays = [
            np.ascontiguousarray(grasped.particles, dtype=np.int64),
            np.ascontiguousarray(grasped.grippers, dtype=np.int64),
            *(np.ascontiguousarray(a, dtype=np.float64) for a in (grasped.numbers, grasped.offsets, grasped.paths)),
        ]
        particles, grippers, numbers, offsets, paths = (array.ctypes.data for array in self._grasp_arrays)
        system.held = _c_struct("Elements")(len(grasped.particles), particles, numbers)
        system.held_grippers, system.held_offsets, system.paths = grippers, offsets, paths
        system.shift[: len(grasped.paths)] = (t - grasped.paths[:, 0]).tolist()

    def set_plastic_lengths(self, lengths: Array) -> None:
        """Set the plastic lengths of hinges with friction [m], (m,) or of each trajectory (m, LANES)."""
        self.plastic_lengths[:] = lengths if lengths.ndim == 2 else lengths[:, None]

    def accelerations(self, x: Array, v: Array, *, since: float = 0.0) -> Array:
        """Return accelerations (3, n) [m/s^2] at x and v (3, n), a time `since` [s] after the frame's start."""
        n = self.model.particle_count
        y = trajectories(x, v)
        out = np.empty((n, 3, LANES))
        half = y[1].ctypes.data
        self._library.accelerations(ctypes.addressof(self._c), since, y.ctypes.data, half, out.ctypes.data)
        return np.ascontiguousarray(out[:, :, 0].T)


def trajectories(x: Array, v: Array) -> Array:
    """Return `LANES` copies of positions and velocities (3, n), shape (2, n, 3, LANES)."""
    y = np.stack([x.T, v.T])
    return np.ascontiguousarray(np.repeat(y[..., None], LANES, axis=-1))


class Integration:
    """One run of a system's trajectories.

    Args:
        system: the equations.
        y: initial positions and velocities, (2, n, 3, LANES); advanced in place.
        tolerance: local error of the solution [m], [m/s].
        max_evaluations: largest number of evaluations in one call of `advance`.
        max_step: longest step [s]; 0 for no limit.
    """

    def __init__(
        self,
        system: ReferenceSystem,
        y: Array,
        *,
        tolerance: float,
        max_evaluations: int = 1 << 40,
        max_step: float = 0.0,
    ) -> None:
        self.system, self.y = system, y
        self._control = _c_struct("Control")(
            tolerance=tolerance,
            kick=PERTURBATION,
            share=DEVIATION_TOLERANCE,
            longest=max_step,
            most=max_evaluations,
        )
        self._work = np.empty(7 * y.size)

    @property
    def evaluations(self) -> int:
        """Evaluations so far."""
        return int(self._control.evaluations)

    def advance(self, duration: float) -> None:
        """Advance by a duration [s] with the system's grasped particles.

        Raises:
            ReferenceFailureError: if no step is small enough, or it needs too many evaluations.
        """
        addresses = ctypes.addressof(self.system._c), ctypes.addressof(_method()), ctypes.addressof(self._control)
        library = self.system._library
        status = library.advance(*addresses, duration, self.y.ctypes.data, self._work.ctypes.data)
        if status:
            reason = "finds no step" if status == 1 else f"needs more than {self._control.most} evaluations"
            raise ReferenceFailureError(f"the reference {reason} for {duration:g} s")

    @property
    def positions(self) -> Array:
        """Positions of the solution [m], (3, n)."""
        return np.ascontiguousarray(self.y[0, :, :, 0].T)

    def deviations(self) -> Array:
        """Return the largest particle distance of each perturbed trajectory from the solution (LANES - 1,) [m]."""
        offsets = self.y[0, :, :, 1:] - self.y[0, :, :, :1]
        return np.asarray(np.sqrt(np.sum(offsets * offsets, axis=1).max(axis=0)))
