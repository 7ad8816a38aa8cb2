"""Colours of heights follow their scale, whatever the surface around."""

import numpy as np
import pytest
from matplotlib import colormaps

from mirrorskin.view.drawing.colours import MISSING_RGB
from mirrorskin.view.result.maps import height_picture


def coloured(height, filled=None, span=(-1.0, 1.0)):
    height = np.asarray(height, np.float32)
    none = np.zeros(height.shape, bool) if filled is None else filled
    return height_picture(height, none, span).astype(int)


def test_each_height_has_the_colour_of_the_scale():
    height = np.linspace(-1, 1, 20).reshape(4, 5)
    colours = np.multiply(255, colormaps["viridis"]((height + 1) / 2)[..., :3])
    np.testing.assert_allclose(coloured(height), colours, atol=1)


def test_holes_have_their_own_colour_and_do_not_spread():
    height = np.zeros((9, 9), np.float32)
    height[4, 4] = np.nan
    colours = coloured(height)
    assert tuple(colours[4, 4]) == MISSING_RGB
    np.testing.assert_array_equal(colours[4, 3], coloured(np.zeros((9, 9)))[4, 3])


def test_what_was_filled_is_orange_whether_high_or_low():
    filled = np.zeros((4, 6), bool)
    filled[:, 3:] = True
    for level in (-0.9, 0.9):
        measured, orange = coloured(np.full((4, 6), level), filled)[0, [0, 5]]
        assert orange[0] > orange[1] > orange[2]
        assert not measured[0] > measured[1] > measured[2]


def test_damaged_heights_have_colours():
    height = np.zeros((4, 6), np.float32)
    height[1, 1:4] = 3e38, -3e38, np.inf
    colours = coloured(height)
    assert tuple(colours[1, 3]) == MISSING_RGB
    assert tuple(colours[3, 5]) != MISSING_RGB


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2)])
@pytest.mark.parametrize("value", [0.0, np.nan])
def test_the_smallest_pictures_have_colours(shape, value):
    colours = height_picture(np.full(shape, value, np.float32), np.zeros(shape, bool), (0.0, 0.0))
    assert colours.shape == (*shape, 3)
    assert colours.dtype == np.uint8
    assert (tuple(colours[0, 0]) == MISSING_RGB) == np.isnan(value)
