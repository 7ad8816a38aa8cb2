from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from bare import bare, ready

from mirrorskin.engine.press.onset import Onset
from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.cameras.ring import MEMORY, Ring, usual_slots
from mirrorskin.io import Block

SHAPE = (5, 7)
SOON = 60.0  # seconds, that nothing here takes


def put(ring: Ring, number: int, lost: int = 0) -> None:
    ring.slot()[...] = number
    ring.put(time=100.0 + number, number=number, lost=lost)


def fill(ring: Ring, start: int, stop: int) -> None:
    for number in range(start, stop):
        put(ring, number)


def take_all(ring: Ring) -> list[int]:
    """Take one by one, and let each go again."""
    numbers: list[int] = []
    while True:
        try:
            frames = ring.take(1, 0.0)
        except HardwareError:
            return numbers
        assert np.all(frames.pixels == frames.number[0])
        numbers += frames.number.tolist()


def test_frames_are_side_by_side_in_the_rings_own_memory() -> None:
    ring = Ring(SHAPE, np.uint16, 20)
    place = ring.slot()
    assert place.ctypes.data % 4096 == 0
    fill(ring, 0, 6)
    first = ring.take(3, SOON)
    second = ring.take(3, SOON)
    assert first.pixels.shape == (3, *SHAPE)
    assert first.pixels.flags.c_contiguous
    assert np.shares_memory(first.pixels, place)
    assert second.pixels.ctypes.data == first.pixels.ctypes.data + first.pixels.nbytes


def test_what_was_taken_cannot_be_written_to() -> None:
    ring = Ring(SHAPE, np.uint8, 4)
    put(ring, 1)
    with pytest.raises(ValueError, match="read-only"):
        ring.take(1, SOON).pixels[0, 0, 0] = 5


def test_64_bytes_beyond_the_last_place_can_be_read(device) -> None:
    ring = Ring((1, 1), np.uint8, 1)
    for number in range(4):
        put(ring, number)
        frames = ring.take(1, SOON)
        beyond = np.lib.stride_tricks.as_strided(frames.pixels.ravel(), (65,))
        assert int(beyond.sum()) >= number  # reading it does not end the program
        if device.info.shares_memory:
            assert device.borrow("frames", frames.pixels) is not None


@pytest.mark.parametrize("slots", [1, 2, 3, 8])
def test_a_place_that_is_referred_to_is_never_overwritten(slots) -> None:
    ring = Ring(SHAPE, np.uint8, slots)
    kept = []
    for number in range(60):
        put(ring, number)
        if number % 3 == 0:
            kept.append(ring.take(1, SOON))
    fill(ring, 60, 100)
    assert len({int(frames.number[0]) for frames in kept}) == 20
    for frames in kept:
        np.testing.assert_array_equal(frames.pixels, frames.number[0])


def test_a_reader_that_keeps_everything_loses_nothing() -> None:
    ring = Ring(SHAPE, np.uint16, 4)
    kept = []
    for number in range(300):
        put(ring, number)
        kept.append(ring.take(1, SOON))
    assert [int(frames.number[0]) for frames in kept] == list(range(300))
    assert all(np.all(frames.pixels == frames.number[0]) for frames in kept)
    assert ring.dropped == 0


@pytest.mark.parametrize("slots", [1, 2, 5])
def test_of_too_many_frames_the_oldest_are_dropped_and_counted(slots) -> None:
    ring = Ring(SHAPE, np.uint8, slots)
    fill(ring, 0, 12)
    assert ring.dropped == 12 - slots
    frames = ring.take(1, SOON)
    assert frames.number[0] == 12 - slots
    assert frames.dropped == 12 - slots
    assert take_all(ring) == list(range(13 - slots, 12))


def test_frames_lost_before_they_came_are_counted_where_they_are_missing() -> None:
    ring = Ring(SHAPE, np.uint8, 20)
    put(ring, 0)
    put(ring, 1)
    put(ring, 5, lost=3)
    put(ring, 6)
    before, after = ring.take(9, SOON), ring.take(9, SOON)
    assert (before.number.tolist(), before.dropped) == ([0, 1], 0)
    assert (after.number.tolist(), after.dropped) == ([5, 6], 3)
    assert ring.dropped == 3


