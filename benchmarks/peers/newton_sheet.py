# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Newton on Warp, on the processor: the sheet's own springs, in single precision; it has no drag of the air."""

from __future__ import annotations

from typing import Any

import numpy as np

#: Of the iterative solvers.
_ITERATIONS = 10


class Engine:
    """See `runner`; variants semi_implicit, xpbd and vbd."""

    distributions = ("newton", "warp-lang")

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        import newton
        import warp

        warp.config.quiet = True
        self._warp = warp
        builder = newton.ModelBuilder()
        builder.gravity = tuple(sheet["gravity"].tolist())
        positions = [tuple(place) for place in sheet["positions"].tolist()]
        masses = np.where(sheet["anchored"], 0.0, sheet["masses"])
        builder.add_particles(positions, [(0.0, 0.0, 0.0)] * len(positions), masses.tolist())
        springs = zip(sheet["pairs"].tolist(), sheet["stiffness"].tolist(), sheet["damping"].tolist(), strict=True)
        for (near, far), stiffness, damping in springs:
            builder.add_spring(near, far, stiffness, damping, 0.0)
        if variant == "vbd":
            # Particles of one colour are moved at once, so no spring may join two: three by three has room for all six
            # directions. Newton colours triangles by itself, springs not.
            rows, columns = np.divmod(np.arange(len(positions)), int(sheet["columns"]))
            colour = rows % 3 * 3 + columns % 3
            builder.set_coloring([np.flatnonzero(colour == which) for which in range(9)])
        with warp.ScopedDevice("cpu"):
            model = builder.finalize()
            # Particles would else be balls that push each other away.
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

            # This compiles; the states that follow are those of the start.
            first, second = model.state(), model.state()
            once(first, second)
            self._states = model.state(), model.state()
            # Steps recorded once run without Python between their kernels: three times as fast on a small sheet.
            self._graphs = []
            for before, after in (self._states, self._states[::-1]):
                with warp.ScopedCapture() as capture:
                    once(before, after)
                self._graphs.append(capture.graph)
        self._turn = 0

    def advance(self, steps: int) -> None:
        """Take so many steps."""
        for _ in range(steps):
            self._warp.capture_launch(self._graphs[self._turn])
            self._turn ^= 1

    def positions(self) -> Any:
        """Positions [m]."""
        return self._states[self._turn].particle_q.numpy().astype(np.float64)

    def remarks(self) -> list[str]:
        """Nothing to add."""
        return []
