# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Initial layout of the viewer: sheet, plots beside it, simulated time below."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay.gripper_view import target_path
from cloth_sim_ros.replay.plots import PLOTS
from cloth_sim_ros.replay.pre_scan import PreScan
from cloth_sim_ros.replay.rows import SIM_TIME

if TYPE_CHECKING:
    import rerun.blueprint as rrb

#: Azimuth of the camera from the sheet's normal, and its elevation [degrees].
_AZIMUTH, _ELEVATION = 35.0, 14.0
#: Distance of the camera in radii of the scene: for a vertical field of view of 55 degrees, with a margin.
_DISTANCE, _DISTANCE_LYING = 1.9, 2.25
#: Visible duration of a gripper's commanded path [s].
_TRAIL_SECONDS = 1.5

Floats = NDArray[np.float64]


def eye_position(scan: PreScan) -> tuple[Floats, Floats]:
    """Return position and target point of the viewer's eye [m], on the side of the sheet with the grippers."""
    target = 0.5 * (scan.low + scan.high)
    radius = 0.5 * float(np.linalg.norm(scan.high - scan.low))
    facing = scan.normal * np.array([1.0, 1.0, 0.0])
    if np.linalg.norm(facing) < 0.3:
        # A lying sheet is shown from any side, at a higher elevation.
        forward, elevation, distance = np.array([0.0, -1.0, 0.0]), 40.0, _DISTANCE_LYING
    else:
        forward, elevation, distance = facing / np.linalg.norm(facing), _ELEVATION, _DISTANCE
        sheet = scan.opening.positions.mean(axis=0)
        gripper_side = -forward[1]
        if len(scan.gripper_targets):
            gripper_side = float(np.mean((scan.gripper_targets - sheet) @ forward))
        if gripper_side < 0.0:
            forward = -forward
    azimuth = np.radians(_AZIMUTH)
    right = np.array([-forward[1], forward[0], 0.0])
    lateral = float(np.mean((scan.gripper_targets - target) @ right)) if len(scan.gripper_targets) else 0.0
    direction = np.cos(azimuth) * forward + np.sin(azimuth) * (right if lateral >= 0.0 else -right)
    elevation_angle = np.radians(elevation)
    direction = np.cos(elevation_angle) * direction + np.sin(elevation_angle) * np.array([0.0, 0.0, 1.0])
    return target + distance * radius * direction, target


def make_blueprint(scan: PreScan, *, following: bool = False, picture: bool = False) -> rrb.Blueprint:
    """Return the viewer's layout for a session. `following`: cursor on newest frame. `picture`: no menus, paused."""
    import rerun.blueprint as rrb

    position, target = eye_position(scan)
    floor = float(np.floor(4.0 * scan.low[2]) / 4.0) if abs(scan.low[2]) > 0.3 else 0.0
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_SECONDS)
    end = rrb.TimeRangeBoundary.cursor_relative()
    trail = rrb.VisibleTimeRanges(timeline=SIM_TIME, start=start, end=end)
    view = rrb.Spatial3DView(
        origin="/world",
        name=_colouring(scan),
        background=rrb.Background(color=[38, 42, 50]),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.25, plane=_plane(min(floor, 0.0)), color=[255, 255, 255, 14]),
        overrides={target_path(start.name): trail for start in scan.opening.grippers},
        eye_controls=rrb.EyeControls3D(position=position.tolist(), look_target=target.tolist(), eye_up=[0, 0, 1]),
    )
    plots = _plots(scan)
    columns = rrb.TextLogColumns(timeline_columns=[SIM_TIME], text_log_columns=["Body"])
    plots.append(rrb.TextLogView(origin="/log", name="Events", columns=columns))
    # The accuracy plot comes first, and needs space for its legend.
    shares = [1.0 if scan.error_limit is None or k else 2.5 for k in range(len(plots))]
    panels = [rrb.TopPanel(state="hidden")] if picture else []
    return rrb.Blueprint(
        rrb.Horizontal(view, rrb.Vertical(*plots, row_shares=shares), column_shares=[2.4, 1.0]),
        *panels,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=SIM_TIME,
            play_state="following" if following else "paused" if picture else "playing",
            # The viewer does not follow the newest frame of a loop.
            loop_mode="off" if following else "all",
        ),
        auto_layout=False,
        auto_views=False,
    )


def _colouring(scan: PreScan) -> str:
    if scan.error_limit is not None:
        return f"Cloth, coloured by error: light 0, red {scan.error_limit:g} m"
    if scan.deviation_limit is not None:
        return f"Cloth, coloured by deviation of the ensemble: light 0, red {scan.deviation_limit:g} m"
    return f"Cloth, coloured by strain: light 0, red {100.0 * scan.strain_limit:g} %"


def _plots(scan: PreScan) -> list[Any]:
    import rerun.blueprint as rrb

    n_wrenches = len(scan.opening.grippers) + len(scan.opening.obstacles)
    several = {"plots/energy", "plots/accuracy"} | ({"plots/force"} if n_wrenches > 1 else set())
    views = {
        path: rrb.TimeSeriesView(
            origin=path,
            name=PLOTS[path],
            plot_legend=rrb.PlotLegend(
                corner=rrb.Corner2D.LeftBottom if path == "plots/accuracy" else None, visible=path in several
            ),
        )
        for path in scan.plots
    }
    timing_views = [views.pop(path) for path in ("plots/pace", "plots/late") if path in views]
    return [*views.values(), *([rrb.Horizontal(*timing_views)] if timing_views else [])]


def _plane(height: float) -> Any:
    """Return the horizontal plane at a height [m]."""
    import rerun as rr

    return rr.components.Plane3D.XY.with_distance(height)
