"""Surfaces, opened by trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mirrorskin import io


def opened(path):
    return trimesh.load(path, process=False)


def properties_of(mesh):
    """Return a PLY's vertex properties, by name."""
    return mesh.metadata["_ply_raw"]["vertex"]["data"]


def head_of(path):
    return path.read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()


@pytest.fixture(params=["ply", "stl", "PLY"])
def path(request, tmp_path):
    return tmp_path / f"out.{request.param}"


def test_a_surface_has_its_size_in_millimetres(slope, path):
    description = io.export_result(slope, path)
    mesh = opened(path)
    # From the first pixel's centre to the last one's, and from the lowest corner to the peak.
    np.testing.assert_allclose(mesh.bounds[:, :2], [[-2, -0.625], [2, 0.625]])
    np.testing.assert_allclose(mesh.extents[2], -0.0125 + 1.3875, rtol=1e-6)
    assert description == "76 triangles between 53 points, 4 x 1.25 x 1.375 mm"
    assert len(mesh.faces) == 76


def test_a_plane_faces_where_it_should(path):
    x, y = io.pixel_axes((5, 4), (0.5, 0.25))
    io.export_result(io.Result(height=(0.2 * x - 0.7 * y[:, None]).astype(np.float32), x=x, y=y), path)
    mesh = opened(path)
    expected = np.array([-0.2, 0.7, 1]) / np.sqrt(1 + 0.2**2 + 0.7**2)
    assert len(mesh.faces) == 2 * 4 * 3
    np.testing.assert_allclose(mesh.face_normals, np.broadcast_to(expected, (24, 3)), atol=1e-6)
    np.testing.assert_allclose(mesh.area, 1.5 * 1.0 * np.sqrt(1 + 0.2**2 + 0.7**2), rtol=1e-6)


def test_a_hole_stays_one(slope, path):
    io.export_result(slope, path)
    mesh = opened(path)
    hole = np.array([-1, -0.375])  # row 4 and column 2 of oblong pixels
    assert np.abs(mesh.vertices[:, :2] - hole).max(axis=1).min() >= 0.25
    # Two triangles of each of the four cells around it, and one left in each.
    assert len(mesh.faces) == 2 * 5 * 8 - 4
    a, b, c = mesh.triangles.transpose(1, 0, 2)[..., :2]
    left_of = [np.linalg.det(np.stack([q - p, hole - p], axis=1)) for p, q in ((a, b), (b, c), (c, a))]
    assert not np.all(np.array(left_of) > 1e-9, axis=0).any()


def test_pieces_are_not_joined(slope, path):
    component = np.where(np.isnan(slope.height), -1, np.arange(9) // 5).astype(np.int32)
    io.export_result(slope.assign(component=component, offset_unknown=np.zeros(2, np.uint8)), path)
    mesh = trimesh.load(path)  # with corners at one place made one
    parts = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    assert sorted(np.bincount(parts)) == [2 * 5 * 3, 2 * 5 * 4 - 4]


def test_a_ply_contains_all_values_of_each_vertex(slope, tmp_path):
    path = tmp_path / "out.ply"
    io.export_result(slope, path)
    mesh = opened(path)
    finite = np.isfinite(slope.height)
    properties = properties_of(mesh)
    assert properties.dtype.names == ("x", "y", "z", "nx", "ny", "nz", "sigma", "filled")
    np.testing.assert_array_equal(properties["z"], slope.height[finite])
    np.testing.assert_array_equal(properties["sigma"], slope.height_sigma[finite])
    np.testing.assert_array_equal(properties["filled"], slope.filled[finite])
    assert properties["filled"].sum() == 1
    np.testing.assert_array_equal(mesh.vertex_normals[1:], slope.normals[finite][1:])
    # The result has none there, but the one triangle in that corner has.
    np.testing.assert_allclose(mesh.vertex_normals[0], slope.normals[0, 1], atol=1e-6)


def test_a_ply_states_its_unit_and_origin_in_ascii(slope, tmp_path):
    path = tmp_path / "out.ply"
    io.export_result(slope, path)
    comments = [line.removeprefix("comment ") for line in head_of(path) if line.startswith("comment ")]
    assert comments == [
        "unit: mm",
        r"source: M\xfcnze \u4e94\u5186.h5",
        "date: 2026-01-02T03:04:05+00:00",
        "software: mirrorskin 1.2.3",
        "heights: from the sheet at rest",
        "filled: 1 of 53 heights were not measured but filled",
        "normals: of the result where it has them, elsewhere of the triangles around",
    ]


def test_an_stl_states_its_unit_and_is_not_taken_for_text(slope, tmp_path):
    path = tmp_path / "out.stl"
    io.export_result(slope.assign(process=slope.process | {"source": "ü" * 200}), path)
    data = path.read_bytes()
    assert data[:80].startswith(b"unit mm, mirrorskin 1.2.3, 2026-01-02T03:04:05+00:00, ")
    assert len(data) == 84 + 50 * 76
    mesh = opened(path)
    normals = np.frombuffer(data[84:], [("n", "<f4", 3), ("rest", "V38")])["n"]
    np.testing.assert_allclose(normals, mesh.face_normals, atol=1e-5)


@pytest.mark.parametrize("suffix", ["ply", "stl", "png", "csv"])
def test_relative_heights_are_reported(slope, tmp_path, suffix):
    height = slope.height - np.nanmean(slope.height)
    relative = slope.assign(height=height, offset_unknown=np.ones(1, np.uint8))
    section = {"distance": np.arange(3.0), "height": np.arange(3.0)}
    description = io.export_result(relative, tmp_path / f"out.{suffix}", section=section)
    assert description.endswith(", heights relative: their mean is 0")
