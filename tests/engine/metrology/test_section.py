"""Cross-sections of surfaces that are known in closed form."""

import numpy as np
import pytest
from height_maps import cap, places, result_of

from mirrorskin import io
from mirrorskin.engine.metrology.sections import section

SIZE = (0.1, 0.25)
SHAPE = (21, 33)
NAN = np.nan


def slope(shape=SHAPE, size=SIZE):
    """A plane: between pixels it is what it is at pixels, interpolated."""
    x, y = places(shape, size)
    return 0.3 * x - 0.7 * y + 1


def test_a_plane_is_a_line_between_any_two_points():
    start, end = (-1.43, -2.2), (1.52, 1.9)
    cut = section(result_of(slope(), SIZE), start, end)
    assert (cut.x[0], cut.y[0]) == pytest.approx(start)
    assert (cut.x[-1], cut.y[-1]) == pytest.approx(end)
    assert cut.distance[-1] == pytest.approx(np.hypot(2.95, 4.1))
    assert np.diff(cut.distance) == pytest.approx(cut.distance[1])
    assert cut.height == pytest.approx(0.3 * cut.x - 0.7 * cut.y + 1, abs=1e-6)
    assert cut.unit == "mm"


@pytest.mark.parametrize(
    ("end", "step"), [((1.0, 0.0), 0.1), ((0.0, 1.0), 0.25), ((1.0, 2.5), np.hypot(0.1, 0.25) / np.sqrt(2))]
)
def test_samples_are_one_pixel_apart_along_any_direction(end, step):
    cut = section(result_of(slope(), SIZE), (0.0, 0.0), end)
    assert cut.distance[1] == pytest.approx(step, rel=0.5 / len(cut.distance))  # both ends are samples


def test_a_section_goes_from_its_start_to_its_end_and_y_runs_up():
    height = slope()
    up = section(result_of(height, SIZE), (0.0, -2.5), (0.0, 2.5))
    down = section(result_of(height, SIZE), (0.0, 2.5), (0.0, -2.5))
    assert up.height == pytest.approx(height[::-1, 16], abs=1e-6)
    assert down.height == pytest.approx(height[:, 16], abs=1e-6)


def test_without_ends_it_is_the_row_of_the_highest_point():
    height = cap(SHAPE, SIZE, 5.0, 2.0, (0.31, -0.5, 0.0))
    cut = section(result_of(height, SIZE, sigma=0.002))
    row = 12  # y = (10 - 12) * 0.25 = -0.5
    np.testing.assert_array_equal(cut.height, np.float32(height[row]))
    assert cut.x == pytest.approx((np.arange(33) - 16) * 0.1)
    assert cut.y == pytest.approx(-0.5)
    assert cut.distance == pytest.approx(np.arange(33) * 0.1)
    np.testing.assert_array_equal(np.isfinite(cut.sigma), np.isfinite(cut.height))
    assert np.nanmax(cut.sigma) == pytest.approx(0.002)


def test_of_a_flat_ring_the_section_goes_through_the_middle():
    x, y = places((41, 41), (0.1, 0.1))
    height = np.where(abs(np.hypot(x, y) - 1.5) < 0.3, 0.0, -1.0)
    height += 0.002 * y  # nearly level
    assert abs(section(result_of(height, (0.1, 0.1))).y[0]) <= 0.05


def test_a_spike_is_not_the_highest_point():
    height = cap(SHAPE, SIZE, 5.0, 2.0)
    height[3, 5] = 9.0
    assert section(result_of(height, SIZE)).y[0] == 0


def test_what_was_filled_may_be_the_highest_point_and_is_told():
    height = cap(SHAPE, SIZE, 5.0, 2.0)
    filled = np.asarray(height > -0.05)
    result = result_of(height, SIZE, sigma=0.001, filled=filled.astype(np.uint8))
    cut = section(result)
    assert cut.y[0] == 0
    np.testing.assert_array_equal(cut.filled, filled[10])
    assert np.isnan(cut.sigma[cut.filled]).all()
    assert np.isfinite(cut.height[cut.filled]).all()


def test_next_to_a_hole_nothing_is_told():
    height = slope()
    height[10, 16] = NAN
    level = section(result_of(height, SIZE), (-1.0, 0.125), (1.0, 0.125))  # between rows 9 and 10
    assert np.flatnonzero(np.isnan(level.height)).tolist() == [10]
    assert section(result_of(height, SIZE), (-1.0, 0.25), (1.0, 0.25)).height[10] == pytest.approx(
        height[9, 16]
    )


def test_nothing_is_told_between_two_pieces():
    height = np.zeros(SHAPE)
    height[:, 20:] = 5.0
    component = (height > 0).astype(np.int32)
    result = result_of(height, SIZE, component=component, offset_unknown=np.ones(2, np.uint8))
    cut = section(result, (-1.05, 0.0), (1.05, 0.0))  # midway between pixels
    assert set(cut.height[np.isfinite(cut.height)]) == {0.0, 5.0}
    assert np.isnan(cut.height).sum() == 1


def test_nothing_is_told_outside_of_the_picture():
    cut = section(result_of(slope(), SIZE), (0.0, 0.0), (3.0, 0.0))
    np.testing.assert_array_equal(np.isnan(cut.height), cut.x > 1.6 + 1e-9)


def test_without_a_pixel_size_it_is_told_in_pixels():
    result = result_of(cap(SHAPE, (1, 1), 50.0, 9.0), x=None, y=None)
    cut = section(result)
    assert cut.unit == "px"
    np.testing.assert_array_equal(cut.distance, np.arange(33))
    with pytest.raises(io.InputError, match=r"no pixel size to place a section by: .* --pixel-size"):
        section(result, (0.0, 0.0), (1.0, 0.0))


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2)])
@pytest.mark.parametrize("sized", [True, False])
def test_tiny_pictures_have_sections(shape, sized):
    result = result_of(np.ones(shape), **({} if sized or shape == (1, 1) else {"x": None, "y": None}))
    cut = section(result)
    assert len(cut.height) == shape[1]
    assert (cut.height == 1).all()


def test_what_cannot_be_cut_is_refused():
    with pytest.raises(io.InputError, match="has no heights"):
        section(io.Result(azimuth=np.zeros((2, 2), np.float32)))
    with pytest.raises(io.InputError, match="2 turns"):
        section(io.Result(height=np.zeros((2, 3, 3), np.float32)))
    with pytest.raises(io.InputError, match="no height to look for"):
        section(result_of(np.full((3, 3), NAN)))
    with pytest.raises(io.InputError, match="both ends, or neither"):
        section(result_of(slope(), SIZE), (0.0, 0.0))
    with pytest.raises(io.InputError, match="one point"):
        section(result_of(slope(), SIZE), (0.0, 0.0), (0.0, 0.0))
    for far in (1e300, 1e3):
        with pytest.raises(io.InputError, match="far outside of the picture"):
            section(result_of(slope(), SIZE), (0.0, 0.0), (far, 0.0))
