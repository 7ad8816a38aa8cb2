"""The edges' kernels do what their reference does, and that is what it says."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.kernels import edges

LEAST, QUIET, SURE = np.float32(np.radians(10)), np.float32(np.radians(1.6)), np.float32(4)
SHAPES = [(1, 1), (1, 9), (9, 1), (2, 3), (23, 37)]


def scene(shape, seed):
    """A roof across the picture, as noisy as sigma says; some pixels lack a normal, some lack contact."""
    generator = np.random.default_rng(seed)
    row, column = np.indices(shape)
    slope = np.where(column + 0.4 * row < shape[1] / 2, 0.1, 0.5)
    vectors = np.stack([slope, 0.1 * np.sin(row), np.ones(shape)], axis=-1)
    sigma = np.where(row < shape[0] / 2, 0.005, generator.uniform(0.0, 0.1, shape))
    vectors += sigma[..., None] * generator.normal(0, 0.7, vectors.shape)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    lost = generator.random(shape) < 0.05
    vectors[lost], sigma[lost] = np.nan, np.nan
    contact = (generator.random(shape) > 0.04) & (np.hypot(row - 5, column - 5) > 3)
    return vectors.astype(np.float32), sigma.astype(np.float32), contact


def put(device, values, dtype):
    array = device.array("values", values.shape, dtype)
    array.host[:] = values
    array.upload()
    return array


def run(device, name, inputs, out, *numbers):
    """Run a kernel over a picture; return what it wrote."""
    shape = inputs[-1].shape[:2] if inputs[-1].dtype == bool else out.shape
    kinds = [np.uint8 if one.dtype == bool else np.float32 for one in inputs]
    arrays = [put(device, one, kind) for one, kind in zip(inputs, kinds, strict=True)]
    written = put(device, out, out.dtype)
    items = -(-shape[0] * shape[1] // device.shape.tile)
    size = np.int32(shape[0]), np.int32(shape[1])
    device.kernel("edges", name)(items, *arrays, written, *size, *numbers, moved=1)
    return written.download().copy()


@pytest.mark.parametrize("shape", SHAPES)
def test_kernels_and_reference_draw_the_same(device, shape):
    vectors, sigma, contact = scene(shape, seed=shape[1])
    clean = run(device, "edges_clean", [contact], np.full(shape, 7, np.uint8))
    np.testing.assert_array_equal(clean, edges.edges_clean(contact))
    clean = clean.astype(bool)
    jumps = run(
        device,
        "edges_jumps",
        [vectors, sigma, clean],
        np.full((2, *shape), 7, np.float32),
        LEAST,
        QUIET,
        SURE,
    )
    told = edges.edges_jumps(vectors.astype(float), sigma.astype(float), clean, LEAST, QUIET, SURE)
    same = (jumps > 0) == (told > 0)
    assert np.mean(same) > 0.999  # float32 decides of what is at a limit
    np.testing.assert_allclose(jumps[same], told[same], rtol=1e-4, atol=1e-6)
    lines = run(device, "edges_thin", [jumps, clean], np.full(shape, 7, np.uint8))
    np.testing.assert_array_equal(lines, edges.edges_thin(jumps.astype(float), clean))
    assert shape[0] < 9 or (told > 0).any()


def test_a_pixel_that_all_or_all_but_one_contradict_is_turned_over():
    contact = np.ones((7, 9), bool)
    contact[2, 2] = contact[4, 6] = contact[4, 7] = False  # one alone, two side by side
    contact[6, 3:6] = False  # a short line at the border
    clean = edges.edges_clean(contact)
    assert clean[2, 2]
    assert clean[4, 6]
    assert clean[4, 7]
    np.testing.assert_array_equal(clean[6, 3:6], [True, False, True])
    np.testing.assert_array_equal(edges.edges_clean(~contact), ~clean)
    assert edges.edges_clean(np.array([[False]]))[0, 0] == False  # noqa: E712 - nobody contradicts it


@pytest.mark.parametrize("degrees", [9.0, 11.0, 40.0])
def test_a_jump_is_the_angle_between_both_sides(degrees):
    angle = np.radians(degrees)
    vectors = np.broadcast_to([0.0, 0.0, 1.0], (5, 8, 3)).copy()
    vectors[:, 4:] = np.sin(angle), 0, np.cos(angle)
    for sigma in (0.0, 0.02, 0.05):  # of windows one, two and three deep
        jumps = edges.edges_jumps(vectors, np.full((5, 8), sigma), np.ones((5, 8), bool), LEAST, QUIET, SURE)
        np.testing.assert_allclose(jumps[0, :, 3], angle if degrees > 10 else 0, atol=1e-12)
        assert not jumps[1].any()


def test_a_jump_within_its_noise_is_none():
    vectors = np.broadcast_to([0.0, 0.0, 1.0], (9, 12, 3)).copy()
    vectors[:, 6:] = np.sin(0.2), 0, np.cos(0.2)
    for sigma, seen in ((0.12, True), (0.2, False)):
        # Means of 15 on either side are uncertain by sigma sqrt(2 / 15).
        assert (4 * sigma * np.sqrt(2 / 15) < 0.2) == seen
        jumps = edges.edges_jumps(
            vectors, np.full((9, 12), sigma), np.ones((9, 12), bool), LEAST, QUIET, SURE
        )
        assert (jumps[0, 4, 5] > 0) == seen


def test_lines_are_thin_and_where_contact_ends_lie_outside():
    jumps = np.zeros((2, 5, 9))
    jumps[0, :, 2:6] = 0.2, 0.3, 0.25, 0.1
    clean = np.ones((5, 9), bool)
    clean[:, 7:] = False
    lines = edges.edges_thin(jumps, clean)
    expected = np.zeros((5, 9), bool)
    expected[:, 4] = True  # the largest is between 3 and 4, and 4's other jump is larger than 3's
    expected[:, 7] = True
    np.testing.assert_array_equal(lines, expected)
