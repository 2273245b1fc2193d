# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine Newton (Warp) on the CPU: the sheet's springs in single precision, without air drag."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

#: Solver iterations per step, and steps between rebuilds of the bounding volume tree, as in its examples.
_ITERATIONS, _REBUILD_PERIOD = 10, 10
#: Stiffness [N/m] and damping [N s/m] of contact, and range of self-contact beyond the margin [margins], as in its
#: example of a twisted cloth, whose areal density is the same.
_STIFFNESS, _DAMPING, _FURTHER = 1e3, 1e-1, 0.75


class NewtonEngine:
    """See `runner`; variants semi_implicit, xpbd and vbd."""

    distributions = ("newton", "warp-lang")

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        newton, builder = self._begin(sheet)
        warp = self._warp
        positions = [tuple(position) for position in sheet["positions"].tolist()]
        masses = np.where(sheet["anchored"], 0.0, sheet["masses"])
        builder.add_particles(positions, [(0.0, 0.0, 0.0)] * len(positions), masses.tolist())
        springs = zip(sheet["pairs"].tolist(), sheet["stiffness"].tolist(), sheet["damping"].tolist(), strict=True)
        for (first, second), stiffness, damping in springs:
            builder.add_spring(first, second, stiffness, damping, 0.0)
        if variant == "vbd":
            # Particles of one colour are moved at once, so no spring may join two of them. Blocks of 3 x 3 colours
            # suffice for all six spring directions. Newton colours triangles itself, but not springs.
            rows, columns = np.divmod(np.arange(len(positions)), int(sheet["columns"]))
            colour = rows % 3 * 3 + columns % 3
            builder.set_coloring([np.flatnonzero(colour == which) for which in range(9)])
        with warp.ScopedDevice("cpu"):
            model = builder.finalize()
            # Otherwise particles act as balls that repel each other.
            model.particle_grid, model.particle_max_radius = None, 0.0
            solvers = {
                "semi_implicit": lambda: newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False),
                "xpbd": lambda: newton.solvers.SolverXPBD(model, iterations=_ITERATIONS),
                "vbd": lambda: newton.solvers.SolverVBD(model, iterations=_ITERATIONS),
            }
            self._solver = solvers[variant]()
            control = model.control()

            def once(before: Any, after: Any) -> None:
                before.clear_forces()
                self._solver.step(before, after, control, None, step)

            self._record(model, once)
        self._turn = 0

    def _begin(self, sheet: dict[str, Any]) -> tuple[Any, Any]:
        """Import the engine; return its module and the builder of a model."""
        import newton
        import warp

        warp.config.quiet = True
        self._warp = warp
        builder = newton.ModelBuilder()
        builder.gravity = tuple(sheet["gravity"].tolist())
        return newton, builder

    def _record(self, model: Any, once: Callable[[Any, Any], None]) -> None:
        """Record a step from either state to the other; a small sheet is 3 times faster without Python in between."""
        # The first step compiles; the states that follow are the initial ones.
        first, second = model.state(), model.state()
        once(first, second)
        self._states = model.state(), model.state()
        self._launches: list[Callable[[], None]] = []
        for before, after in (self._states, self._states[::-1]):
            with self._warp.ScopedCapture() as capture:
                once(before, after)
            self._launches.append(partial(self._warp.capture_launch, capture.graph))

    def advance(self, steps: int) -> None:
        """Take some steps."""
        for _ in range(steps):
            self._launches[self._turn]()
            self._turn ^= 1

    def positions(self) -> Any:
        """Positions [m], (n, 3)."""
        return self._states[self._turn].particle_q.numpy().astype(np.float64)


