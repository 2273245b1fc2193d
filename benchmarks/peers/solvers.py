# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Other engines of the comparison: requirements and model differences."""

from __future__ import annotations

from benchmarks.peers.contact_runs import ContactPeer
from benchmarks.peers.jobs import Peer

#: Requirements for pip, by package.
REQUIREMENTS = {
    "newton": ("newton==1.8.0", "warp-lang==1.19.0"),
    "mujoco": ("mujoco==4.0.0",),
    "pybullet": ("pybullet==3.2.7",),
    "pyPBD": ("pyPBD==2.2.2",),
}
_NEWTON = "the product's springs with their damping, in single precision; no air drag"
_NEWTON_10 = f"{_NEWTON}; 10 iterations a step"
_FLEX = (
    "an isotropic elastic membrane of the product's modulus along the threads, with the product's damping and drag; "
    "implicit"
)
_BULLET = "springs of one stiffness along a triangulation's edges, others across them; no drag of the air"
_PBD = "the product's stiffnesses as compliant constraints, one sweep a step; neither damping nor drag"
#: Name, package, script, variant, difference from the product, and first steps of the search by particles a side.
PEERS = (
    Peer("Newton semi-implicit", "newton", "engine_newton.py", "semi_implicit", _NEWTON, lambda n: n),
    Peer("Newton XPBD", "newton", "engine_newton.py", "xpbd", _NEWTON_10, lambda n: n),
    Peer("Newton VBD", "newton", "engine_newton.py", "vbd", _NEWTON_10, lambda n: max(n // 16, 1)),
    Peer("MuJoCo flex", "mujoco", "engine_mujoco.py", "discrete", _FLEX, lambda n: 1),
    Peer("PyBullet springs", "pybullet", "engine_pybullet.py", "springs", _BULLET, lambda n: n),
    Peer("pyPBD XPBD", "pyPBD", "engine_pypbd.py", "xpbd", _PBD, lambda n: max(n // 8, 1)),
)
_MEMBRANE = (
    "an isotropic elastic membrane of the product's modulus along the threads, with zero Poisson ratio and the "
    "product's damping"
)
_MUJOCO = (
    "steps of 1/480 s, CG, elliptic cones; solref 0.01 and solimp 0.95, 0.99 of the sheet, solref 0.003 of solids, as "
    "in its examples; our drag"
)
_DRIVEN = "pads of 0.05 kg on slides, damped by 10 N s/m"
CONTACT_PEERS: tuple[ContactPeer, ...] = (
    ContactPeer(
        name="Newton VBD",
        package="newton",
        script="engine_newton.py",
        variant="vbd",
        steps=10,
        differs=(
            f"{_MEMBRANE}, with hinges of 0.001 N; single precision, steps of 1/600 s of 10 iterations; contact is a "
            "penalty of 1000 N/m and 0.1 N s/m on particles alone, which begins at the thickness, as in its example of "
            "a cloth that is twisted; friction as it comes, smoothed below 10 mm/s; our drag, once a step; on the "
            "processor, though it is made for GPUs"
        ),
        apart={
            "fold": "contact with itself begins at the thickness and is looked for at 1.75 times that",
            "pinch": "pads stand still, where the penalties of the particles between them begin with the force",
        },
    ),
    ContactPeer(
        name="MuJoCo flex",
        package="mujoco",
        script="engine_mujoco.py",
        variant="elastic",
        steps=8,
        differs=f"{_MEMBRANE}, which bends as a plate of 1 mm does; its discrete integrator, {_MUJOCO}",
        apart={
            "fold": "layers keep twice the thickness; the edge is tied by soft constraints to what carries it",
            "pinch": _DRIVEN,
        },
    ),
    ContactPeer(
        name="MuJoCo flex, edges",
        package="mujoco",
        script="engine_mujoco.py",
        variant="edges",
        steps=8,
        differs=(
            "edges of fixed length by soft constraints, solref 0.005, no bending; impratio 10, noslip of 10 "
            f"iterations, its implicitfast integrator, {_MUJOCO}"
        ),
        apart={
            "fold": "layers keep twice the thickness; the edge is tied by soft constraints to what carries it",
            "pinch": _DRIVEN,
        },
    ),
    ContactPeer(
        name="PyBullet deformable",
        package="pybullet",
        script="engine_pybullet.py",
        variant="springs",
        steps=17,
        differs=(
            "springs along a triangulation's edges, all of one stiffness, far below ours, and a hundredth of it across "
            "them; all particles of one mass; steps of 1/1020 s; its collision margin is our thickness; no drag of the "
            "air"
        ),
        apart={
            "fold": "the table is a box; the edge is tied to a heavy body that carries it",
            "pinch": f"{_DRIVEN}, which stop 0.8 mm from each other",
        },
    ),
)
