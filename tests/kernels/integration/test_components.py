"""The components' kernels equal their reference, and the reference is correct."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin.engine.integration.graph import Levelling, PixelGraph, find_components
from mirrorskin.engine.integration.validation import check_inputs
from mirrorskin.kernels.integration import components
from mirrorskin.kernels.integration.links import SLOPE

SHAPES = [(1, 1), (1, 9), (9, 1), (23, 37), (130, 11), (5, 300)]
PLANE = 0.3, -0.2, 0.7


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("heights", [0, 1, 2])
@pytest.mark.parametrize("parts", ["one", "many"])
def test_kernels_and_reference_agree(device, shape, heights, parts):
    random = np.random.default_rng(shape[0])
    heights_map = np.where(random.random(shape) < 0.2, random.normal(2, 1, shape), np.nan)
    heights_map[0, 0] = 1.0
    weights_map, random_mask = random.random(shape) + 0.1, random.random(shape) < 0.6
    random_mask[0, 0] = True
    inputs = check_inputs(
        np.zeros(shape),
        np.zeros(shape),
        (0.5, 0.25),
        mask=random_mask | (parts == "one"),
        known_heights=heights_map if heights else None,
        known_height_weights=weights_map if heights == 2 else None,
    )
    graph = PixelGraph(device, shape)
    flags = graph.upload(inputs).copy()
    pieces = find_components(flags, by_links=False)
    assert min(shape) < 9 or (pieces.count > 20) == (parts == "many")
    relief = random.normal(0, 1, shape).astype(np.float32)
    array = device.from_host("relief", np.stack([2 * relief, relief]))
    levelling = Levelling(graph)

    rise = PLANE[0] * 0.5, -PLANE[1] * 0.25, PLANE[2]
    arguments = flags, pieces.labels, relief, rise
    offsets = np.zeros(pieces.count)
    weights = inputs.known_heights, inputs.known_height_weights
    for of_unknown, maps, mean in ((1, (None, None), 0.0), (0, weights, 5.0)):
        if np.any(pieces.offset_unknown == of_unknown):
            sums = [part[np.newaxis] for part in components.components_sum(*arguments, *maps, pieces.count)]
            components.components_offsets(*sums, pieces.offset_unknown, of_unknown, mean, offsets)
    exact = components.components_add_offsets(*arguments, offsets)
    levelled = levelling.level(pieces, array, [(0.0, 0.0, 0.0), PLANE], 5.0)
    np.testing.assert_allclose(levelled[1], exact, atol=1e-5)
    assert np.isnan(exact).sum() == np.sum(pieces.labels < 0)


def test_a_piece_without_known_height_has_the_mean_nothing_and_others_meet_what_is_known():
    flags = np.full((2, 3), SLOPE, np.uint8)
    flags[1, 2] |= 8
    labels = np.array([[0, -1, 1], [0, -1, 1]], np.int32)
    relief, plane = np.array([[1.0, 9, 2], [3, 9, 4]]), (10.0, 100.0, 1000.0)
    total, weight = components.components_sum(flags, labels, relief, plane, None, None, 2)
    assert (total / weight).tolist() == [1052, 1073]
    heights = np.array([[0, 0, 0], [0, 0, 1130.0]])
    total, weight = components.components_sum(flags, labels, relief, plane, heights, None, 2)
    assert (total[1], weight.tolist()) == (4 + 1120 - 1130, [0, 1])
    levelled = components.components_add_offsets(flags, labels, relief, plane, np.array([-1052.0, 6]))
    np.testing.assert_array_equal(levelled, [[-51, np.nan, 1028], [51, np.nan, 1130]])
