"""Resampling along with the object: the reference against closed forms, and the kernel against it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
from launches import launch
from numpy.typing import NDArray

from mirrorskin.kernels.device import C_TYPES, Device
from mirrorskin.kernels.registration import (
    BORDER,
    registration_admit,
    registration_mend,
    registration_resample,
    weights,
)

ALIKE = np.zeros((1, 1), np.float32), np.ones((1, 1), np.float32)
# Pixels to the right and down: a number, and what a column, a row and a millimetre of height add.
SHIFT = np.array([[1.3, 0.011, -0.017, 2.1], [-0.6, -0.021, 0.013, -1.4]], np.float32)


class Answer(NamedTuple):
    padded: NDArray[np.float32]
    registered: NDArray[np.float32]
    noise: NDArray[np.float32]


def make_room(shape: tuple[int, int]) -> Answer:
    rows, columns = shape
    padded = np.full((rows + 2 * BORDER, columns + 2 * BORDER), np.nan, np.float32)
    return Answer(padded, np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32))


def numpy_frame(frame, height, shift, offset, gain) -> Answer:
    room = make_room(frame.shape)
    registration_admit(frame, offset, gain, room.padded)
    registration_resample(room.padded, height, shift, offset, gain, room.registered, room.noise)
    return room


def device_frame(device: Device, frame, height, shift, offset, gain) -> Answer:
    given = {"frame": frame, "height": height, "shift": shift, "offset": offset, "gain": gain}
    arrays = {}
    for name, values in (given | make_room(frame.shape)._asdict()).items():
        arrays[name] = device.array(name, values.shape, values.dtype)
        arrays[name].host[:] = values
        arrays[name].upload()
    rows, columns = frame.shape
    top = {"TOP": int(np.iinfo(frame.dtype).max)} if frame.dtype.kind == "u" else {}
    macros = {"FRAME": C_TYPES[frame.dtype.name], "LEVELS": int(offset is not ALIKE[0]), **top}
    items, sizes = rows * -(-columns // device.layout.tile), (rows, columns)
    for name, wanted in (
        ("registration_admit", "frame offset gain padded"),
        ("registration_resample", "padded height shift offset gain registered noise"),
    ):
        kernel = device.kernel("registration", name, **macros)
        launch(kernel, items, *sizes, *(arrays[argument] for argument in wanted.split()))
    return Answer(*(arrays[name].download().copy() for name in Answer._fields))


def random_case(dtype: str, shape: tuple[int, int], each: bool = False) -> dict[str, Any]:
    """Frames with clipped and missing samples, heights with gaps, and shifts that leave the picture."""
    generator = np.random.default_rng(shape[1])
    kind = np.dtype(dtype)
    frame = generator.normal(100, 30, shape).astype(kind)
    some = generator.random(shape)
    frame[some < 0.01] = np.inf if kind.kind == "f" else np.iinfo(kind).max
    frame[some > 0.99] = np.nan if kind.kind == "f" else 0
    height = generator.uniform(-1, 0, shape).astype(np.float32)
    height[generator.random(shape) < 0.05] = np.nan
    offset, gain = ALIKE
    if each:
        offset, gain = (generator.uniform(*ends, shape).astype(np.float32) for ends in ((5, 20), (200, 260)))
    return {"frame": frame, "height": height, "shift": SHIFT, "offset": offset, "gain": gain}


def polynomial(x, y):
    """A surface that is cubic along rows, along columns, and in their products."""
    return (2 + x - 0.3 * x**2 + 0.05 * x**3) * (1 - 0.4 * y + 0.2 * y**2 - 0.03 * y**3)


def moved(shift, height):
    """Where each pixel's point is, in columns and rows."""
    row, column = np.indices(height.shape)
    ways = np.stack([np.ones_like(height), column, row, height])
    return column + np.tensordot(shift[0], ways, 1), row + np.tensordot(shift[1], ways, 1)


