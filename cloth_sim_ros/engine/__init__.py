# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The C++ engine: every force law once, the loops over particles, and whole frames in one call.

Arrays in, arrays out: it knows no scene, no file, no clock, no ROS, nor who calls. Begin with `laws.hpp` (the laws),
then `grid_row.hpp` (one row of a sheet, one step), `frame.hpp` (a frame) and `library.cpp` (what Python sees).
`binding` loads the library that fits the machine and checks what is handed to it. docs/engine.md tells the rest.
"""

#: Number of the package's arithmetic, recorded with every session: it is raised whenever the same scene and events give
#: other bits than before. 1 stands for the versions before the engine, which recorded none.
NUMERICS = 19
