"""Frames are read where they lie, wherever that is; memory is used again, and results are nobody else's."""

import ctypes
import mmap
import threading

import numpy as np
import pytest
from presses import random_press

from mirrorskin import engine
from mirrorskin.io import InputError
from mirrorskin.kernels import memory

SHAPE = 16, 61, 67
TRAVEL, PHASE = 0.1 * np.arange(16), 2 * np.pi * np.arange(16) / 16
WORK = {
    "find_onset": lambda frames, device: engine.find_onset(frames, TRAVEL, device=device, **REFERENCES),
    "find_change_point": lambda frames, device: engine.find_change_point(
        frames, TRAVEL, device=device, **REFERENCES
    ),
    "correlate": lambda frames, device: engine.correlate(frames, PHASE, device=device),
    "estimate_normals": lambda frames, device: engine.estimate_normals(
        frames, PHASE, tilt=0.05, zenith_gain=300, device=device
    ),
}
REFERENCES = {"dark": 20, "bright": 200}


def of_type(name):
    return random_press(name, *SHAPE[:1], SHAPE[1:], seed=8)


def at(offset, frames):
    """Copy frames to so many bytes behind the begin of a page."""
    room = np.zeros(frames.nbytes + 2 * mmap.PAGESIZE, np.uint8)
    start = -room.ctypes.data % mmap.PAGESIZE + offset
    placed = np.ndarray(frames.shape, frames.dtype, room.data, start)
    placed[:] = frames
    return placed


def read_only(frames):
    placed = frames.copy()
    placed.flags.writeable = False
    return placed


def before_a_forbidden_page(frames, gap):
    """Copy frames so that so many bytes lie between them and a page that cannot be read."""
    size = -(-(frames.nbytes + gap) // mmap.PAGESIZE) * mmap.PAGESIZE
    pages = mmap.mmap(-1, size + mmap.PAGESIZE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(pages))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mprotect(ctypes.c_void_p(address + size), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
    placed = np.frombuffer(pages, frames.dtype, frames.size, size - gap - frames.nbytes).reshape(frames.shape)
    placed[:] = frames
    return placed


PLACES = {
    "one byte behind a page": lambda frames: at(1, frames),
    "two bytes behind a page": lambda frames: at(2, frames),
    "read-only": read_only,
    "Fortran order": np.asfortranarray,
    "backwards": lambda frames: frames[::-1].copy()[::-1],
    "every other": lambda frames: np.repeat(frames, 2, axis=0)[::2],
    "a part of each row": lambda frames: np.pad(frames, ((0, 0), (0, 0), (3, 5)))[:, :, 3:-5],
    "the end of memory": lambda frames: before_a_forbidden_page(frames, 0),
    "a word before the end of memory": lambda frames: before_a_forbidden_page(frames, 32),
}


def maps(result):
    return result.maps()


def assert_same(found, expected):
    for name, values in maps(expected).items():
        np.testing.assert_array_equal(maps(found)[name], values, err_msg=name)


@pytest.mark.parametrize("work", WORK)
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_it_does_not_matter_where_frames_lie(device, work, dtype):
    frames = of_type(dtype)
    expected = WORK[work](frames, device)
    for place, put in PLACES.items():
        placed = put(frames)
        np.testing.assert_array_equal(placed, frames, err_msg=place)
        assert_same(WORK[work](placed, device), expected)
        np.testing.assert_array_equal(placed, frames, err_msg=place)


@pytest.mark.parametrize("work", WORK)
def test_numbers_in_the_other_order_of_bytes_are_refused(device, work):
    with pytest.raises(InputError, match="uint8, uint16 or float32"):
        WORK[work](of_type("uint16").astype(">u2"), device)


@pytest.mark.parametrize("place", PLACES)
def test_the_tail_of_a_push_may_be_where_memory_ends(device, place):
    frames = of_type("uint8")
    search = engine.Onset(device=device, **REFERENCES)
    for part in (slice(0, 9), slice(9, 10), slice(10, 16)):
        search.push(PLACES[place](frames[part]), travel=TRAVEL[part])
    assert_same(search.result(), WORK["find_onset"](frames, device))


@pytest.mark.parametrize("work", WORK)
def test_answers_do_not_depend_on_what_memory_held_before(device, work, monkeypatch):
    def soiled(nbytes, zeroed):
        found = take(nbytes, zeroed)
        if not zeroed:
            found[:] = 0x7F
        return found

    take, frames = memory.take, of_type("uint8")
    expected = WORK[work](frames, device)
    monkeypatch.setattr(memory, "take", soiled)
    assert_same(WORK[work](frames, device), expected)


@pytest.mark.parametrize("work", WORK)
def test_a_result_stays_whatever_comes_after(device, work):
    frames = of_type("uint8")
    first = WORK[work](frames, device)
    kept = {name: values.copy() for name, values in maps(first).items()}
    for _ in range(2):
        WORK[work](255 - frames, device)
    engine.free_memory()
    for name, values in kept.items():
        np.testing.assert_array_equal(maps(first)[name], values, err_msg=name)
        maps(first)[name][...] = 1  # it is the caller's


@pytest.mark.parametrize(
    ("operation", "where", "options"),
    [
        (engine.Onset, {"travel": TRAVEL}, REFERENCES),
        (engine.ChangePoint, {"travel": TRAVEL}, REFERENCES),
        (engine.Correlate, {"phase": PHASE}, {}),
        (engine.Normals, {"phase": PHASE}, {"tilt": 0.05, "zenith_gain": 300, "noise": 2.0}),
    ],
)
def test_a_result_on_the_way_stays_when_more_frames_follow(device, operation, where, options):
    frames = of_type("uint8")
    (name, positions), found = *where.items(), operation(device=device, **options)
    found.push(frames[:8], **{name: positions[:8]})
    first = found.result()
    kept = {name: values.copy() for name, values in maps(first).items()}
    found.push(frames[8:], **{name: positions[8:]})
    last = found.result()
    assert any(np.any(maps(last)[name] != values) for name, values in kept.items())
    for name, values in kept.items():
        np.testing.assert_array_equal(maps(first)[name], values, err_msg=name)


def test_memory_is_used_again():
    engine.free_memory()
    first = memory.take(300_000, zeroed=False)
    address = first.ctypes.data
    view = first[10:20].view(np.uint16)
    view[:] = 7
    del first
    assert memory.take(300_000, zeroed=False).ctypes.data != address  # the view still needs it
    del view
    again = memory.take(290_000, zeroed=True)
    assert again.ctypes.data == address
    assert not again.any()
    del again
    engine.free_memory()
    assert not memory._kept


def test_no_more_memory_is_kept_than_is_said(monkeypatch):
    monkeypatch.setattr(memory, "KEPT", 1_000_000)
    engine.free_memory()
    taken = [memory.take(300_000, zeroed=False) for _ in range(5)]
    last = taken[-1].ctypes.data
    while taken:
        del taken[0]
        assert sum(map(len, memory._kept)) <= 1_000_000
    assert memory.take(300_000, zeroed=False).ctypes.data == last


def test_threads_do_not_get_each_others_memory():
    def work(number):
        for _ in range(200):
            mine = memory.take(100_000 + 1000 * number, zeroed=False)
            mine[:] = number
            wrong.extend(mine[mine != number])

    wrong = []
    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
