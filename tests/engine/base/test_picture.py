"""Maps of a picture in bands or on several devices are those of the whole, and stay where the frames are."""

import gc
import weakref

import numpy as np
import pytest
from bare import bare, bare_run

from mirrorskin import engine, io
from mirrorskin.engine.base.picture import Appended, PerFrame, Picture
from mirrorskin.engine.base.tiling import Planes
from mirrorskin.engine.optical.focus import Focus
from mirrorskin.engine.optical.photometric import PhotometricStereo

SHAPE, COUNT = (23, 31), 9
FRAMES = np.random.default_rng(3).integers(20, 200, (COUNT, *SHAPE)).astype(np.uint8)
DARKS = np.random.default_rng(4).uniform(0, 10, SHAPE)
LEVELS = {"dark": 20, "bright": 200, "noise": 9.0}
CASES = {
    "focus": (Focus(noise=1.0, radius=3), {"travel": np.arange(COUNT) * 0.1}, 6000),
    "onset": (engine.Onset(**LEVELS), {"travel": np.arange(COUNT) * 0.1}, 3 * 64 * 4),
    "change-point": (engine.ChangePoint(**LEVELS), {"travel": np.arange(COUNT) * 0.1}, 64 * 25),
    "lamps": (PhotometricStereo(zenith=0.6, dark=DARKS), {"phase": np.arange(COUNT) * 0.7}, 64 * 4 * 11),
}
SOURCE = """
#include "common.clh"
__kernel void add(__global const FRAME *frames, const int count, const int first, const int pixels,
                  const int stride, MAP weights, OUT sums, __global int *last) {
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int k = 0; k < count; ++k)
        for (int p = low; p < end; ++p) {
            sums[p] += frames[k * pixels + p];
            sums[stride + p] += weights[k] * frames[k * pixels + p];
            last[p] = first + k;
        }
}
"""


class Sums(engine.Operation):
    """Sums of the brightness, weighted by travel and not."""

    dtypes = (np.dtype("u1"),)
    for_device = True

    total = io.Map("sum", "counts")
    moment = io.Map("sum, weighted by travel", "counts mm")
    last = io.Map("number of the last frame", dtype="int32")

    def start(self, shape, dtype):
        self.picture = Picture(self, SOURCE, {"sums": Planes(2, np.float32), "last": np.int32})
        self.picture.fill("sums", 0)
        self.picture.fill("last", np.arange(shape[1]))

    def push(self, frames, *, travel):
        self.picture.scan("add", frames, weights=PerFrame(travel))

    def result(self):
        total, moment, last = self.picture.take(("sums", 0), ("sums", 1), "last")
        return {"total": total, "moment": moment, "last": last}


CASES["own"] = (Sums(), {"travel": np.arange(COUNT)}, 64 * 4 * 2)


def same(actual, expected):
    assert list(actual) == list(expected)
    for name in expected:
        np.testing.assert_array_equal(actual[name], expected[name], err_msg=name)


@pytest.mark.parametrize("name", CASES)
def test_maps_stay_on_the_device_of_the_frames(device, name):
    operation, positions, _ = CASES[name]
    result = bare(operation, device.from_host("frames", FRAMES, FRAMES.dtype), **positions)
    assert result.on_device(next(iter(result))) is not None
    same(result, bare(operation.with_options(device=device), FRAMES, **positions))


def test_the_sums_are_those_of_numpy():
    result = bare(Sums(), FRAMES, [4], travel=np.arange(COUNT))
    np.testing.assert_array_equal(result.total, FRAMES.sum(axis=0))
    np.testing.assert_array_equal(result.moment, np.tensordot(np.arange(COUNT), FRAMES, 1))
    assert (result["last"] == COUNT - 1).all()


@pytest.mark.parametrize("name", CASES)
def test_memory_is_free_with_the_last_reference(device, name):
    operation, positions, _ = CASES[name]
    run = bare_run(operation.with_options(device=device))
    run.push(FRAMES, **positions)
    band = weakref.ref(run.operation._picture.bands[0])
    gc.disable()
    del run
    gc.enable()
    assert band() is None


def test_numbers_of_earlier_frames_are_copied_to_the_device_once(card):
    numbers = Appended(2)
    card.profile.clear()
    for frame in range(100):
        numbers.append([[frame, -frame]])
        placed = numbers.on("numbers", card)
    np.testing.assert_array_equal(placed.read()[:100], np.outer(np.arange(100), [1, -1]))
    uploads = [
        record for record in card.profile.records() if (record.kind, record.name) == ("upload", "numbers")
    ]
    assert sum(record.bytes for record in uploads) <= 2 * 100 * 2 * 4
    numbers.clear()
    numbers.append([[5, 6], [7, 8]])
    np.testing.assert_array_equal(numbers.on("numbers", card).read()[:2], [[5, 6], [7, 8]])
