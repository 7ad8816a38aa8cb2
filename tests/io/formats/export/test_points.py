"""Points without a surface: PLY opened by trimesh, and text by NumPy."""

from __future__ import annotations

import numpy as np
import trimesh

from mirrorskin import io

COLUMNS = ["x[mm]", "y[mm]", "z[mm]", "nx", "ny", "nz", "sigma[mm]", "filled"]


def test_a_ply_of_points_has_no_triangles(slope, tmp_path):
    path = tmp_path / "out.ply"
    assert io.export_result(slope, path, points=True) == "53 points"
    cloud = trimesh.load(path)
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_allclose(cloud.bounds[:, :2], [[-2, -0.625], [2, 0.625]])
    np.testing.assert_array_equal(cloud.vertices[:, 2], slope.height[np.isfinite(slope.height)])
    assert b"element face" not in path.read_bytes()


def test_text_is_one_line_a_point_and_names_its_columns(slope, tmp_path):
    path = tmp_path / "out.xyz"
    assert io.export_result(slope, path) == "53 points"
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line.removeprefix("# ") for line in lines if line.startswith("#")]
    assert comments[0] == "source: Münze 五円.h5"
    assert comments[-1].split() == COLUMNS
    assert len(lines) == len(comments) + 53
    table = np.loadtxt(path, encoding="utf-8")
    finite = np.isfinite(slope.height)
    rows, columns = np.nonzero(finite)
    expected = [
        *(slope.x[columns], slope.y[rows], slope.height[finite], *slope.normals[finite].T),
        *(slope.height_sigma[finite], slope.filled[finite]),
    ]
    np.testing.assert_allclose(table, np.stack(expected, axis=1), rtol=1.2e-7)
    # What has no normal says so, and does not get one from its neighbours.
    assert np.isnan(table[0, 3:6]).all()
    assert np.isnan(table[:, 6]).sum() == 1


def test_a_relief_of_nanometres_keeps_its_roughness(tmp_path):
    height = np.random.default_rng(1).normal(0, 1.4e-6, (20, 20)).astype(np.float32)
    axis = np.arange(20) * 0.01
    io.export_result(io.Result(height=height, x=axis, y=axis[::-1].copy()), tmp_path / "out.xyz")
    actual = np.loadtxt(tmp_path / "out.xyz", encoding="utf-8")[:, 2]
    np.testing.assert_array_equal(actual.astype(np.float32), height.ravel())
