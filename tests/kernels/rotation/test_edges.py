"""The edges' kernels equal their reference, and the reference is correct."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.rotation.edges import LIMITS, EdgeDrawing, find_edges
from mirrorskin.kernels.rotation import edges
from mirrorskin.kernels.rotation.edges import COARSE, FINE, NEAR, PASSES

SHAPES = [(1, 1), (1, 9), (9, 1), (2, 3), (23, 37), (40, 131)]


def scene(shape, seed):
    """A roof across the picture, as noisy as sigma says; some pixels lack a normal, some lack contact."""
    generator = np.random.default_rng(seed)
    row, column = np.indices(shape)
    slope = np.where(column + 0.4 * row < shape[1] / 2, 0.1, 0.5)
    vectors = np.stack([slope, 0.1 * np.sin(row / 9), np.ones(shape)], axis=-1)
    sigma = np.where(row < shape[0] / 2, 0.005, generator.uniform(0.0, 0.1, shape))
    vectors += sigma[..., None] * generator.normal(0, 0.7, vectors.shape)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    lost = generator.random(shape) < 0.05
    vectors[lost], sigma[lost] = np.nan, np.nan
    contact = (generator.random(shape) > 0.04) & (np.hypot(row - 5, column - 5) > 3)
    return vectors.astype(np.float32), sigma.astype(np.float32), contact.astype(np.uint8)


def draw(vectors, sigma, contact):
    """The whole way, in the reference."""
    clean = edges.edges_clean(contact)
    cells = edges.edges_cells(vectors, sigma, contact, clean)
    undecided, lines = np.ones_like(contact), np.zeros_like(contact)
    for chosen in PASSES:
        looked = edges.edges_join(cells, lines) if chosen is COARSE else cells
        strength, direction = edges.edges_jumps(looked, chosen, LIMITS, undecided)
        lines = edges.edges_thin(strength, direction, chosen, lines)
    return edges.edges_bound(clean, lines)


def level(shape=(25, 25), bend=0.0, jump=0.0, at=12):
    """Cells of a surface that bends by so many degrees a column and jumps behind a column."""
    column = np.indices(shape)[1]
    angle = np.radians(bend * (column - at) + jump * (column > at))
    vectors = np.stack([np.sin(angle), np.zeros(shape), np.cos(angle)], axis=-1)
    touched = np.ones(shape, np.uint8)
    return edges.edges_cells(vectors.astype(np.float32), np.zeros(shape, np.float32), touched, touched)


@pytest.mark.parametrize("shape", SHAPES)
def test_kernels_and_reference_draw_the_same(device, shape):
    vectors, sigma, contact = scene(shape, seed=shape[1])
    drawn, expected = find_edges(vectors, sigma, contact, device=device), draw(vectors, sigma, contact)
    assert np.mean(drawn != expected) < 0.002  # float32 decides of what is at a limit
    assert min(shape) < 9 or expected.sum() > 8


def test_a_drawing_depends_on_nothing_that_was_drawn_before(device):
    first, second = (scene((23, 37), seed) for seed in (1, 2))
    drawing = EdgeDrawing(device, (23, 37))
    for maps in (first, second):
        drawing.take(*maps)
        for _ in drawing.steps(3):
            pass
        np.testing.assert_array_equal(drawing.lines(), find_edges(*maps, device=device))


def test_flags_that_neighbours_contradict_are_turned_over():
    contact = np.ones((9, 12), np.uint8)
    contact[2, 2] = contact[5, 4] = contact[5, 5] = 0  # one alone, two side by side
    contact[:, 9:] = 0
    contact[4, 11] = 1
    expected = np.ones((9, 12), np.uint8)
    expected[:, 9:] = 0
    np.testing.assert_array_equal(edges.edges_clean(contact), expected)
    assert edges.edges_clean(np.zeros((1, 1), np.uint8))[0, 0] == 0
    assert edges.edges_clean(np.ones((1, 1), np.uint8))[0, 0] == 1


@pytest.mark.parametrize("chosen", [NEAR, FINE, COARSE], ids=["near", "fine", "coarse"])
@pytest.mark.parametrize("jump", [20.0, 45.0])
def test_a_jump_has_its_size_and_its_direction(chosen, jump):
    cells = level(jump=jump)
    looked = edges.edges_join(cells, np.zeros((25, 25), np.uint8)) if chosen is COARSE else cells
    strength, direction = edges.edges_jumps(looked, chosen, LIMITS, np.ones((25, 25), np.uint8))
    chord = 2 * np.sin(np.radians(jump) / 2)
    assert strength[12].max() == pytest.approx(chord / LIMITS.floor, rel=1e-3)
    assert strength[12].argmax() in (12, 13)
    assert direction[12, strength[12].argmax()] == 0


@pytest.mark.parametrize("bend", [1.0, 2.3])
def test_a_bend_is_not_a_jump(bend):
    cells = level(bend=bend)
    for chosen in PASSES:
        looked = edges.edges_join(cells, np.zeros((25, 25), np.uint8)) if chosen is COARSE else cells
        strength, _ = edges.edges_jumps(looked, chosen, LIMITS, np.ones((25, 25), np.uint8))
        assert not strength.any()


def test_contact_ends_at_its_last_pixels_and_the_picture_ends_nothing():
    clean = np.ones((6, 8), np.uint8)
    clean[:, 5:] = 0
    lines = np.zeros((6, 8), np.uint8)
    lines[:, 1] = lines[:, 3] = lines[:, 6] = 1
    bound = edges.edges_bound(clean, lines)
    expected = np.zeros((6, 8), np.uint8)
    expected[:, 1] = expected[:, 4] = 1  # what lies beside the end makes way, and so does what is not touched
    np.testing.assert_array_equal(bound, expected)
