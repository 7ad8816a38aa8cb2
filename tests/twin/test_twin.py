"""The twin as a source: its frames, and that they are the same for any way of reading."""

from __future__ import annotations

from typing import Any

import geometry
import numpy as np
import pytest
from numpy.typing import NDArray

from mirrorskin.io import InputError, Source
from mirrorskin.twin import OBJECT_NAMES, Camera, HeightMap, Twin, Vertical

SHAPE = (61, 84)
PIXEL = 0.13
# Not on a regular grid, and no height of an object falls on one of them.
TRAVEL = np.cumsum(np.linspace(0.05, 0.16, 25)) - 0.0137


def make_twin(**changes: Any) -> Twin:
    options: dict[str, Any] = {"object": "sphere", "shape": SHAPE, "pixel_size": PIXEL}
    camera = {name: changes.pop(name) for name in ("dtype", "noise", "seed") if name in changes}
    movement = Vertical(changes.pop("travel", TRAVEL))
    return Twin(movement=movement, camera=Camera(**camera), **(options | changes))


def read_all(source: Source, size: int | None = None) -> NDArray[Any]:
    """Read what is left in blocks of this size, or one frame at a time into the source's own arrays."""
    frames: list[NDArray[Any]] = []
    while True:
        buffer = None if size is None else np.empty((size, *source.shape[1:]), source.dtype)
        block = source.read(buffer)
        if block is None:
            return np.concatenate(frames)
        frames.append(block.frames.copy())


@pytest.mark.parametrize(("name", "dtype"), [*zip(geometry.SURFACES, geometry.LEVELS, strict=False)])
def test_frames_without_noise_are_dark_until_contact_and_then_show_the_slope(name: str, dtype: str) -> None:
    surface = geometry.SURFACES[name](SHAPE, PIXEL)
    dark, bright = geometry.LEVELS[dtype]
    contact = geometry.first_contact(surface.height, TRAVEL)
    touched = np.arange(len(TRAVEL))[:, None, None] >= contact
    expected = np.where(touched, geometry.light_level(surface.zenith, dark, bright), dark)

    frames = read_all(make_twin(object=name, dtype=dtype, noise=0))

    assert frames.dtype == dtype
    assert touched.any(axis=0).mean() > 0.3  # the test sees contact
    assert (~touched[-1]).any()  # and places without
    rounding = 0 if dtype == "float32" else 0.5
    np.testing.assert_allclose(frames, expected, rtol=1e-6, atol=rounding + 1e-6)


def test_state_of_each_frame_is_that_of_the_paper() -> None:
    surface = geometry.sphere(SHAPE, PIXEL)
    frames = read_all(make_twin(noise=0))
    light = frames >= 120
    first = np.where(light.any(axis=0), light.argmax(axis=0), len(TRAVEL))
    np.testing.assert_array_equal(first, geometry.first_light(surface, TRAVEL))
    assert np.isin(np.unique(np.diff(light.astype(int), axis=0)), (0, 1)).all()  # once light, light
    middle = light[:, SHAPE[0] // 2, SHAPE[1] // 2]
    assert not middle.any()  # the crater of Fig. 5


def test_contact_is_made_in_the_very_frame_that_reaches_the_height() -> None:
    height = float(make_twin(object="plane").truth.height.astype(np.float64)[30, 42])
    twin = make_twin(object="plane", travel=[-height - 1e-5, -height + 1e-5], noise=0)
    frames = read_all(twin)
    assert frames[0, 30, 42] == 16
    assert frames[1, 30, 42] == 224


def test_a_sheet_that_just_reaches_the_height_touches_and_may_wait_there() -> None:
    heights = np.outer(np.ones(5), [0.0, -0.5, -1.0])  # 27 degrees steep
    step = HeightMap(heights, (1.0, 1.0))
    travel = [0.25, 0.5, 0.5, 0.75]
    frames = read_all(make_twin(object=step, shape=(5, 3), pixel_size=1.0, travel=travel, noise=0))
    np.testing.assert_array_equal(frames[:, 2, 1], [16, 224, 224, 224])
    np.testing.assert_array_equal(frames[:, 2, 2], 16)


@pytest.mark.parametrize("name", geometry.SURFACES)
def test_truth_is_the_geometry(name: str) -> None:
    surface = geometry.SURFACES[name](SHAPE, PIXEL)
    truth = make_twin(object=name).truth
    for actual, expected in zip((truth.height, truth.zenith, truth.azimuth), surface, strict=True):
        assert actual.dtype == np.float32
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-6)
    assert truth.contact.dtype == np.uint8
    np.testing.assert_array_equal(truth.contact, -surface.height <= TRAVEL[-1])


