# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The engines that ours is compared with: what they need installed, and how their models differ."""

from __future__ import annotations

from benchmarks.peers.jobs import Peer

#: Of each package, what is installed.
REQUIREMENTS = {
    "newton": ("newton==1.8.0", "warp-lang==1.19.0"),
    "mujoco": ("mujoco==4.0.0",),
    "pybullet": ("pybullet==3.2.7",),
    "pyPBD": ("pyPBD==2.2.2",),
}
_NEWTON = "our springs with their damping, in single precision; no drag of the air"
PEERS = (
    Peer(
        name="Newton semi-implicit",
        package="newton",
        script="newton_sheet.py",
        variant="semi_implicit",
        differs=_NEWTON,
        first_steps=lambda n: n,
    ),
    Peer(
        name="Newton XPBD",
        package="newton",
        script="newton_sheet.py",
        variant="xpbd",
        differs=f"{_NEWTON}; 10 iterations a step",
        first_steps=lambda n: n,
    ),
    Peer(
        name="Newton VBD",
        package="newton",
        script="newton_sheet.py",
        variant="vbd",
        differs=f"{_NEWTON}; 10 iterations a step",
        first_steps=lambda n: max(n // 16, 1),
    ),
    Peer(
        name="MuJoCo flex",
        package="mujoco",
        script="mujoco_sheet.py",
        variant="discrete",
        differs="an isotropic elastic membrane of the modulus along our threads, damped alike, our drag; implicit",
        first_steps=lambda n: 1,
    ),
    Peer(
        name="PyBullet springs",
        package="pybullet",
        script="pybullet_sheet.py",
        variant="springs",
        differs="springs of one stiffness along a triangulation's edges, others across them; no drag of the air",
        first_steps=lambda n: n,
    ),
    Peer(
        name="pyPBD XPBD",
        package="pyPBD",
        script="pypbd_sheet.py",
        variant="xpbd",
        differs="our stiffnesses as compliant constraints, one sweep a step; neither damping nor drag",
        first_steps=lambda n: max(n // 8, 1),
    ),
)
