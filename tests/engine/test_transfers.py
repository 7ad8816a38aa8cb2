"""Copies of each call between the host and a device with its own memory: no table entry may rise."""

from typing import NamedTuple

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.layout import GPU_LAYOUT

SHAPE = 120, 150
PIXELS = 120 * 150
FRAMES = 16

RANDOM = np.random.default_rng(1)
PRESS = RANDOM.normal(np.where(np.arange(FRAMES) < 9, 30, 200)[:, None, None], 2, (FRAMES, *SHAPE)).astype(
    np.uint8
)
TRAVEL = 0.1 * np.arange(FRAMES)
PHASE = 2 * np.pi / 8 * np.arange(FRAMES)
WAVE = 10 * np.cos(PHASE - 0.5)[:, None, None]
TURNS = RANDOM.normal(100 + WAVE, 1, (FRAMES, *SHAPE)).astype(np.uint8)
SLOPES = RANDOM.normal(0, 0.1, (2, *SHAPE)).astype(np.float32)
LEVELS = {"dark": 30, "bright": 200}


class Moved(NamedTuple):
    """Number of copies up, of waits, and of bytes per pixel in both directions."""

    uploads: int
    up: float
    downloads: int
    down: float
    waits: int


CALLS = {
    # Frames, both levels, and the travel; height, sigma and frame of 4 bytes, and the status.
    "onset": (engine.find_onset, (PRESS, TRAVEL), LEVELS, Moved(4, FRAMES, 3, 13, 1)),
    "onset, levels per pixel": (
        *(engine.find_onset, (PRESS, TRAVEL)),
        {name: np.full(SHAPE, level) for name, level in LEVELS.items()},
        Moved(4, FRAMES + 8, 3, 13, 1),
    ),
    "change point": (engine.find_change_point, (PRESS, TRAVEL), LEVELS, Moved(2, FRAMES, 4, 13, 1)),
    # Frames, their places, the basis and the fit.
    "correlation": (engine.correlate, (TURNS, PHASE), {}, Moved(4, FRAMES, 4, 16, 1)),
    # Frames and phases of each of two turns, and the scale.
    "normals": (
        *(engine.estimate_normals, (TURNS, PHASE)),
        {"tilt": 0.05, "zenith_gain": 200, "noise": 1.0},
        Moved(5, FRAMES, 7, 33, 1),
    ),
    "heights": (engine.integrate, (*SLOPES, 0.1), {"sigma": False}, Moved(2, 8, 1, 4, 1)),
    # Slopes, mask and offsets; flags, heights and sums, and those of conjugate gradients twice.
    "heights within a mask": (
        *(engine.integrate, (*SLOPES, 0.1)),
        {"mask": np.hypot(*np.ogrid[-60:60, -75:75]) > 20, "sigma": False},
        Moved(4, 9, 8, 5, 5),
    ),
}
SMALL = 0.3  # bytes per pixel: tables of frames


def moved(device, call):
    """Return what a call moves when it is made again, and the allocations on the device."""
    call()
    device.finish()
    device.profile.clear()
    call()
    runs, nbytes = dict.fromkeys(("upload", "download", "wait"), 0), dict.fromkeys(("upload", "download"), 0)
    allocations = 0
    for record in device.profile.records():
        allocations += record.runs * (record.name == "allocation")
        if record.kind in runs:
            runs[record.kind] += record.runs
        if record.kind in nbytes:
            nbytes[record.kind] += record.bytes
    up, down = (nbytes[kind] / PIXELS for kind in nbytes)
    return Moved(runs["upload"], up, runs["download"], down, runs["wait"]), allocations


@pytest.mark.parametrize("name", CALLS)
def test_a_call_moves_no_more_than_it_must(card, name):
    function, arrays, options, limits = CALLS[name]
    result, allocations = moved(card, lambda: function(*arrays, **options, device=card))
    assert result.uploads <= limits.uploads
    assert result.up <= limits.up + SMALL
    assert result.downloads <= limits.downloads
    assert result.down == pytest.approx(limits.down, abs=SMALL)
    assert result.waits <= limits.waits
    assert allocations == 0


@pytest.mark.parametrize("name", CALLS)
def test_answers_are_those_of_shared_memory(card, name):
    function, arrays, options, _ = CALLS[name]
    shared = Device(card.context.devices[0])
    if not shared.info.shares_memory:
        pytest.skip("the device does not share the host's memory")
    shared.layout = GPU_LAYOUT
    expected, result = (function(*arrays, **options, device=device) for device in (shared, card))
    for key in expected:
        np.testing.assert_array_equal(result[key], expected[key], err_msg=key)


def test_maps_of_a_press_that_goes_on_are_copies(card):
    run = engine.Run(engine.Onset(**LEVELS, device=card))
    run.push(PRESS[:10], travel=TRAVEL[:10])
    first = run.result()
    before = {key: first[key].copy() for key in ("height", "status", "frame")}
    run.push(PRESS[10:], travel=TRAVEL[10:])
    whole = engine.find_onset(PRESS, TRAVEL, **LEVELS, device=card)
    for key, values in before.items():
        np.testing.assert_array_equal(first[key], values)
        np.testing.assert_array_equal(run.result()[key], whole[key])
