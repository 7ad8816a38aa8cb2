"""Least squares over lamps: the reference against the normal equations."""

import numpy as np
from launches import launch

from mirrorskin.kernels.lambert import lambert_add, lambert_normals

PIXELS = 1100
GENERATOR = np.random.default_rng(0)
LIGHTS = GENERATOR.normal(size=(9, 3)).astype(np.float32)
FRAMES = GENERATOR.integers(0, 256, (9, PIXELS))


def test_the_triangle_holds_the_normal_equations():
    triangle = np.zeros((11, PIXELS))
    for first in (0, 4):
        part = slice(first, first + 5 if first else 4)
        lambert_add(FRAMES[part], LIGHTS[part], first == 0, np.array([3.0]), 10.0, 255.0, triangle)
    upper = np.zeros((4, 4))
    upper[np.triu_indices(4)] = triangle[:10, 7]
    upper[3, 3] **= 0.5
    seen = (FRAMES[:, 7] > 13) & (FRAMES[:, 7] < 255)
    rows = np.column_stack([LIGHTS, FRAMES[:, 7] - 3.0])[seen]
    np.testing.assert_allclose(upper.T @ upper, rows.T @ rows, atol=1e-8)
    assert triangle[10, 7] == seen.sum()


def test_the_kernel_solves_as_the_reference(device):
    lit = (FRAMES > 40) & (np.arange(PIXELS) % 7 > np.arange(9)[:, None] - 5)
    triangle = np.zeros((11, PIXELS))
    normals = GENERATOR.normal(size=(3, PIXELS))
    frames = np.where(lit, LIGHTS @ normals * 50 + 300 + GENERATOR.normal(size=FRAMES.shape), 0)
    lambert_add(frames, LIGHTS, True, np.array([0.0]), 10.0, 1e6, triangle)
    triangle = triangle.astype(np.float32)
    triangle[:, 0], triangle[7, 1] = 0, 0  # without any lamp, and with two
    shapes = [(PIXELS, 3), *[(PIXELS,)] * 5]
    expected = [np.empty(shape) for shape in shapes]
    lambert_normals(triangle, *expected)
    found = [device.array("map", shape, np.float32) for shape in shapes[:-1]]
    found.append(device.array("samples", shapes[-1], np.int32))
    kernel = device.kernel("lambert", "lambert_normals", FRAME="uchar")
    items = -(-PIXELS // device.layout.tile)
    launch(kernel, items, PIXELS, device.given("triangle", triangle), *found)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.download(), np.where(np.isfinite(other), other, np.nan), rtol=2e-3)
    assert np.isnan(expected[2][:2]).all()
    assert np.isfinite(expected[2]).mean() > 0.9
