"""The scale from counts to zeniths: its forms, and what is refused."""

import numpy as np
import pytest

from mirrorskin.engine.rotation.scale import make_scale
from mirrorskin.io import InputError

SHAPE = (3, 4)


def planes(gain=200.0, offset=10.0, dark=None, bright=None):
    return make_scale(gain, offset, dark, bright, SHAPE)


def test_numbers_make_one_scale_for_all():
    scale = planes()
    np.testing.assert_allclose(scale.planes, [10.0, 1 / 200, -np.inf, np.inf])
    assert not scale.per_pixel
    assert not scale.ends
    np.testing.assert_array_equal(scale.thinned(5), scale.planes)


@pytest.mark.parametrize("name", ["gain", "offset", "dark", "bright"])
def test_one_map_makes_a_scale_of_each_pixel(name):
    numbers = {"gain": 200.0, "offset": 10.0, "dark": 20.0, "bright": 210.0}
    single = planes(**numbers).planes
    numbers[name] = np.full(SHAPE, numbers[name])
    scale = planes(**numbers)
    assert scale.per_pixel
    assert scale.planes.shape == (4, *SHAPE)
    np.testing.assert_array_equal(scale.planes, np.broadcast_to(single[:, None, None], (4, *SHAPE)))
    np.testing.assert_array_equal(scale.thinned(5), np.repeat(single[:, None], 3, axis=1))


def test_ends_are_zeniths():
    scale = planes(dark=30.0, bright=210.0)
    assert scale.ends
    np.testing.assert_allclose(scale.planes[2:], [0.1, 1.0])
    np.testing.assert_allclose(planes(dark=30.0).planes[2:], [0.1, np.inf])
    np.testing.assert_allclose(planes(bright=30.0).planes[2:], [-np.inf, 0.1])
    assert planes(bright=30.0).ends


def test_a_gain_below_0_turns_the_ends_round():
    np.testing.assert_allclose(planes(-200.0, 230.0, 30.0, 210.0).planes, [230, -1 / 200, 0.1, 1.0])
    np.testing.assert_allclose(planes(-200.0, 230.0, dark=30.0).planes[2:], [-np.inf, 1.0])
    np.testing.assert_allclose(planes(-200.0, 230.0, bright=210.0).planes[2:], [0.1, np.inf])


def test_a_pixel_without_a_gain_or_an_offset_has_no_scale():
    gain, offset = np.full(SHAPE, 200.0), np.full(SHAPE, 10.0)
    gain[0, :3], offset[1, 0], offset[1, 1] = [0, np.nan, np.inf], np.nan, np.inf
    per_count = planes(gain, offset).planes[1]
    lost = np.zeros(SHAPE, bool)
    lost[0, :3] = lost[1, :2] = True
    np.testing.assert_array_equal(np.isnan(per_count), lost)
    np.testing.assert_allclose(per_count[~lost], 1 / 200)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gain": 0.0}, "zenith gain 0.0: counts per radian other than 0 are needed"),
        ({"gain": np.nan}, "zenith gain nan"),
        ({"gain": np.zeros(SHAPE)}, "the zenith gain of every pixel is 0 or no number"),
        ({"offset": np.nan}, "zenith offset is no number"),
        ({"offset": np.full(SHAPE, np.nan)}, "zenith offset is no number"),
        ({"gain": np.ones((4, 3))}, r"zenith gain has shape \(4, 3\), the frames are 3 x 4"),
        ({"offset": np.ones(3)}, r"zenith offset has shape \(3,\)"),
        ({"dark": np.ones((1, 4))}, r"dark has shape \(1, 4\)"),
        ({"bright": np.ones((2, 3, 4))}, r"bright has shape \(2, 3, 4\)"),
        ({"dark": np.nan}, "dark is no number: give the counts at which brightness ends"),
        ({"dark": np.inf}, "dark is no number"),
        ({"bright": np.full(SHAPE, np.nan)}, "bright is no number"),
        ({"dark": 210.0, "bright": 30.0}, "dark is not below bright at any pixel: are they swapped"),
        ({"dark": 30.0, "bright": np.full(SHAPE, 30.0)}, "dark is not below bright"),
    ],
)
def test_what_is_no_scale_is_refused_in_one_line(given, message):
    with pytest.raises(InputError, match=message) as caught:
        planes(**given)
    assert "\n" not in str(caught.value)
