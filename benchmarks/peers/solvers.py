# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Other engines of the comparison: requirements and model differences."""

from __future__ import annotations

from benchmarks.peers.contact_scenes import PEER_BENDING
from benchmarks.peers.environment import Peer

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
#: Name, package, variant, difference from the product, and first steps of the search by particles a side.
PEERS = (
    Peer("Newton semi-implicit", "newton", "semi_implicit", _NEWTON, lambda n: n),
    Peer("Newton XPBD", "newton", "xpbd", _NEWTON_10, lambda n: n),
    Peer("Newton VBD", "newton", "vbd", _NEWTON_10, lambda n: max(n // 16, 1)),
    Peer("MuJoCo flex", "mujoco", "discrete", _FLEX, lambda n: 1),
    Peer("PyBullet springs", "pybullet", "springs", _BULLET, lambda n: n),
    Peer("pyPBD XPBD", "pyPBD", "xpbd", _PBD, lambda n: max(n // 8, 1)),
)
_SHELL = (
    "an isotropic elastic shell of the product's modulus along the threads, with zero Poisson ratio, a bending modulus "
    f"of {PEER_BENDING:g} N m"
)
_DAMPED = f"{_SHELL}, and the product's damping and drag"
_PENALTIES = (
    "single precision, 10 iterations a step; contact is a penalty of 1000 N/m and 0.1 N s/m on particles alone, which "
    "begins at the thickness; friction as it comes, smoothed below 10 mm/s; on the processor, but it is made for GPUs"
)
_STILL = "pads stand still, where the penalties of the particles between them begin with the force"
_FLEX_CONTACT = (
    f"{_DAMPED}; its discrete integrator, tolerance 1e-6, elliptic cones; solref 0.01 and solimp 0.95, 0.99 of the "
    "sheet, solref 0.003 of solids, as in its examples"
)
_DRIVEN = "pads of 0.05 kg on slides, damped by 10 N s/m"
_FLEX_APART = {"fold": "layers keep twice the thickness", "pinch": _DRIVEN}
CONTACT_PEERS = (
    Peer(
        "Newton VBD",
        "newton",
        "vbd",
        f"{_DAMPED}, the drag once a step; {_PENALTIES}",
        apart={
            "fold": "self-contact begins at the thickness; its search radius is 1.75 times that",
            "pinch": _STILL,
        },
    ),
    Peer(
        "Newton Style3D",
        "newton",
        "style3d",
        f"{_SHELL}, and the product's drag, once a step; it has no damping; {_PENALTIES}",
        apart={"fold": "layers repel each other within the thickness", "pinch": _STILL},
    ),
    Peer(
        "MuJoCo flex, CG",
        "mujoco",
        "cg",
        f"{_FLEX_CONTACT}; its CG solver, which is faster and less accurate",
        apart=_FLEX_APART,
    ),
    Peer(
        "MuJoCo flex, Newton",
        "mujoco",
        "newton",
        f"{_FLEX_CONTACT}; its Newton solver, which its documentation recommends",
        apart=_FLEX_APART,
    ),
    Peer(
        "MuJoCo flex, ipc",
        "mujoco",
        "ipc",
        f"{_FLEX_CONTACT}; its Newton solver; its intersection-free contact, which has no friction and keeps the sheet "
        "1 mm from static obstacles and from itself, half the product's thickness",
        apart={"pinch": f"{_DRIVEN}; contact with them is the ordinary one, with friction"},
    ),
    Peer(
        "PyBullet deformable",
        "pybullet",
        "springs",
        "springs along a triangulation's edges, all of one stiffness, the largest that the step bears and at most the "
        "product's, and a hundredth of it across them; all particles of one mass; its collision margin is the "
        "product's thickness; no drag of the air",
        apart={
            "fold": "the table is a box; the edge is tied to a heavy body that carries it",
            "pinch": f"{_DRIVEN}, which stop 0.8 mm from each other",
        },
        comparable=False,
    ),
)