def test_forgotten_frames_are_not_dropped() -> None:
    ring = Ring(SHAPE, np.uint8, 3)
    fill(ring, 0, 6)
    ring.flush()
    with pytest.raises(HardwareError):
        ring.take(1, 0.0)
    put(ring, 6)
    frames = ring.take(1, SOON)
    assert (frames.number.tolist(), frames.dropped) == ([6], 0)
    assert ring.dropped == 3


def test_no_frame_in_time_is_an_error_that_names_the_camera(clock) -> None:
    ring = Ring(SHAPE, np.uint8, 3, "camera 5", clock)
    begun = clock.now()
    with pytest.raises(HardwareError, match=r"camera 5 delivered no frame for 0.05 s"):
        ring.take(1, 0.05)
    assert clock.now() - begun == pytest.approx(0.05)


def test_a_frame_or_a_failure_wakes_a_reader_that_waits(clock) -> None:
    ring = Ring(SHAPE, np.uint8, 3, clock=clock)
    begun = clock.now()
    clock.later(1.5, lambda: put(ring, 7))
    clock.later(2.5, lambda: ring.fail(HardwareError("gone")))
    assert ring.take(1, SOON).number.tolist() == [7]
    assert clock.now() == begun + 1.5
    with pytest.raises(HardwareError, match="gone"):
        ring.take(1, SOON)
    assert clock.now() == begun + 2.5


def test_what_came_before_a_failure_can_still_be_taken() -> None:
    ring = Ring(SHAPE, np.uint8, 3)
    fill(ring, 0, 2)
    ring.fail(HardwareError("gone"))
    ring.fail(HardwareError("gone twice"))
    assert ring.take(1, SOON).number.tolist() == [0]
    assert ring.take(1, SOON).number.tolist() == [1]
    with pytest.raises(HardwareError, match=r"^gone$"):
        ring.take(1, SOON)
    assert str(ring.error) == "gone"


def test_a_fast_writer_and_a_slow_reader_never_meet_in_a_place() -> None:
    ring = Ring((16, 16), np.uint16, 6)
    count = 4000
    sent = threading.Event()

    def write() -> None:
        for number in range(count):
            ring.slot()[...] = number
            ring.put(time=number, number=number)
            if number % 50 == 0:
                time.sleep(0)
        sent.set()

    writer = threading.Thread(target=write)
    writer.start()
    kept, numbers, missed = [], [], 0
    while not (sent.is_set() and numbers and numbers[-1] == count - 1):
        frames = ring.take(4, SOON)
        missed += frames.dropped
        numbers += frames.number.tolist()
        kept = [*kept[-3:], frames]
        for block in kept:
            np.testing.assert_array_equal(block.pixels, block.number[:, None, None] * np.ones((1, 16, 16)))
    writer.join()
    assert numbers == sorted(set(numbers))
    assert len(numbers) + missed == count
    assert missed == ring.dropped


def test_a_device_works_in_the_ring_while_the_camera_goes_on(device) -> None:
    count, shape = 40, (9, 13)
    frames = np.random.default_rng(5).integers(0, 60, (count, *shape)).astype(np.uint8)
    frames[17:, 2:7, 3:11] += 150
    travel = np.linspace(0.0, 2.0, count)
    whole = bare(Onset(device=device), frames, travel=travel)
    ring = Ring(shape, np.uint8, 6)
    search = ready(Onset(device=device), frames, travel)
    sent = taken_so_far = 0
    for stop in range(2, count + 1, 2):
        while sent < stop:
            ring.slot()[...] = frames[sent]
            ring.put(time=sent, number=sent)
            sent += 1
        while taken_so_far < stop:
            taken = ring.take(2, SOON)
            part = slice(taken_so_far, taken_so_far + len(taken.pixels))
            search.push_block(Block(taken.pixels, taken_so_far, travel=travel[part], stays_valid=True))
            taken_so_far = part.stop
            ring.slot()[...] = 255  # a kernel that is still at work must not see it
    for name in ("height", "status", "frame"):
        np.testing.assert_array_equal(getattr(search.result(), name), getattr(whole, name))


def test_the_usual_ring_fills_its_memory_or_holds_half_a_second() -> None:
    assert usual_slots((480, 640), np.uint8, 100.0) == MEMORY // (480 * 640)
    assert usual_slots((480, 640), np.uint16) == MEMORY // (480 * 640 * 2)
    assert usual_slots((480, 640), np.uint8, 1000.0) == 500
    assert usual_slots((10000, 10000), np.float32) == 4
    assert usual_slots((8, 8), np.uint8, 30.0) == 1024
