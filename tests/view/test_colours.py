import numpy as np
import pytest
from matplotlib.colors import to_rgb

from mirrorskin.view.drawing import colours


def test_normals_have_the_customary_colours():
    normals = np.array([[[0, 0, 1], [1, 0, 0], [np.nan] * 3, [0, -1, 0]]], np.float32)
    edges = np.array([[0, 0, 0, 1]], np.uint8)
    assert colours.normal_colours(normals, edges).tolist() == [
        [[127, 127, 255], [255, 127, 127], [176, 196, 222], [0, 0, 0]]
    ]


@pytest.mark.parametrize("name", ["MISSING", "FILLED"])
def test_a_colour_is_the_same_by_name_and_by_numbers(name):
    colour = np.multiply(255, to_rgb(getattr(colours, name))).round()
    assert tuple(colour) == getattr(colours, f"{name}_RGB")


def test_heights_go_from_violet_to_yellow_and_holes_have_their_own_colour():
    shown = colours.height_colours(np.array([[-9.0, -2.0, 0.0, 5.0, np.nan]], np.float32), -2.0, 0.0)
    violet, yellow = shown[0, 1].tolist(), shown[0, 2].tolist()
    assert violet == shown[0, 0].tolist() == [68, 1, 84]
    assert yellow == shown[0, 3].tolist()
    assert min(yellow[:2]) > 200 > yellow[2]
    assert tuple(shown[0, 4]) == colours.MISSING_RGB


def test_a_few_wild_values_do_not_take_the_colours_of_the_others():
    values = np.linspace(-1, 0, 10_001)
    values[5], values[6], values[7] = -50, 70, np.nan
    low, high = colours.span(values)
    assert -1 <= low < -0.99
    assert -0.01 < high <= 0


def test_nothing_known_has_ends_all_the_same():
    low, high = colours.span(np.full((2, 3), np.nan))
    assert low < high