def test_weights_take_a_cubic_through_four_samples() -> None:
    part = np.linspace(0, 1, 11)
    for power in range(4):
        samples = np.array([-1.0, 0, 1, 2]) ** power
        np.testing.assert_allclose(samples @ weights(part), part**power, atol=1e-14)
    np.testing.assert_array_equal(weights(np.array(0.0)), [0, 1, 0, 0])


def test_the_reference_finds_a_cubic_surface_where_it_has_moved_to() -> None:
    shape = 12, 14
    row, column = np.indices(shape)
    height = np.random.default_rng(0).uniform(-1, 0, shape).astype(np.float32)
    found = numpy_frame(polynomial(column, row).astype(np.float32), height, SHIFT, *ALIKE).registered
    x, y = moved(SHIFT.astype(float), height.astype(float))
    inside = (x >= 1) & (x < 12) & (y >= 1) & (y < 10)
    assert inside.sum() > 60
    np.testing.assert_allclose(found[inside], polynomial(x, y)[inside], rtol=1e-5, atol=1e-3)
    assert np.isnan(found[~inside]).all()


def test_a_shift_of_whole_pixels_moves_samples_and_noise_as_they_are() -> None:
    frame = np.random.default_rng(1).normal(100, 30, (8, 9)).astype(np.float32)
    shift = np.array([[2, 0, 0, 0], [-1, 0, 0, 0]], np.float32)
    found = numpy_frame(frame, np.zeros((8, 9), np.float32), shift, *ALIKE)
    expected = np.full((8, 9), np.nan, np.float32)
    expected[2:7, :5] = frame[1:6, 2:7]
    # Of what is found elsewhere, one of the 16 samples is beyond the edge.
    np.testing.assert_array_equal(found.registered[2:7, :5], expected[2:7, :5])
    np.testing.assert_array_equal(found.noise, np.broadcast_to(np.isfinite(found.registered), (2, 8, 9)))
    assert np.isfinite(found.registered).sum() == 5 * 5


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (5, 6), (33, 1100)])
@pytest.mark.parametrize(("dtype", "each"), [("uint8", False), ("uint16", True), ("float32", False)])
def test_a_device_agrees_with_the_reference(
    device: Device, dtype: str, shape: tuple[int, int], each: bool
) -> None:
    case = random_case(dtype, shape, each)
    found, expected = device_frame(device, **case), numpy_frame(**case)
    assert np.isfinite(expected.registered).any() == (min(shape) > 4)
    for name in Answer._fields:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=2e-5, atol=2e-4)


@pytest.mark.parametrize("far", [1e4, -1e4, 3e9, np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("axis", [0, 1])
def test_what_is_far_outside_the_picture_is_missing(device: Device, far: float, axis: int) -> None:
    shift = np.zeros((2, 4), np.float32)
    shift[axis, 0] = far
    frame, height = np.full((6, 8), 7, np.uint8), np.zeros((6, 8), np.float32)
    with np.errstate(invalid="ignore"):
        answers = [
            numpy_frame(frame, height, shift, *ALIKE),
            device_frame(device, frame, height, shift, *ALIKE),
        ]
    for found in answers:
        assert np.isnan(found.registered).all()
        assert not found.noise.any()


@pytest.mark.parametrize("count", [1, 3, 200])
def test_mended_places_are_the_means_of_those_round_them(device: Device, count: int) -> None:
    rng = np.random.default_rng(count)
    frame = rng.normal(size=(40, 30)).astype(np.float32)
    order = rng.permutation(frame.size)
    places = np.column_stack([order[:count], rng.choice(order[count:], (count, 4))]).astype(np.int32)
    given = {"places": places, "padded": frame}
    arrays = {name: device.given(name, values, values.dtype) for name, values in given.items()}
    kernel = device.kernel("registration", "registration_mend", FRAME="uchar", LEVELS=1, TOP=255)
    launch(kernel, -(-count // device.layout.tile), count, arrays["places"], arrays["padded"])
    wanted = frame.copy()
    registration_mend(places, wanted)
    assert (wanted != frame).sum() == count
    np.testing.assert_allclose(arrays["padded"].download(), wanted, atol=1e-6)