@pytest.mark.parametrize("name", OBJECT_NAMES)
def test_every_object_touches_first_at_travel_zero_and_lights_up(name: str) -> None:
    twin = make_twin(object=name, shape=(200, 200), pixel_size=0.12, noise=0)
    assert -0.07 < np.nanmax(twin.truth.height) <= 0  # the highest pixel centre may miss the apex
    assert np.isfinite(twin.truth.height).mean() > 0.1
    assert (read_all(twin)[-1] > 200).any()


@pytest.mark.parametrize(("dtype", "size"), [("uint8", None), ("uint16", 7), ("float32", 100)])
def test_the_same_seed_gives_the_same_frames_however_they_are_cut(dtype: str, size: int | None) -> None:
    whole = read_all(make_twin(dtype=dtype, seed=5), len(TRAVEL))
    twin = make_twin(dtype=dtype, seed=5)
    np.testing.assert_array_equal(read_all(twin, size), whole)
    assert twin.read() is None
    assert twin.rewindable
    twin.rewind()
    np.testing.assert_array_equal(read_all(twin, size), whole)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"travel": [0.1, np.nan, 0.4]}, "travel.*frame 1"),
        ({"travel": [[0.1, 0.2], [0.3, 0.4]]}, "travel"),
        ({"travel": []}, "travel"),
        ({"travel": 1.0}, "travel"),
        ({"pixel_size": 0}, "pixel size"),
        ({"pixel_size": (0.1, 0.0)}, "pixel size"),
        ({"pixel_size": (0.1, 0.1, 0.1)}, "pixel size"),
        ({"shape": (0, 10)}, "shape"),
        ({"shape": (10,)}, "shape"),
        ({"noise": -1.0}, "noise"),
        ({"noise": np.nan}, "noise"),
        ({"seed": -1}, "seed"),
        ({"dtype": "int16"}, "int16.*uint8, uint16, float32"),
        ({"dtype": "counts"}, "counts"),
        ({"object": "teapot"}, "teapot.*sphere, coin, plane, cone"),
        ({"object": "missing.png"}, "missing.png"),
    ],
)
def test_bad_input_is_refused_in_one_line(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_twin(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "buffer",
    [
        np.empty((0, *SHAPE), np.uint8),
        np.empty((2, *SHAPE), np.uint16),
        np.empty((2, 3, 4), np.uint8),
        np.empty(SHAPE, np.uint8),
    ],
)
def test_a_buffer_that_does_not_fit_is_refused_and_costs_no_frame(buffer: NDArray[Any]) -> None:
    twin = make_twin()
    with pytest.raises(InputError, match="buffer"):
        twin.read(buffer)
    block = twin.read()
    assert block is not None
    assert block.index == 0


def test_a_release_is_the_press_backwards() -> None:
    for name in geometry.SURFACES:
        down, up = make_twin(object=name, noise=0), make_twin(object=name, noise=0, travel=TRAVEL[::-1])
        np.testing.assert_array_equal(read_all(up), read_all(down)[::-1])
        for part in ("height", "zenith", "azimuth", "contact"):
            np.testing.assert_array_equal(getattr(up.truth, part), getattr(down.truth, part))


def test_a_press_and_its_release_are_one_after_the_other() -> None:
    stroke = np.concatenate([TRAVEL, TRAVEL[-2::-1]])
    both, press = make_twin(travel=stroke, noise=0), make_twin(noise=0)
    frames = read_all(press)
    np.testing.assert_array_equal(read_all(both), np.concatenate([frames, frames[-2::-1]]))
    np.testing.assert_array_equal(both.truth.contact, press.truth.contact)
    np.testing.assert_array_equal(both.travel, stroke)
