"""Meshes, compared with closed forms and exhaustive search."""

from __future__ import annotations

import sys
from pathlib import Path

import geometry
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.twin.catalogue import make_object
from mirrorskin.twin.object_files import top_surface
from mirrorskin.twin.objects import Object

SHAPE = (120, 160)
PIXEL = 0.05

Map = NDArray[np.float64]


def save(path: Path, mesh: trimesh.Trimesh | trimesh.Scene, file_type: str | None = None) -> Path:
    mesh.export(path, file_type=file_type)
    return path


def load(path: Path, shape: tuple[int, int] = SHAPE, pixel: float = PIXEL) -> tuple[Object, Map]:
    thing = make_object(path, shape, (pixel, pixel))
    return thing, thing.height(*geometry.pixel_centres(shape, pixel))


def box(size: tuple[float, float, float], middle: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(middle)
    return mesh


@pytest.mark.parametrize(
    ("name", "file_type", "shape"),
    [
        ("b.STL", "stl", (120, 160)),
        ("b.stl", "stl_ascii", (121, 160)),
        ("b.ply", "ply", (121, 161)),
        ("b.Obj", "obj", (120, 160)),
    ],
)
def test_a_box_is_level_within_its_sides(
    tmp_path: Path, name: str, file_type: str, shape: tuple[int, int]
) -> None:
    path = save(tmp_path / name, box((4.02, 3.02, 2.0), (70.0, -30.0, 8.0)), file_type)
    thing, height = load(path, shape)
    x, y = geometry.pixel_centres(shape, PIXEL)
    covered = (np.abs(x) < 2.01) & (np.abs(y) < 1.51)
    assert covered.sum() > 4000
    np.testing.assert_array_equal(height, np.where(covered, 0.0, np.nan))
    assert thing.name == path.name
    assert thing.radius == pytest.approx(np.hypot(2.01, 1.51), abs=1.5 * PIXEL)


@pytest.mark.parametrize("shape", [(240, 240), (241, 239)])
def test_a_ball_of_triangles_is_between_its_inner_and_outer_sphere(
    tmp_path: Path, shape: tuple[int, int]
) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=5.0)
    thing, height = load(save(tmp_path / "ball.ply", ball), shape)
    outer = 5.0
    inner = np.abs(np.einsum("ij,ij->i", ball.face_normals, ball.triangles[:, 0])).min()
    assert inner > 4.99
    z = height + ball.vertices[:, 2].max()
    r = np.hypot(*geometry.pixel_centres(shape, PIXEL))
    inside = r < inner
    assert np.isfinite(z[inside]).all()
    assert np.isnan(z[r > outer]).all()
    assert (z[inside] >= np.sqrt(inner**2 - r[inside] ** 2) - 1e-6).all()  # PLY holds floats
    assert (z[inside] <= np.sqrt(outer**2 - r[inside] ** 2) + 1e-6).all()
    assert thing.radius == pytest.approx(5.0, abs=1.5 * PIXEL)


def test_a_heap_of_triangles_against_brute_force() -> None:
    rng = np.random.default_rng(4)
    triangles = rng.uniform(-3, 3, (60, 1, 3)) + rng.uniform(-1.5, 1.5, (60, 3, 3))
    triangles[5, 1] = triangles[5, 0]  # a line
    triangles[6] = triangles[6, 0]  # a point
    triangles[7, :, 1] = 0.1  # upright, along a row
    shape, pixel = (71, 84), (0.06, 0.05)
    actual = top_surface(triangles, shape, pixel)
    x, y = np.meshgrid((np.arange(84) - 41.5) * 0.06, (35 - np.arange(71)) * 0.05)
    expected = np.full(shape, np.nan)
    for p, q, r in triangles:
        turn = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        if turn == 0:
            continue
        share_q = ((x - p[0]) * (r[1] - p[1]) - (y - p[1]) * (r[0] - p[0])) / turn
        share_r = ((q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])) / turn
        z = p[2] + share_q * (q[2] - p[2]) + share_r * (r[2] - p[2])
        inside = (share_q >= 0) & (share_r >= 0) & (share_q + share_r <= 1)
        expected = np.fmax(expected, np.where(inside, z, np.nan))
    assert 0.2 < np.isnan(expected).mean() < 0.8
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9)


