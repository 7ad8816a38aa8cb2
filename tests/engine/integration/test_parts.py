"""Parts of a surface with breaks: what holds them together, and what places them where nothing does."""

import numpy as np
import pytest

from mirrorskin.engine.integration.graph import Components
from mirrorskin.engine.integration.parts import (
    find_doubt,
    find_parts,
    find_ties,
    join_fragments,
    largest_within,
    place_parts,
)

SHAPE = 12, 20


def halves(confidence, rows=slice(None)):
    """Return the confidences of links: 1, and a confidence between the halves of the picture."""
    right, down = np.ones(SHAPE, np.float32), np.ones(SHAPE, np.float32)
    right[:, -1], down[-1] = 0, 0
    right[:, 9] = 1e-12
    right[rows, 9] = confidence
    return right, down


ALL = np.ones(SHAPE, bool)
LEFT = np.arange(20) < 10 * np.ones(SHAPE)


@pytest.mark.parametrize(("confidence", "count"), [(1e-2, 1), (4e-4, 1), (1e-6, 2)])
def test_what_many_faint_links_hold_is_one_part(confidence, count):
    assert find_parts(*halves(confidence), ALL).max() + 1 == count


def test_pixels_without_an_answer_have_no_part():
    answered = ALL.copy()
    answered[3:5, 7:12] = False
    parts = find_parts(*halves(1e-6), answered)
    np.testing.assert_array_equal(parts < 0, ~answered)
    assert set(np.unique(parts[answered])) == {0, 1}


def test_a_fragment_joins_the_part_of_its_most_confident_link():
    right, down = halves(1e-9)
    right[5, 8], down[4:6, 9] = 1e-7, 0  # one pixel of the left half is nearly alone
    right[5, 9] = 1e-5
    parts = find_parts(right, down, ALL)
    assert parts.max() == 2
    joined = join_fragments(parts, find_ties(parts, right, down))
    assert joined.max() == 1
    assert joined[5, 9] == joined[5, 10]
    np.testing.assert_array_equal(largest_within(parts, joined)[5, 9], parts[5, 10])


def placed(confidence, known_weights=None, whole=ALL):
    right, down = halves(confidence)
    parts = np.where(LEFT, 0, 1).astype(np.int32)
    difference = np.where(LEFT, -1.0, 3.0).astype(np.float32)
    components = Components(np.where(whole, 0, -1).astype(np.int32), np.array([known_weights is None]))
    weights = np.zeros(SHAPE, np.float32) if known_weights is None else known_weights
    return place_parts(parts, find_ties(parts, right, down), difference, components, weights)


def test_parts_that_nothing_holds_are_where_the_plain_surface_has_them():
    lifts = placed(1e-12)
    assert lifts[1] - lifts[0] == pytest.approx(4, abs=1e-3)


def test_parts_that_links_hold_stay():
    lifts = placed(1.0)
    assert lifts[1] - lifts[0] == pytest.approx(0, abs=1e-3)


def test_parts_with_known_heights_stay():
    lifts = placed(1e-12, known_weights=np.ones(SHAPE, np.float32))
    np.testing.assert_allclose(lifts, 0, atol=1e-3)


def test_doubt_is_about_the_mean_of_a_part():
    parts = np.where(LEFT, 0, 1).astype(np.int32)
    difference = np.where(LEFT, 5.0, np.where(np.arange(20) % 2, 2.0, -2.0)).astype(np.float32)
    doubt = find_doubt(difference, parts)
    np.testing.assert_allclose(doubt, np.where(LEFT, 0, 4), atol=1e-6)
