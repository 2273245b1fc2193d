# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Studies: thousands of simulations on Dask, their folder, index and datasets.

Each run gives the same bits as a live cloth. `study_file` reads a study, `study_run` executes one run. The extra
`batch` installs Dask, zarr and pyarrow; they are imported at their first use. Begin with `study_session`.
"""