def test_only_what_is_seen_from_above_counts(tmp_path: Path) -> None:
    mushroom = trimesh.Scene([box((1.01, 1.01, 5), (0, 0, 0)), box((3.01, 3.01, 1), (0, 0, 3))])
    _, height = load(save(tmp_path / "mushroom.stl", mushroom))
    x, y = geometry.pixel_centres(SHAPE, PIXEL)
    covered = np.maximum(np.abs(x), np.abs(y)) < 1.505
    np.testing.assert_array_equal(height, np.where(covered, 0.0, np.nan))


def test_several_bodies_make_one_object(tmp_path: Path) -> None:
    pair = trimesh.Scene([box((1, 1, 2), (-2, 0, 0)), box((1, 1, 3), (2, 0, 0))])
    thing, _ = load(save(tmp_path / "pair.obj", pair))
    height = thing.height(np.array([-2.0, 0.0, 2.0]), np.zeros(3))
    np.testing.assert_allclose(height, [-0.5, np.nan, 0.0], atol=1e-6)


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_object(path, SHAPE, (PIXEL, PIXEL))
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("size", "words"),
    [((0.004, 0.006, 0.002), "contains no pixel.*millimetres"), ((4e3, 6e3, 2e3), "too large.*millimetres")],
)
def test_metres_and_micrometres_are_refused(
    tmp_path: Path, size: tuple[float, float, float], words: str
) -> None:
    refused(save(tmp_path / "box.stl", box(size, (0, 0, 0))), words)


def test_a_cloud_of_points_is_not_a_surface(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    trimesh.PointCloud(np.random.default_rng(5).uniform(size=(20, 3))).export(path)
    refused(path, "contains no triangles")


@pytest.mark.parametrize(
    ("suffix", "content"),
    [(".stl", b""), (".ply", b"not a mesh"), (".obj", np.random.default_rng(6).bytes(3000))],
)
def test_files_that_are_no_meshes(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"text{suffix}"
    path.write_bytes(content)
    refused(path, "contains no triangles|not a readable")


def joined(faces: list[list[int]]) -> trimesh.Trimesh:
    """Make triangles of the middle of a sheet's edge, and places round it."""
    corners = [
        [0, -1, 0],
        [0, 1, 0],
        [2, 0, -0.5],
        [-2, 0, -0.5],
        [0.5, 0.0, 1],
        [4, 1, -1],
        [4, -1, -1],
        [5, 0, 0],
    ]
    return trimesh.Trimesh(corners, faces, process=False)


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
def test_triangles_that_are_no_surface(tmp_path: Path, suffix: str) -> None:
    refused(
        save(tmp_path / f"apart{suffix}", joined([[0, 2, 1], [5, 6, 7]])),
        "is not a surface.*are not connected",
    )
    fin = joined([[0, 2, 1], [0, 1, 3], [0, 1, 4]])
    refused(save(tmp_path / f"fin{suffix}", fin), "is not a surface: at 1 of its edges three triangles")
    _, height = load(save(tmp_path / f"roof{suffix}", joined([[0, 2, 1], [0, 1, 3]])))
    assert np.isfinite(height).sum() > 1000


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    refused(tmp_path / "missing.stl", "No such file")
    (tmp_path / "folder.ply").mkdir()
    refused(tmp_path / "folder.ply", "directory")


def test_without_trimesh_the_remedy_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path / "box.stl", box((1, 1, 1), (0, 0, 0)))
    monkeypatch.setitem(sys.modules, "trimesh", None)
    refused(path, r"pip install 'mirrorskin\[mesh\]'")


TRIANGLE = "v 0 0 0\nv 2 0 0\nv 0 2 1\nv 2 2 0.5\nf 1 2 3\nf 2 4 3\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0\nv 2 0\nv 0 2\nf 1 2 3\n", "export it again"),
        ("v 0 0 0 1\nv 2 0 0 1\n" * 2 + "f 1 2 9\n", "mesh"),
        (TRIANGLE.replace("0.5", "1e308"), "beyond 1e.09 mm"),
        (TRIANGLE.replace("0.5", "nan"), "not finite"),
        ("v\nf 1 2 3\n", "export it"),
        ("", "export it"),
    ],
)
def test_a_text_that_is_not_a_mesh_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(InputError, match=words) as refusal:
        load(tmp_path / "a.obj")
    assert "\n" not in str(refusal.value)


def test_files_that_a_mesh_names_are_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(trimesh.resolvers.FilePathResolver, "get", lambda self, name: asked.append(name))
    (tmp_path / "a.obj").write_text(f"mtllib ../secret.mtl\nusemtl gold\n{TRIANGLE}")
    load(tmp_path / "a.obj")
    assert asked == []
