"""A picture that a device cannot hold in one piece is worked on in bands, with the same answer."""

import numpy as np
import pytest
from presses import SPEC, assert_equal, random_press

from mirrorskin.engine import OnsetSearch, find_onset
from mirrorskin.io import Block
from mirrorskin.kernels.errors import DeviceError

FRAMES = random_press("uint8", 30, (23, 31), seed=5)
TRAVEL = np.arange(30) * 0.1
LARGEST = 2 * 768 * 4  # two planes of floats, 23 x 31 pixels in whole words
SMALLEST = 3 * 64 * 4  # the travel must fit too


@pytest.mark.parametrize("limit", [40_000, LARGEST, LARGEST - 1, 1500, SMALLEST])
def test_less_room_gives_the_same_answer(small_device, limit):
    whole = find_onset(FRAMES, TRAVEL, *SPEC["uint8"], device=small_device)
    small_device.max_allocation = limit
    search = OnsetSearch((23, 31), FRAMES.dtype, dark=20, bright=220, device=small_device)
    for start in range(0, 30, 4):
        part = slice(start, start + 4)
        search.push(Block(FRAMES[part], start, travel=TRAVEL[part]))
    assert_equal(search.result(), whole)
    assert_equal(search.result(), whole)
    assert (len(search._bands) > 1) == (limit < LARGEST)


def test_the_room_shrinks_before_the_picture_is_cut(small_device):
    small_device.max_allocation = 10 * 23 * 31
    search = OnsetSearch((23, 31), FRAMES.dtype, device=small_device)
    assert 1 <= len(search.room) <= 10


def test_one_row_that_does_not_fit_is_said_so(small_device):
    small_device.max_allocation = 2 * 64 * 4 - 1
    with pytest.raises(DeviceError, match="one row of 31 pixels does not fit"):
        OnsetSearch((23, 31), FRAMES.dtype, device=small_device)


def test_bands_leave_the_device_to_each_other(small_device):
    small_device.max_allocation = SMALLEST
    search = OnsetSearch((23, 31), FRAMES.dtype, dark=20, bright=220, device=small_device)
    search.push(Block(FRAMES, 0, travel=TRAVEL))
    search.result()
    arrays = [array for band in search._bands for array in (*band.maps.values(), band.frames)]
    on_device = [array._buffer is not None for array in arrays]
    assert all(on_device) if small_device.info.shares_memory else not any(on_device)


def test_frames_in_the_room_are_not_copied(device):
    search = OnsetSearch((23, 31), FRAMES.dtype, device=device)
    search.room[:30] = FRAMES
    band = search._bands[0]
    pieces = list(band.stage(search.room[:30]))
    assert pieces == [(0, 30)]
    every_other = search.room[:30:2]
    list(band.stage(every_other))
    np.testing.assert_array_equal(search.room[:15], FRAMES[::2])


def test_the_room_of_a_picture_in_bands_holds_many_frames(small_device):
    small_device.max_allocation = SMALLEST
    search = OnsetSearch((23, 31), FRAMES.dtype, dark=20, bright=220, device=small_device)
    search.room[:30] = FRAMES
    search.push(Block(search.room[:30], 0, travel=TRAVEL))
    small_device.max_allocation = 10**9
    assert_equal(search.result(), find_onset(FRAMES, TRAVEL, 20, 220, device=small_device))
