# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Picture of a drape: contour of the shadow from above, and the specimen in perspective."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from cloth_sim_ros.laboratory.drape import Drape

_SHADE, _LINE = "#9ab3cf", "#27496d"


def write_picture(drape: Drape, title: str, path: Path) -> None:
    """Write a picture of a drape as PNG: its shadow and the specimen in perspective. It needs matplotlib."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    percent, nodes = 100.0 * drape.coefficient, drape.shadow.nodes
    figure.suptitle(f"{title}: drape coefficient {percent:.1f} %, {nodes} nodes")
    flat = figure.add_subplot(1, 2, 1)
    turn = np.linspace(0.0, 2.0 * math.pi, len(drape.shadow.radii) + 1)
    radii = 1e3 * np.append(drape.shadow.radii, drape.shadow.radii[0])
    flat.fill(radii * np.cos(turn), radii * np.sin(turn), color=_SHADE, label="shadow")
    circles = ((drape.test.radius, "--", "flat specimen"), (drape.test.plate_radius, "-", "plate"))
    for radius, style, label in circles:
        flat.plot(1e3 * radius * np.cos(turn), 1e3 * radius * np.sin(turn), style, color=_LINE, lw=1.0, label=label)
    flat.set(aspect="equal", xlabel="x [mm], along the weft", ylabel="y [mm], along the warp")
    flat.legend(loc="upper right", fontsize=8)
    solid = figure.add_subplot(1, 2, 2, projection="3d")
    x, y, z = 1e3 * drape.positions.T
    solid.plot_trisurf(x, y, z, triangles=drape.mesh.triangles, color=_SHADE, edgecolor=_LINE, linewidth=0.15)
    if not drape.test.contact:
        plate = 1e3 * drape.test.plate_radius
        solid.plot(plate * np.cos(turn), plate * np.sin(turn), 0.0, color=_LINE, lw=1.0)
    span = 1e3 * drape.test.radius
    solid.set(xlim=(-span, span), ylim=(-span, span), zlim=(-span, 0.3 * span), xlabel="x [mm]", ylabel="y [mm]")
    solid.set_box_aspect((2.0, 2.0, 1.3))
    solid.view_init(elev=28.0, azim=-60.0)
    figure.savefig(path, dpi=110, format="png")