class NewtonContactEngine(NewtonEngine):
    """Scenes with contact by penalties: a shell of triangles; variants vbd and style3d."""

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        newton, builder = self._begin(sheet)
        warp = self._warp
        self._held, self._active = sheet["held"], int(newton.ParticleFlags.ACTIVE)
        thickness, friction = float(sheet["thickness"]), float(sheet["friction"])
        modulus, retardation, bending = (float(sheet[name]) for name in ("modulus", "retardation", "bending"))
        solid = newton.ModelBuilder.ShapeConfig(ke=_STIFFNESS, kd=_DAMPING, mu=friction)
        self._pads = self._add_solids(builder, sheet, solid, warp)
        cloth = {
            "pos": warp.vec3(0.0, 0.0, 0.0),
            "rot": warp.quat_identity(),
            "scale": 1.0,
            "vel": warp.vec3(0.0, 0.0, 0.0),
            "vertices": [warp.vec3(*position) for position in sheet["positions"].tolist()],
            "indices": sheet["triangles"].ravel().tolist(),
            "density": 1.0,
            "particle_radius": thickness,
        }
        if variant == "style3d":
            newton.solvers.SolverStyle3D.register_custom_attributes(builder)
            newton.solvers.style3d.add_cloth_mesh(
                builder,
                **cloth,
                panel_verts=_panel(sheet["positions"], sheet["triangles"]).tolist(),
                tri_aniso_ke=warp.vec3(modulus, modulus, 0.5 * modulus),
                edge_aniso_ke=warp.vec3(bending, bending, bending),
            )
        else:
            # Lame's constants of a membrane of the modulus along the threads, with zero Poisson ratio. Its damping
            # acts on the rate of the metric, twice that of the strain, hence a quarter of the viscosity. A hinge turns
            # by the curvature times the spacing.
            hinge = bending / float(sheet["edge_lengths"][0])
            membrane = {"tri_ke": 0.5 * modulus, "tri_ka": 0.0, "tri_kd": 0.25 * modulus * retardation}
            builder.add_cloth_mesh(**cloth, **membrane, edge_ke=hinge, edge_kd=hinge * retardation)
            builder.color(include_bending=True)
        # Masses of the product, which differ from thirds of triangles at the border.
        builder.particle_mass[:] = sheet["masses"].tolist()
        with warp.ScopedDevice("cpu"):
            model = builder.finalize()
            model.particle_grid, model.particle_max_radius = None, 0.0
            model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = _STIFFNESS, _DAMPING, friction
            self._flags = model.particle_flags.numpy()
            self._flags[self._held] &= ~self._active
            self._flags[sheet["anchored"]] &= ~self._active
            if variant == "style3d":
                solver = newton.solvers.SolverStyle3D(model)
                # Layers keep twice its radius.
                solver.collision.radius = 0.5 * thickness
                if not sheet["own"]:
                    solver.collision.stiff_vf = solver.collision.stiff_ee = solver.collision.stiff_ef = 0.0
            else:
                self_contact = {"particle_self_contact_margin": thickness}
                self_contact["particle_self_contact_gap"] = _FURTHER * thickness
                solver = newton.solvers.SolverVBD(
                    model,
                    iterations=_ITERATIONS,
                    particle_enable_self_contact=bool(sheet["own"]),
                    **(self_contact if sheet["own"] else {}),
                )
            pipeline = newton.CollisionPipeline(model)
            contacts, control = pipeline.contacts(), model.control()

            def once(before: Any, after: Any) -> None:
                pipeline.collide(before, contacts)
                solver.step(before, after, control, contacts, step)

            if variant == "style3d":
                # It asks for results in between, so that its steps cannot be recorded.
                self._states = model.state(), model.state()
                self._launches = [partial(once, *self._states), partial(once, *self._states[::-1])]
                once(model.state(), model.state())
            else:
                self._record(model, once)
        self._solver, self._self_contact = solver, bool(sheet["own"])
        self._turn = self._n_steps = 0
        self._path: Any = iter(())
        # On the CPU these arrays share the engine's memory.
        self._places = [state.particle_q.numpy() for state in self._states]
        self._speeds = [state.particle_qd.numpy() for state in self._states]
        self._forces = [state.particle_f.numpy() for state in self._states]
        self._drag = -float(sheet["drag"]) * sheet["masses"][:, None]

    @staticmethod
    def _add_solids(builder: Any, sheet: dict[str, Any], solid: Any, warp: Any) -> np.ndarray:
        """Add obstacles; return the positions of the pads [m], (pads, 3)."""
        if sheet["kind"] == "drape":
            builder.add_shape_sphere(-1, radius=float(sheet["radius"]), cfg=solid)
        elif sheet["kind"] == "fold":
            builder.add_ground_plane(cfg=solid)
        elif sheet["kind"] == "pinch":
            half = 0.5 * sheet["pad_size"]
            away = np.abs(sheet["positions"] - sheet["pad_places"].mean(axis=0))
            between = int(((away[:, 0] <= half[0]) & (away[:, 2] <= half[2])).sum())
            # Depth at which the penalties equal the force of a pad.
            deep = float(sheet["force"]) / (_STIFFNESS * between)
            places = sheet["pad_places"].copy()
            places[:, 1] = np.sign(places[:, 1]) * (float(sheet["thickness"]) - deep + half[1])
            for position in places.tolist():
                where = warp.transform(warp.vec3(*position), warp.quat_identity())
                hx, hy, hz = half.tolist()
                builder.add_shape_box(-1, xform=where, hx=hx, hy=hy, hz=hz, cfg=solid)
            return places
        return np.zeros((0, 3))

    def lead(self, begin: Any, end: Any, steps: int) -> None:
        """Move held particles in the next steps."""
        self._path = iter([begin + (k + 1) / steps * (end - begin) for k in range(steps)])

    def let_go(self) -> None:
        """Release the held particles from rest."""
        self._flags[self._held] |= self._active

    def advance(self, steps: int) -> None:
        """Take some steps."""
        for _ in range(steps):
            if self._self_contact and self._n_steps % _REBUILD_PERIOD == 0:
                self._solver.rebuild_bvh(self._states[self._turn])
            target = next(self._path, None)
            if target is not None:
                self._places[self._turn][self._held] = target
                self._places[1 - self._turn][self._held] = target
            self._forces[self._turn][:] = self._drag * self._speeds[self._turn]
            self._launches[self._turn]()
            self._turn ^= 1
            self._n_steps += 1

    def positions(self) -> Any:
        """Positions [m], (n, 3)."""
        return self._places[self._turn].astype(np.float64)

    def pads(self) -> Any:
        """Positions of the pads [m], (pads, 3)."""
        return self._pads


def _panel(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the coordinates in the plane of a flat sheet [m], (n, 2), with triangles of positive area."""
    plane = positions[:, np.sort(np.argsort(np.ptp(positions, axis=0))[1:])]
    a, b, c = plane[triangles[0]]
    (ux, uy), (vx, vy) = b - a, c - a
    return plane if ux * vy > uy * vx else plane * [-1.0, 1.0]
