# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_verify`: a recorded session is run again from its own snapshot and events, and compared to the last bit; or
beside a far finer motion, which says how accurate it is.

Begin with `main` (the command), `run` (frames against the recording) and `verdict` (what is found). `shown` compares
what each frame must have (`outputs`, `states`, `markers`), `diagnostics` what the node says of itself, `commands` the
events with the recorded commands; `numbering` finds what is missing.
Of the accuracy, begin with `accuracy` (a session's certificate) and `truth` (the finer motion); `shadow` is the same of
a live cloth, in a process of its own.
"""
