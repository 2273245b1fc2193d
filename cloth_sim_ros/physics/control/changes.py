# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Change rule: contact, friction, hinges and strains at a limit that the last error estimate did not contain.

Activity and differences of runs, by which errors are predicted, do not show them. Their errors are estimated from the
motion of a piece. If they displace by more than its target error, the piece needs an estimate. Derivation:
docs/derivations/changes.md.
"""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.error import displacement_by_velocities
from cloth_sim_ros.physics.control.frame_totals import Piece
from cloth_sim_ros.physics.control.work_budget import WorkBudget
from cloth_sim_ros.physics.integrators.extrapolation_tableau import VELOCITY_ERROR_TIME, ExtrapolationTableau
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import ChangeState


class ChangeRule:
    """Rule that compares contact, friction and hinges in a piece with those in the last error estimate.

    Args:
        plan: equations of motion.
        known: state of the rule.
        work: counts the evaluations of displacements.
        may_touch: True if contact is expected within the advance.
    """

    __slots__ = (
        "_jerk_displacement",
        "_plan",
        "_work",
        "has_new_contact",
        "is_unexpected",
        "kink_error",
        "known",
        "may_jump",
        "may_kink",
        "may_touch",
    )

    def __init__(self, plan: Plan, known: ChangeState, work: WorkBudget, *, may_touch: bool) -> None:
        self._plan, self.known, self._work = plan, known, work
        #: True if contact is expected; and if the last piece touched although it was not.
        self.may_touch, self.is_unexpected = may_touch, False
        #: True if the last piece has contact that the last error estimate did not contain.
        self.has_new_contact = False
        #: Displacement [m] by the jerk of the last piece; 0 below its target error.
        self._jerk_displacement = 0.0
        #: True if friction may jump within the last piece, or contact begin or end, beyond the piece's target error.
        self.may_jump = self.may_kink = False
        #: Displacement [m] by kinks of stiffening and friction of bending that all runs may miss; 0 below the target.
        self.kink_error = 0.0

    def compare(
        self, tableau: ExtrapolationTableau, piece: Piece, n_runs: int, target: float, *, energy_alone: bool
    ) -> tuple[bool, ChangeState]:
        """Return True if a piece contains what may displace by more than its target error, and what it contains.

        Args:
            tableau: runs of the piece.
            piece: the piece.
            n_runs: number of combined runs.
            target: target error of the piece [m].
            energy_alone: True if contact energy alone counts.
        """
        is_changed, present, known, has_new_jerk = False, ChangeState(), self.known, False
        self._jerk_displacement = 0.0
        self.may_jump = self.may_kink = False
        self.kink_error = 0.0
        if not energy_alone:
            if self._plan.has_kinks:
                displacement = self._displacement(tableau, n_runs, tableau.kink_velocities(n_runs), target)
                self.kink_error = displacement if displacement > target else 0.0
            if self.may_touch:
                is_changed, present.vibration = self._compare_friction(tableau, piece, n_runs, target)
            if self.may_touch or piece.ratio > 1:
                has_new_jerk, present.jerk_error = self._compare_jerk(tableau, piece, n_runs, target)
                is_changed = is_changed or has_new_jerk
            if self._plan.contact is not None and self._plan.contact.force.jaws:
                # A kink of a jaw's acceleration errs by up to a step's share. At an end of the piece all runs miss it.
                jaw_may_kink = VELOCITY_ERROR_TIME * tableau.jaw_speed_change(n_runs) > target * piece.steps
                self.may_kink = self.may_kink or jaw_may_kink
                is_changed = is_changed or jaw_may_kink
        energy, present.contact_energy, rates = tableau.contact_summary(n_runs)
        end, has_jerk = tableau.summary(n_runs), self.may_touch and piece.ratio == 1 and present.jerk_error > 0.0
        touches = has_jerk or energy > 0.0 or end.contact_energy > 0.0 or max(rates[0], end.self_contact[0]) > 0.0
        self.is_unexpected = touches and not self.may_touch and not energy_alone
        if touches and n_runs > 1 and not energy_alone:
            # It has kinks where it begins or ends, and where the surface changes its curvature.
            is_changed = self.may_kink = True
        is_harder = present.contact_energy > CONSTANTS.estimate_trust_factor * known.contact_energy
        self.has_new_contact = is_harder or (has_new_jerk and piece.ratio == 1)
        return is_changed or is_harder or self.kink_error > 0.0, present

    def limit_known(self, present: ChangeState, error: float, target: float) -> None:
        """Reduce the jerk of an accepted piece to what its error estimate contains.

        Jerk without effect must not hide another, e.g. that of a particle that comes near a surface and turns.

        Args:
            present: changes that the piece contains.
            error: its error estimate [m].
            target: its target error [m].
        """
        trust_factor = CONSTANTS.estimate_trust_factor
        known = max(trust_factor * trust_factor * trust_factor * error, target)
        if self._jerk_displacement > known:
            present.jerk_error *= known / self._jerk_displacement

    def _compare_friction(
        self, tableau: ExtrapolationTableau, piece: Piece, n_runs: int, target: float
    ) -> tuple[bool, float]:
        """Return if friction that reverses, or a stuck particle that vibrates, displaces; set `may_jump`.

        No step meets the time of a jump. So a force per mass that jumps by a causes a velocity error of up to a h/4. A
        vibration that the last estimate contained does not count: its error is then predicted.

        Returns:
            The answer, and the largest velocity of a stuck particle that vibrates [m/s].
        """
        changes = tableau.friction_change(n_runs)
        if changes is None:
            return False, 0.0
        change, velocities = changes
        vibration = largest_distance(velocities, np.zeros_like(velocities))
        is_new = vibration > CONSTANTS.estimate_trust_factor * self.known.vibration
        self.may_jump = self._displacement(tableau, n_runs, change * (piece.step / 4.0), target) > target
        vibrates = is_new and self._displacement(tableau, n_runs, velocities, target) > target
        return self.may_jump or vibrates, vibration

    def _compare_jerk(
        self, tableau: ExtrapolationTableau, piece: Piece, n_runs: int, target: float
    ) -> tuple[bool, float]:
        """Return if new jerk by contact or multirate hinges displaces, and its largest error [m/s]; set `may_kink`.

        Activity and contact energy of another particle hide it. A run errs by h^2/24 times the change of jerk. If a
        contact begins or ends within half a step of the piece's ends, all runs miss it by up to as much. Multirate
        hinges err by the square of the interval between their impulses.
        """
        interval = piece.ratio * piece.step
        if piece.ratio > 1:
            change = self._plan.hinge_jerk(*tableau.combine(n_runs))
        elif (contact_change := tableau.contact_jerk_change(n_runs)) is not None:
            change = contact_change
        else:
            return False, 0.0
        velocities = change * (interval * interval / 24.0)
        largest = largest_distance(velocities, np.zeros_like(velocities))
        is_new = largest > CONSTANTS.estimate_trust_factor * self.known.jerk_error
        if piece.ratio > 1 and not is_new:
            return False, largest
        # Contact may begin or end within half a step whether it is new or not.
        self._jerk_displacement = self._displacement(tableau, n_runs, velocities, target)
        displaces = self._jerk_displacement > target
        self.may_kink = displaces and piece.ratio == 1
        return displaces and is_new, largest

    def _displacement(self, tableau: ExtrapolationTableau, n_runs: int, velocities: Array, target: float) -> float:
        """Return the displacement [m] by errors of velocities [m/s]; 0 if it can't exceed a target error [m].

        Springs hold a particle that turns alone.
        """
        if VELOCITY_ERROR_TIME * largest_distance(velocities, np.zeros_like(velocities)) <= target:
            return 0.0
        end, x = tableau.t + tableau.duration, tableau.combine(n_runs)[0]
        return displacement_by_velocities(self._plan, self._work, end, x, velocities)
