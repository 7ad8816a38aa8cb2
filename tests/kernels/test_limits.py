"""The limits' kernels against their references, in every shape that is tried on a device."""

import numpy as np
import pytest
from launches import launch

from mirrorskin.cli.bench.limits import CHAINS, CORES, LANES
from mirrorskin.kernels import limits

SHAPES = pytest.mark.parametrize("shape", [*CORES, *LANES], ids=str)


def run(device, name, shape, words, count, *rest):
    """Run a kernel in place on a copy of some words; return them, and the sums."""
    data = device.array("words", words.shape, np.uint32)
    sums = device.array("sums", (shape.items(count), shape.lanes), np.uint32)
    data.host[:], sums.host[:] = words, 0
    data.upload()
    sums.upload()
    macros = {"LANES": shape.lanes, "WORDS": shape.words, "STRIDE": shape.stride}
    last = [sums] if name == "read_all" else []
    kernel = device.kernel("limits", name, **macros)
    launch(kernel, shape.items(count), data, count, *last, *rest)
    return data.download(), sums.download()


def random_words(count, shape):
    return np.random.default_rng(count).integers(0, 2**32, (count, shape.lanes), np.uint32)


@SHAPES
@pytest.mark.parametrize("count", [1, 127, 70_000])
def test_reading_adds_up_all_words(device, shape, count):
    words = random_words(count, shape)
    _, sums = run(device, "read_all", shape, words, count)
    np.testing.assert_array_equal(sums, limits.read_all(words, shape.words, shape.stride))
    np.testing.assert_array_equal(sums.sum(axis=0, dtype=np.uint32), words.sum(axis=0, dtype=np.uint32))


@SHAPES
@pytest.mark.parametrize("count", [1, 9001])
def test_copy_and_triad_touch_only_their_target(device, shape, count):
    words = random_words(3 * count + 5, shape)
    for name, rest in (("copy_all", []), ("triad_all", [2**31 + 3])):
        expected = words.copy()
        getattr(limits, name)(expected, count, *rest)
        found, _ = run(device, name, shape, words, count, *rest)
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shape", [*CHAINS[0], *CHAINS[1]], ids=str)
@pytest.mark.parametrize("count", [1, 8, 500, 2049])
def test_multiply_adds_are_all_done(device, shape, count):
    numbers = np.arange(count * shape.lanes, dtype=np.float32).reshape(count, shape.lanes) % 97
    data = device.array("numbers", numbers.shape, np.float32)
    data.host[:] = numbers
    data.upload()
    kernel = device.kernel(
        "limits", "multiply_all", LANES=shape.lanes, WORDS=shape.words, STRIDE=shape.stride
    )
    launch(kernel, shape.items(count), data, count, 7, -2, 3)
    limits.multiply_all(numbers, shape.stride, 7, -2.0, 3.0)
    np.testing.assert_array_equal(data.download(), numbers)
