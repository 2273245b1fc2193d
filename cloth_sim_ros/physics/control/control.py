# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error control of the extrapolated leapfrog: what it remembers, and how it chooses columns and steps.

docs/time_stepping.md has the reasoning; the measurements behind the constants are made by `cloth_bench work-precision`.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.physics.integrators.base import MEMORY
from cloth_sim_ros.physics.integrators.columns import RATIOS
from cloth_sim_ros.physics.powers import root
from cloth_sim_ros.physics.state import State

#: Most columns whose combination is taken; one more is run to judge it.
MOST_COLUMNS = len(RATIOS) - 1
#: Share of the tolerance that may be lost in one second: errors of early frames grow while later ones add to them.
SHARE_PER_SECOND = 0.6
#: Choices aim at this part of the budget, so that a slow growth does not throw work away.
AIM = 0.5
#: Longest time between two judgements by a further column, in stretches.
LONGEST_WAIT = 16
#: Where the error is below this part of the budget, that time grows faster, and to four times as much.
FAR = 0.05
#: The smallest step is the stability limit divided by this: below it errors are accepted, flagged and counted.
FINEST = 32.0
#: Where the plain leapfrog could not meet its budget by steps four times smaller than that, none is chased: it runs at
#: this part of the limit, where it makes no energy either.
HOPELESS = 8.0
#: Share of the budget that rounding in single precision may take, amplified by a combination's weights. Small, because
#: rounding shares no symmetry with the motion: it feeds whatever grows, as the error of the steps as a rule does not.
NARROW_SHARE = 0.02
#: Least way of the fastest particle over a stretch, relative to what rounding does there.
NARROW_MOTION = 1e3
#: A stretch of single precision changes no less than this part of the distances within the sheet.
NARROW_LEAST = 4e-8
#: What single precision changes is measured over this part of a stretch's steps, and taken to be larger by the margin.
ROUNDING_PART = 8
ROUNDING_MARGIN = 1.5
#: Share of the budget that may be lost where weak springs are evaluated at every second step, the error of the steps
#: included.
ALTERNATE_SHARE = 0.75
#: Where no more than this part of it is lost by that, the time to the next judgement grows faster.
QUICK = 0.3
#: In motion that changes a stretch no less than by this part of the distances within the sheet: where the budget has
#: no room for it, it is not measured.
ALTERNATE_LEAST = 3e-6
#: Below this rounding rules [m]: a difference of combinations says nothing.
ROUNDING = 2e-14


#: Share of its error that a further column leaves, at most, where columns converge.
STALLED = 0.5
#: Share of a particle's motion over a stretch from which an error says nothing of what smaller steps would do.
UNRESOLVED = 1e-3
#: Decay of the fastest waves over a stretch below which they count as undamped.
UNDAMPED = 2.0
#: Steps at the stability limit from which they turn so often within a stretch that combined runs part.
MANY_STEPS = 300
#: Least refinement of combined runs there.
LEAST_REFINED = 4.0
#: Refinement beyond which a judgement asks whether a further column were cheaper.
COSTLY = 1.5
#: Growth of the bound of the squared frequency from which the energy of fixed steps is looked at.
STIFFENED = 1.02
#: The error of a stretch that is more violent than the one judged last is taken to be larger by this power of the
#: change of its velocities; where that is too much, it is judged itself.
LIVELIER = 3


@attrs.define
class Memory:
    """What one advance tells the next; all of it lies in the state."""

    #: Columns that are combined.
    columns: int = 1
    #: Step counts relative to what stability needs, at least 1.
    refine: float = 1.0
    #: Stretches until the next judgement by a further column; 0 judges now.
    wait: int = 0
    #: What `wait` restarts from.
    interval: int = 1
    #: Error of a stretch when last judged [m].
    error: float = 0.0
    #: That error relative to the difference of the last two columns' combinations.
    ratio: float = 1.0
    #: Largest change of a velocity over that stretch [m/s]: how violent it was.
    activity: float = 0.0
    #: Length of the stretches [s]; another length is judged anew.
    stretch: float = 0.0
    #: What single precision changes over a stretch [m], when last measured; negative when unknown.
    rounding: float = -1.0
    #: Squared frequency [1/s^2] and damping rate [1/s] at the end of the last advance; negative when unknown.
    omega2: float = -1.0
    damping: float = -1.0
    #: Least such squared frequency since the last restart: the sheet at its softest.
    softest: float = -1.0
    #: What fixed steps made of energy since then and did not lose again [J].
    made: float = 0.0
    #: Longest stable step since then [s].
    longest: float = 0.0
    #: Error of a stretch with weak springs at every second step [m], when last measured; negative when unknown.
    alternating: float = -1.0
    #: Squared frequency [1/s^2] up to which that is stable; negative when unknown.
    stiffest: float = -1.0

    @classmethod
    def of(cls, state: State) -> Memory:
        """Read the memory of a state; a fresh one where it has none."""
        stored = state.memory.get(MEMORY)
        if stored is None or not stored.size:
            return cls()
        columns, refine, wait, interval, *rest = stored.tolist()
        return cls(int(columns), refine, max(0, int(wait)), int(interval), *rest)

    def store(self, state: State) -> None:
        """Write the memory into a state."""
        numbers = (self.columns, self.refine, self.wait, self.interval, self.error, self.ratio)
        state.memory[MEMORY] = np.array(
            (
                *(*numbers, self.activity, self.stretch, self.rounding, self.omega2, self.damping, self.softest),
                *(self.made, self.longest, self.alternating, self.stiffest),
            )
        )


def cheapest(errors: Sequence[float], refine: float, budget: float, most: int) -> tuple[int, float]:
    """Return the columns and the refinement that meet a budget with the fewest force evaluations.

    Args:
        errors: estimated errors [m] of T_1, T_2, ... at the present refinement; T_K's falls as h^(K + 1).
        refine: present refinement.
        budget: error that is allowed [m].
        most: most columns.
    """
    best = (1, FINEST, float("inf"))
    for columns, error in enumerate(errors[:most], start=1):
        scale = root(max(error, ROUNDING) / (AIM * budget), columns + 1)
        wanted = min(FINEST, max(1.0, refine * scale))
        work = wanted * (sum(RATIOS[:columns]) + RATIOS[columns] / LONGEST_WAIT)
        if work < best[2] and (wanted < FINEST or columns == most):
            best = (columns, wanted, work)
    return best[0], best[1]


def hopeless(error: float, refine: float, budget: float) -> bool:
    """Whether the plain leapfrog's error [m] at a refinement says that no step in reach meets the budget [m]."""
    return refine * root(error / (AIM * budget), 2) > 4.0 * FINEST
