# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topic of an ensemble of cloths with uncertain parameters, computed by a process of its own.

It costs no time and no import unless `ensemble.file` names a distribution. Begin with `ensemble_topic`, the node's
part. `ensemble_worker` is the process.
"""
