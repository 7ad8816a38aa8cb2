"""A picture that is too large for a device is processed in bands, with the same answer."""

import numpy as np
import pytest
from bare import find_onset, ready
from presses import assert_equal, random_press

from mirrorskin.engine import Onset
from mirrorskin.engine.base import tiling
from mirrorskin.io import Block
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.array import BorrowedBuffer
from mirrorskin.kernels.errors import DeviceError

FRAMES = random_press("uint8", 30, (23, 31), seed=5)
TRAVEL = np.arange(30) * 0.1
SMALLEST = 3 * 64 * 4  # those of one row


def test_the_room_shrinks_before_the_picture_is_cut_and_one_row_must_fit(small_device):
    small_device.max_allocation = 14 * 23 * 31
    search = ready(Onset(device=small_device), FRAMES, TRAVEL)
    assert 1 <= len(search.staging_buffer) <= 14
    small_device.max_allocation = SMALLEST - 1
    with pytest.raises(DeviceError, match="one row of 31 pixels does not fit"):
        ready(Onset(device=small_device), FRAMES, TRAVEL)


def test_bands_leave_the_device_to_each_other(small_device):
    small_device.max_allocation = SMALLEST
    search = ready(Onset(dark=20, bright=220, device=small_device), FRAMES, TRAVEL)
    search.push(FRAMES, travel=TRAVEL)
    search.result()
    arrays = [
        array for band in search.operation._picture.bands for array in (*band.maps.values(), *band._buffers)
    ]
    on_device = [array._buffer is not None for array in arrays]
    assert all(on_device) if small_device.info.shares_memory else not any(on_device)


def test_frames_in_the_room_are_not_copied(device):
    search = ready(Onset(device=device), FRAMES, TRAVEL)
    search.staging_buffer[:30] = FRAMES
    band = search.operation._picture.bands[0]
    (staged,) = band.stage(search.staging_buffer[:30])
    assert staged.frames == slice(0, 30)
    if device.info.shares_memory:
        assert np.shares_memory(staged.array.host, search.staging_buffer)
    search.push(search.staging_buffer[:30:2], travel=TRAVEL[:15])
    expected = find_onset(FRAMES[::2].copy(), TRAVEL[:15], device=device)
    assert_equal(search.result(), expected)


def test_the_room_of_a_picture_in_bands_holds_many_frames(small_device):
    small_device.max_allocation = SMALLEST
    search = ready(Onset(dark=20, bright=220, device=small_device), FRAMES, TRAVEL)
    search.staging_buffer[:30] = FRAMES
    search.push(search.staging_buffer[:30], travel=TRAVEL)
    small_device.max_allocation = 10**9
    assert_equal(search.result(), find_onset(FRAMES, TRAVEL, dark=20, bright=220, device=small_device))


def test_many_frames_are_copied_to_a_device_in_multiples_of_16(device, monkeypatch):
    monkeypatch.setattr(tiling, "_RESERVED", 4 * FRAMES[0].nbytes)
    monkeypatch.setattr(tiling, "_PIECE", 29 * FRAMES[0].nbytes)
    search = ready(Onset(dark=20, bright=220, device=device), FRAMES, TRAVEL)
    band = search.operation._picture.bands[0]
    assert [staged.count for staged in band.stage(FRAMES)] == (
        [30] if device.info.shares_memory else [16, 14]
    )
    search.push(FRAMES, travel=TRAVEL)
    monkeypatch.undo()
    assert_equal(search.result(), find_onset(FRAMES, TRAVEL, dark=20, bright=220, device=device))


def lent(frames, offset):
    """Place frames so many bytes behind a page, as a mapped file may hold them."""
    memory = np.zeros(frames.nbytes + 8192, np.uint8)
    start = -memory.ctypes.data % 4096 + offset
    placed = memory[start : start + frames.nbytes].view(frames.dtype).reshape(frames.shape)
    placed[:] = frames
    placed.flags.writeable = False
    return placed


def test_lent_frames_are_worked_on_where_they_lie(device):
    placed = lent(FRAMES, 128)
    search = ready(Onset(device=device), FRAMES, TRAVEL)
    (staged,) = search.operation._picture.bands[0].stage(placed, stay_valid=True)
    in_place = isinstance(staged.array, BorrowedBuffer) and np.shares_memory(staged.array.host, placed)
    assert in_place == device.info.shares_memory


def test_lent_frames_stay_until_their_kernels_are_done(device):
    search = ready(Onset(dark=20, bright=220, device=device), FRAMES, TRAVEL)
    for start in range(0, 30, 3):
        part = slice(start, start + 3)
        frames = lent(FRAMES[part], 64)
        search.push_block(Block(frames, start, travel=TRAVEL[part], stays_valid=True))
    assert_equal(search.result(), find_onset(FRAMES, TRAVEL, dark=20, bright=220, device=device))


def test_a_block_may_be_written_anew_after_it_was_pushed(device):
    search = ready(Onset(dark=20, bright=220, device=device), FRAMES, TRAVEL)
    for start in range(0, 30, 3):
        part = slice(start, start + 3)
        block = FRAMES[part].copy()
        search.push(block, travel=TRAVEL[part])
        block[:] = 255 - block
    assert_equal(search.result(), find_onset(FRAMES, TRAVEL, dark=20, bright=220, device=device))


def test_a_device_that_refuses_lent_memory_gets_copies(device, monkeypatch):
    def refuse(device, name, values, address):
        if not values.flags.writeable:
            raise DeviceError("it cannot hold frames: read only")
        return borrow(device, name, values, address)

    borrow = device_layer.BorrowedBuffer
    monkeypatch.setattr(device_layer, "BorrowedBuffer", refuse)
    search = ready(Onset(dark=20, bright=220, device=device), FRAMES, TRAVEL)
    search.push_block(Block(lent(FRAMES, 64), 0, travel=TRAVEL, stays_valid=True))
    assert_equal(search.result(), find_onset(FRAMES, TRAVEL, dark=20, bright=220, device=device))
