# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_verify`: re-run of recorded sessions, and measurement of their accuracy.

A session is run again from its own snapshot and events, and compared to the last bit. Its accuracy is measured against
a reference solution with much smaller steps.

Entry points: `main` (the command), `run` (frames against the recording), `verdict` (the result). `frame_outputs` checks
the messages of each frame (`outputs`, `states`, `markers`). `diagnostics` checks the diagnostics, `commands` the events
against the recorded commands. `completeness` finds missing messages.

Entry points of the accuracy: `accuracy` (a session's certificate), `reference_solution`. `accuracy_worker` measures a
live cloth in a separate process.
"""
