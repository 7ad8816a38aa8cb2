"""Edges as a user asks for them; how well they follow lines is in test_edges_targets.py."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import engine, io

SHAPE = (21, 34)


def roof(degrees=30.0, sigma=0.01):
    """Normals of a roof whose ridge runs between columns 15 and 16."""
    angle = np.radians(degrees) / 2
    facing = np.where(np.arange(SHAPE[1]) < 16, -angle, angle)
    vectors = np.stack([np.sin(facing), np.zeros_like(facing), np.cos(facing)], axis=-1)
    vectors = np.broadcast_to(vectors, (*SHAPE, 3)).astype(np.float32)
    return vectors.copy(), np.full(SHAPE, sigma, np.float32), np.ones(SHAPE, np.uint8)


def test_a_ridge_is_one_thin_line(device):
    edges = engine.find_edges(*roof(), device=device)
    assert edges.dtype == np.uint8
    inner = edges[1:-1]  # at the picture's end too few pairs are known
    assert (inner[:, 15:17].sum(axis=1) == 1).all()
    assert edges.sum() <= SHAPE[0]


def test_wrong_flags_of_contact_are_no_edges_and_true_ends_are(device):
    vectors, sigma, contact = roof(0.0)
    contact[3, 3] = contact[9, 20] = 0
    assert not engine.find_edges(vectors, sigma, contact, device=device).any()
    contact[:, 25:] = 0
    contact[8, 30] = 1
    edges = engine.find_edges(vectors, sigma, contact, device=device)
    expected = np.zeros(SHAPE, np.uint8)
    expected[:, 24] = 1
    np.testing.assert_array_equal(edges, expected)


def test_what_has_no_normal_makes_no_edge_of_its_own(device):
    vectors, sigma, contact = roof()
    vectors[:5], sigma[:5] = np.nan, np.nan
    edges = engine.find_edges(vectors, sigma, contact, device=device)
    assert not edges[:5].any()
    assert (edges[6:-1].sum(axis=1) == 1).all()


def test_a_single_pixel_has_no_edge(device):
    vectors, sigma, contact = roof()
    assert not engine.find_edges(vectors[:1, :1], sigma[:1, :1], contact[:1, :1], device=device).any()


@pytest.mark.parametrize("wrong", ["vectors", "sigma", "empty"])
def test_maps_that_do_not_fit_are_refused(wrong):
    vectors, sigma, contact = roof()
    given = {
        "vectors": (vectors[1:], sigma, contact),
        "sigma": (vectors, sigma[:, 1:], contact),
        "empty": (vectors[:0], sigma[:0], contact[:0]),
    }
    with pytest.raises(io.InputError, match="do not fit"):
        engine.find_edges(*given[wrong])
