# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_verify`: a recorded session is run again from its own snapshot and events, and compared to the last bit; or
beside a far finer motion, which says how accurate it is.

Begin with `main` (the command) and `run` (frames against the recording); `commands` checks that the frames did what the
recorded commands asked for. Of the accuracy, begin with `accuracy` (a session's certificate) and `truth` (the finer
motion); `shadow` is the same for a live cloth, in a process of its own.
"""
