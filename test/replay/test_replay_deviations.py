# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_replay` of a session with an ensemble: colours and curve of the deviations, each at its frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="the viewer is not installed: pip install 'cloth_sim_ros[replay]'")

from support.ensemble_session import record_ensemble
from support.rrd import rows

from cloth_sim_ros.replay import colours
from cloth_sim_ros.replay.blueprint import make_blueprint
from cloth_sim_ros.replay.deviations import read_deviations
from cloth_sim_ros.replay.main import main
from cloth_sim_ros.replay.pre_scan import scan_session
from cloth_sim_ros.session.cdr import decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.reader import SessionReader

FRAMES, EVERY = 12, 3


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_ensemble(tmp_path_factory.mktemp("session"), FRAMES, every=EVERY)


def test_deviations_colour_the_cloth_at_their_frames(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    assert main([str(session), "--save", str(out)]) == 0
    with SessionReader(session) as reader:
        clouds = [decode_cloud(message.data) for message in reader.messages(["/cloth_sim/ensemble"])]
        scan = scan_session(reader)
    assert len(clouds) == FRAMES // EVERY
    limit = scan.deviation_limit
    assert limit is not None
    assert 0.5 * limit <= max(float(cloud.deviation.max()) for cloud in clouds) <= 2.0 * limit
    painted_at, painted = rows(out, "/world/cloth", "Mesh3D:vertex_colors")
    # Before the first deviations the cloth has the colour of none.
    assert painted_at == pytest.approx([1 / 30, *((k + 1) / 30 for k in range(0, FRAMES, EVERY))], abs=2e-9)
    expected = np.empty(30, np.uint32)
    for cloud, row in zip(clouds, painted[1:], strict=True):
        colours.strain_colours(cloud.deviation, limit, expected)
        assert row == expected.tolist()
    times, curve = rows(out, "/plots/deviation/largest_deviation", "Scalars:scalars")
    assert times == pytest.approx(painted_at[1:])
    assert np.ravel(curve) == pytest.approx([float(cloud.deviation.max()) for cloud in clouds])
    _, positions = rows(out, "/world/cloth", "Mesh3D:vertex_positions")
    assert len(positions) == FRAMES


def test_strain_limit_shows_strain(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    assert main([str(session), "--save", str(out), "--strain-limit", "5"]) == 0
    _, painted = rows(out, "/world/cloth", "Mesh3D:vertex_colors")
    assert len(painted) == FRAMES
    with SessionReader(session) as reader:
        assert scan_session(reader, strain_limit=0.05).deviation_limit is None
        followed = scan_session(reader, is_followed=True)
    assert followed.deviation_limit == 0.01
    assert {"plots/deviation", "plots/energy"} <= set(followed.plots)
    view = make_blueprint(followed).root_container.contents[0]
    assert view.name == "Cloth, coloured by deviation of the ensemble: light 0, red 0.01 m"


def test_deviations_of_another_cloth_are_refused(session: Path) -> None:
    with SessionReader(session) as reader:
        ensemble = next(message.data for message in reader.messages(["/cloth_sim/ensemble"]))
        points = next(message.data for message in reader.messages(["/cloth_sim/points"]))
    assert read_deviations(ensemble, 30).shape == (30,)
    for data, count in ((ensemble, 31), (points, 30)):
        with pytest.raises(SessionError, match="no field deviation for"):
            read_deviations(data, count)
