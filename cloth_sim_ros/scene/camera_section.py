# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of one depth camera: image, range, pose and noise."""

from __future__ import annotations

import attrs

from cloth_sim_ros.scene.limits import FRAME, QUATERNION
from cloth_sim_ros.scene.parameters.declare import parameter

#: Encodings of depth images (REP 118).
ENCODINGS = METRES, MILLIMETRES = ("32FC1", "16UC1")
#: Largest width and height of an image [pixels].
MAX_WIDTH = 4096
#: Largest number of pixels of an image: its points fit into the 64 MiB of shared memory that the middleware gets.
MAX_PIXELS = 5_500_000
#: Least fx and fy [pixels]: that of one pixel with the largest field of view.
MIN_FOCAL_LENGTH = 0.01
#: Largest depth of 16UC1 [m].
MAX_MILLIMETRES_DEPTH = 65.535


@attrs.frozen(kw_only=True)
class CameraParameters:
    """Parameters `<camera>.*` of one depth camera, e.g. `wrist.width`: image, range, pose and noise.

    Its optical frame has x right, y down and z forward (REP 103).
    """

    width: int = parameter("int", 640, "Columns of its images", min=1, max=MAX_WIDTH, observes=True)
    height: int = parameter("int", 480, "Rows of its images", min=1, max=MAX_WIDTH, observes=True)
    fov: float = parameter(
        "double",
        1.2,
        "Horizontal field of view; intrinsics overrides it",
        unit="rad",
        min=0.01,
        max=3.1,
        observes=True,
    )
    intrinsics: tuple[float, ...] = parameter(
        "double[]",
        (0.0, 0.0, 0.0, 0.0),
        "fx, fy, cx, cy in pixels, with pixel centres at whole numbers; all 0: square pixels by fov, centred",
        length=4,
        min=-1e6,
        max=1e6,
        constraint=f"fx and fy at least {MIN_FOCAL_LENGTH:g}, or all 0",
        observes=True,
    )
    rate: float = parameter(
        "double",
        30.0,
        "Images per second of simulated time, at most one a frame",
        unit="Hz",
        min=0.001,
        max=10000.0,
        observes=True,
    )
    min_depth: float = parameter(
        "double", 0.1, "Least depth; nearer surfaces have none", unit="m", min=0.001, max=1e4, observes=True
    )
    max_depth: float = parameter(
        "double",
        10.0,
        "Largest depth; farther surfaces have none",
        unit="m",
        min=0.001,
        max=1e4,
        constraint=f"at most {MAX_MILLIMETRES_DEPTH} for 16UC1",
        observes=True,
    )
    position: tuple[float, ...] = parameter(
        "double[]",
        (0.0, -2.0, 1.0),
        "Position of its optical frame in frame_id, unless frame is set",
        unit="m",
        length=3,
        min=-1e4,
        max=1e4,
        live=True,
        observes=True,
    )
    orientation: tuple[float, ...] = parameter(
        "double[]",
        (-0.7071067811865476, 0.0, 0.0, 0.7071067811865476),
        "Orientation of its optical frame, a quaternion x, y, z, w, unless frame is set; the default looks along y of "
        "frame_id, upright",
        length=4,
        constraint=QUATERNION,
        live=True,
        observes=True,
    )
    frame: str = parameter(
        "string",
        "",
        "TF frame that is its optical frame, and frame_id of its messages; empty: <node>/<camera>_optical_frame, at "
        "position and orientation. Needs tf2_ros",
        constraint=FRAME,
        observes=True,
    )
    encoding: str = parameter(
        "string",
        METRES,
        "Depth image: 32FC1: metres, NaN without a depth; 16UC1: millimetres, 0 without one",
        choices=ENCODINGS,
        observes=True,
    )
    baseline: float = parameter(
        "double",
        0.05,
        "Distance of the two lenses of the stereo camera that disparity_noise and disparity_step model",
        unit="m",
        min=0.001,
        max=10.0,
        observes=True,
    )
    disparity_noise: float = parameter(
        "double",
        0.0,
        "Standard deviation of disparity in pixels: that of depth z is this times z^2 / (fx baseline); 0: no noise",
        min=0.0,
        max=100.0,
        observes=True,
    )
    disparity_step: float = parameter(
        "double",
        0.0,
        "Step of disparity in pixels: depth z has steps of this times z^2 / (fx baseline); 0: none",
        min=0.0,
        max=100.0,
        observes=True,
    )
    seed: int = parameter("int", 0, "Seed of the noise, which is the same in each run", min=0, observes=True)
