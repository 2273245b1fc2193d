# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The C++ engine: every force law once, the loops over particles, and all steps of a run in one call.

Arrays in, arrays out: the engine knows no scene, no file, no clock and no ROS. Begin with `laws/` (the force laws),
then `grid/row.hpp` (one step of one row of a sheet), `plan/frame.hpp` (a frame) and `api/cloth_sim.hpp` (the C
interface). `binding` loads the library that fits the machine and checks its arguments. See docs/engine.md.
"""

#: Version of the package.
__version__ = "0.2.0"
#: Number of the package's arithmetic, recorded with every session. It is raised whenever a change alters the bits of a
#: scene. 1 stands for the versions before the engine, which recorded none.
NUMERICS = 35
