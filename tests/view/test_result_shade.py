"""Heights under a lamp: level ground keeps its colour, slopes towards the upper left are bright."""

import numpy as np
import pytest
from matplotlib import colormaps

from mirrorskin.view.colours import MISSING_RGB
from mirrorskin.view.result.maps import shaded

PIXEL = 0.1, 0.25


def lit(height, filled=None, span=(-1.0, 1.0), pixel=PIXEL):
    height = np.asarray(height, np.float32)
    none = np.zeros(height.shape, bool) if filled is None else filled
    return shaded(height, none, pixel, span).astype(int)


def roof(along, shape=(20, 30)):
    """Two slopes of 45 degrees that meet in the middle, up along an axis and down again."""
    step = PIXEL[1 - along] * np.arange(shape[along])
    heights = step[shape[along] // 2] - np.abs(step - step[shape[along] // 2])
    return np.broadcast_to(heights[:, np.newaxis] if along == 0 else heights, shape)


@pytest.mark.parametrize("level", [-1.0, 0.3, 1.0])
def test_level_ground_has_the_colour_of_its_height(level):
    colour = np.multiply(255, colormaps["viridis"]((level + 1) / 2)[:3])
    np.testing.assert_allclose(lit(np.full((4, 5), level)), np.broadcast_to(colour, (4, 5, 3)), atol=1)


@pytest.mark.parametrize("along", [0, 1])
def test_what_faces_up_or_left_in_the_picture_is_brighter_than_what_faces_away(along):
    colours = np.moveaxis(lit(roof(along), span=(-9, 9)).sum(axis=-1), along, 0)
    first, last = colours[2:7].mean(), colours[-7:-2].mean()
    assert first - last > 60


def test_light_does_not_depend_on_the_size_of_pixels_but_on_slopes():
    both = [
        lit(roof(1) * scale, span=(-9 * scale, 9 * scale), pixel=(scale * PIXEL[0], 1)) for scale in (1, 3)
    ]
    np.testing.assert_allclose(*both, atol=1)


def test_holes_have_their_own_colour_and_do_not_spread():
    height = np.zeros((9, 9), np.float32)
    height[4, 4] = np.nan
    colours = lit(height)
    assert tuple(colours[4, 4]) == MISSING_RGB
    np.testing.assert_array_equal(colours[4, 3], lit(np.zeros((9, 9)))[4, 3])


def test_what_was_filled_is_orange_whether_high_or_low():
    filled = np.zeros((4, 6), bool)
    filled[:, 3:] = True
    for level in (-0.9, 0.9):
        measured, orange = lit(np.full((4, 6), level), filled)[0, [0, 5]]
        assert orange[0] > orange[1] > orange[2]
        assert not measured[0] > measured[1] > measured[2]


def test_damaged_heights_have_colours():
    height = np.zeros((4, 6), np.float32)
    height[1, 1:4] = 3e38, -3e38, np.inf
    colours = lit(height)
    assert tuple(colours[1, 3]) == MISSING_RGB
    assert tuple(colours[3, 5]) != MISSING_RGB


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2)])
@pytest.mark.parametrize("value", [0.0, np.nan])
def test_the_smallest_pictures_have_colours(shape, value):
    colours = shaded(np.full(shape, value, np.float32), np.zeros(shape, bool), PIXEL, (0.0, 0.0))
    assert colours.shape == (*shape, 3)
    assert colours.dtype == np.uint8
    assert (tuple(colours[0, 0]) == MISSING_RGB) == np.isnan(value)
