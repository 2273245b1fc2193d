# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a live node can bear: parameters by which one frame would take minutes are refused, so that it stays answerable.

The library itself has no such bound; a run of millions of steps is a fair thing to ask of it.
"""

from __future__ import annotations

from cloth_sim_ros.scene.parameters import ParameterError
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Most particle steps in a frame: about a second of the slowest forces.
MOST_WORK = 20_000_000
#: So many steps in a frame are never refused, however large the cloth: whoever asks for a million particles will wait.
ALWAYS = 1000
#: More steps in a frame are always refused, however small the cloth: each step has a fixed cost.
NEVER = 100_000


def refuse_endless_frames(scene: Scene, simulation: Simulation) -> None:
    """Refuse a scene whose frames are not over soon.

    Args:
        scene: to be judged.
        simulation: the cloth that it is to be in force for.

    Raises:
        ParameterError: naming the steps that a frame would take, and what to do.
    """
    particles = simulation.state.particle_count
    step, why = scene.step, f"step is {scene.step} s"
    if not step:
        step = scene.build_integrator().step_limit(*simulation.rates(scene))
        why = f"the stability limit of '{scene.integrator}' is {step:.3g} s"
    # A frame of ten seconds may take longer than one of a sixtieth.
    patience = max(1.0, 2.0 * scene.period)
    most = int(patience * min(NEVER, max(ALWAYS, MOST_WORK // particles)))
    if step < scene.period / most:
        raise ParameterError(
            f"a frame would take {scene.period / step:.3g} steps ({why}), at most {most} are taken live: "
            "lower stiffness or damping, raise the density, or choose integrator 'auto' with step 0.0"
        )
