"""Conversion of a height map to triangles."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import io

X, Y = io.pixel_axes((7, 10), (0.5, 0.25))


def sides(mesh):
    """Return two sides of each triangle, one after the other as they are listed."""
    corners = mesh.vertices[mesh.faces]
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def areas_from_above(mesh):
    """Return the areas of the triangles' shadows, positive where they are counter-clockwise."""
    a, b = sides(mesh)
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def triangles(mesh):
    """Return the pixels of each triangle."""
    return [frozenset(three) for three in mesh.pixels[mesh.faces].tolist()]


def cells(pieces):
    """Yield the pixels of each cell of four neighbours, as lists of those that are of one piece."""
    rows, columns = pieces.shape
    for row in range(rows - 1):
        for column in range(columns - 1):
            corners = [(row + i, column + j) for i in (0, 1) for j in (0, 1)]
            together = {}
            for corner in corners:
                if pieces[corner] >= 0:
                    together.setdefault(pieces[corner], []).append(corner[0] * columns + corner[1])
            yield list(together.values())


def test_a_plane_is_two_triangles_a_cell_that_face_up():
    plane = 0.2 * X - 0.7 * Y[:, None] + 3
    mesh = io.surface_mesh(plane, X, Y)
    assert (mesh.faces.shape, mesh.faces.dtype, mesh.vertices.dtype) == ((2 * 6 * 9, 3), np.int32, np.float64)
    np.testing.assert_allclose(areas_from_above(mesh), 0.5 * 0.25 / 2)
    normals = np.cross(*sides(mesh))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = np.array([-0.2, 0.7, 1]) / np.sqrt(1 + 0.2**2 + 0.7**2)
    np.testing.assert_allclose(normals, np.broadcast_to(expected, normals.shape), atol=1e-12)


def test_a_vertex_is_where_its_pixel_is():
    height = np.arange(70.0).reshape(7, 10)
    height[2, 3] = np.nan
    mesh = io.surface_mesh(height, X, Y)
    rows, columns = np.divmod(mesh.pixels, 10)
    np.testing.assert_array_equal(mesh.pixels, np.delete(np.arange(70), 23))
    np.testing.assert_array_equal(mesh.vertices, np.stack([X[columns], Y[rows], height[rows, columns]], 1))


@pytest.mark.parametrize("missing", [(0, 0), (0, 1), (1, 0), (1, 1)])
@pytest.mark.parametrize("hole", [np.nan, np.inf])
def test_three_of_a_cell_are_one_triangle(missing, hole):
    height = np.zeros((2, 2), np.float32)
    height[missing] = hole
    mesh = io.surface_mesh(height, X[:2], Y[:2])
    assert triangles(mesh) == [frozenset({0, 1, 2, 3} - {2 * missing[0] + missing[1]})]
    assert areas_from_above(mesh) == pytest.approx(0.5 * 0.25 / 2)


@pytest.mark.parametrize("pieces_too", [False, True])
def test_holes_and_pieces_stay_apart_and_all_else_is_covered(pieces_too):
    rng = np.random.default_rng(3)
    several = False
    for _ in range(20):
        height = rng.normal(size=(7, 10))
        height[rng.random((7, 10)) < 0.2] = np.nan
        pieces = rng.choice(3, (7, 10), p=(0.6, 0.3, 0.1)) if pieces_too else np.zeros((7, 10), int)
        mesh = io.surface_mesh(height, X, Y, component=pieces if pieces_too else None)
        actual = triangles(mesh)
        assert len(set(actual)) == len(actual)
        assert (areas_from_above(mesh) > 0).all()
        properties = np.where(np.isnan(height), -1, pieces)
        expected = 0
        for cell in cells(properties):
            for together in cell:
                inside = [three for three in actual if three <= set(together)]
                assert len(inside) == max(0, len(together) - 2)
                expected += len(inside)
                # The two of a full cell share a diagonal, and so cover it.
                assert len(inside) < 2 or sorted(inside[0] & inside[1]) in (
                    [together[0], together[3]],
                    [together[1], together[2]],
                )
            several |= len(cell) > 1
        assert len(actual) == expected
        np.testing.assert_array_equal(mesh.pixels, sorted(set().union(*actual)))
    assert several == pieces_too
