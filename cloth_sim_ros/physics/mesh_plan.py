# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The fused plan of whatever has no regular grid: whole leapfrog runs of listed springs and hinges in one compiled
loop.

Inside it particles stand in an order of locality (`ordering`). A run takes positions and velocities in at its start
and gives them back at its end, so nobody outside sees that order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cloth_sim_ros.physics.dynamics import THOROUGH, Economy
from cloth_sim_ros.physics.integrators.march import leapfrog_by_terms
from cloth_sim_ros.physics.kernels.mesh_leapfrog import MeshGrips, MeshLeapfrog, MeshPanels, Springs
from cloth_sim_ros.physics.ordering import local_order
from cloth_sim_ros.physics.terms.air_panels import AirPanels
from cloth_sim_ros.physics.terms.altitude import AltitudeSprings
from cloth_sim_ros.physics.terms.base import Term
from cloth_sim_ros.physics.terms.crossed import CrossedSprings
from cloth_sim_ros.physics.terms.deferred_springs import DeferredSprings
from cloth_sim_ros.physics.terms.drag import Drag
from cloth_sim_ros.physics.terms.gravity import Gravity
from cloth_sim_ros.physics.terms.grips import Grips, WrenchObserver
from cloth_sim_ros.physics.terms.opposite import OppositeSprings
from cloth_sim_ros.physics.terms.pair_springs import PairSprings
from cloth_sim_ros.physics.terms.wind import Wind

if TYPE_CHECKING:
    from cloth_sim_ros.physics.dynamics import Dynamics
    from cloth_sim_ros.physics.integrators.base import Observer
    from cloth_sim_ros.physics.terms.base import Array

#: Kinds of terms that it takes over; one of a kind derived from these may do something else.
_KINDS = (
    PairSprings,
    DeferredSprings,
    OppositeSprings,
    CrossedSprings,
    AltitudeSprings,
    AirPanels,
    Gravity,
    Wind,
    Drag,
    Grips,
)

#: Cost of moving a particle, of a spring, a hinge of S8, one of S9 and a panel [ns]. Measured once; constants, so that
#: what is chosen by them is the same on any machine.
_MOVE, _EACH = 3.0, (2.0, 8.0, 12.0, 10.0)


class MeshPlan:
    """Takes over the leapfrog of a model; equal to the sum of its terms to rounding.

    Wrenches come out of the compiled loop; any other observer watches a copy of the run that goes by terms beside it,
    so that it changes no bit of this one.

    Args:
        dynamics: the equations; `fits` says whether they can be taken over.
        reorder: whether to look for an order of locality; what comes out is the same to rounding.
    """

    @staticmethod
    def fits(dynamics: Dynamics) -> bool:
        """Whether the model has pair springs, hinges, air, gravity, drag and grips alone."""
        return all(type(term) in _KINDS for term in dynamics.model.terms)

    def __init__(self, dynamics: Dynamics, *, reorder: bool = True) -> None:
        self._dynamics = dynamics
        model = dynamics.model
        pairs = _springs(model.terms, PairSprings)
        crossed, altitude = (_springs(model.terms, kind) for kind in (CrossedSprings, AltitudeSprings))
        pushes = [term.acceleration for term in model.terms if isinstance(term, Gravity | Wind)]
        drag = sum(term.rate for term in model.terms if isinstance(term, Drag))
        air = [term for term in model.terms if isinstance(term, AirPanels)]
        panels = _panels(air[0]) if air else None
        grips = [term for term in model.terms if isinstance(term, Grips)]
        self._grips = grips[0] if grips else None
        counts = [len(springs.particles) for springs in (pairs, crossed, altitude)]
        counts.append(0 if panels is None else len(panels.particles))
        self._cost = _MOVE + sum(c * k for c, k in zip(_EACH, counts, strict=True)) / model.particle_count
        groups = [crossed.particles, altitude.particles, *([] if panels is None else [panels.particles])]
        neighbours = [pairs.particles, *(_edges(group) for group in groups)]
        self._loop = MeshLeapfrog(
            model.inverse_masses,
            pairs=pairs,
            crossed=crossed,
            altitude=altitude,
            panels=panels,
            gravity=np.sum(pushes, axis=0) if pushes else None,
            drag=drag,
            order=local_order(model.particle_count, np.concatenate(neighbours)) if reorder else None,
        )
        taken = frozenset(term.name for term in model.terms if isinstance(term, PairSprings))
        #: Bounds of the springs, where there are none but these; in the order of the loop.
        self.bounds = self._loop.bounds(taken)

    @property
    def step_cost(self) -> float:
        """Estimated cost of a step for one particle [ns]."""
        return self._cost

    def leapfrog(
        self,
        t: float,
        x: Array,
        v: Array | None,
        step: float,
        steps: int,
        observer: Observer | None,
        weight: float,
        *,
        economy: Economy = THOROUGH,
        start: tuple[Array, Array] | None = None,
    ) -> None:
        """Advance x, v (3, n) in place, or from `start`, see `integrators.march.leapfrog`, from time t by so many steps
        [s]; the observer's weights are multiplied by weight. `economy` makes no difference.
        """
        wrenches = observer if isinstance(observer, WrenchObserver) else None
        if observer is not None and wrenches is None:
            x0, v0 = (x, v) if start is None else start
            assert v0 is not None
            leapfrog_by_terms(self._dynamics, t, x0.copy(), v0.copy(), step, steps, observer, weight)
        booked = self._loop.advance(t, x, v, steps, step, grips=self._held(), start=start)
        if wrenches is not None:
            wrenches.add_booked(booked, weight * step * steps, weight)

    def narrows(self) -> bool:
        """False: there is no loop in single precision."""
        return False

    #: Weak springs are taken at every step.
    alternate_share = 0.0

    def alternate_stiffest(self) -> float:
        """Bound of the squared frequency [1/s^2] up to which they would not have to be: there is none."""
        return 0.0

    def _held(self) -> MeshGrips | None:
        grips = self._grips
        if grips is None or not grips.particles.size:
            return None
        return MeshGrips(
            paths=grips.paths,
            starts=grips.starts,
            particles=grips.particles,
            offsets=grips.offsets,
            stiffness=grips.stiffness,
            damping=grips.damping,
        )


def _springs(terms: tuple[Term, ...], kind: type[PairSprings | CrossedSprings | AltitudeSprings]) -> Springs:
    """All springs, or hinges, of the terms of a kind."""
    width = 2 if kind is PairSprings else 4
    parts = []
    for term in terms:
        if not isinstance(term, kind):
            continue
        # The loop has tables of its own: lists that nobody asked for yet are not kept for it.
        lists = term.made() if isinstance(term, DeferredSprings) else term
        parts.append(
            Springs(
                particles=lists.pairs if isinstance(lists, PairSprings) else lists.hinges,
                rest=lists.rest_length,
                stiffness=lists.stiffness,
                damping=lists.damping,
            )
        )
    return Springs.joined(parts, width)


def _panels(term: AirPanels) -> MeshPanels:
    return MeshPanels(particles=term.panels, normal=term.normal, tangential=term.tangential, wind=term.wind)


def _edges(groups: np.ndarray) -> np.ndarray:
    """All pairs of particles within each row."""
    width = groups.shape[1]
    return np.concatenate([groups[:, [i, j]] for i in range(width) for j in range(i + 1, width)])
