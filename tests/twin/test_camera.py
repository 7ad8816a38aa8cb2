"""The twin's camera: its levels, its noise compared with closed forms, and that both are reproducible."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.twin import exposure
from mirrorskin.twin.camera import Camera, Sensor

SHAPE = (96, 128)
KINDS = [("uint8", 8), ("uint16", 10), ("uint16", 12), ("uint16", 16)]


def make_camera(dtype: str = "float32", **values: Any) -> Camera:
    return Camera(np.dtype(dtype), **values)


def lit(light: float, shape: tuple[int, int] = SHAPE) -> NDArray[np.float32]:
    return np.full(shape, light, np.float32)


def shoot(sensor: Sensor, light: NDArray[np.float32], frames: list[int] | range) -> NDArray[Any]:
    out = np.empty((len(frames), *light.shape), sensor.dtype)
    for place, frame in zip(out, frames, strict=True):
        sensor.expose(light, frame, place)
    return out


@pytest.mark.parametrize(
    ("dtype", "bits", "levels"),
    [
        ("uint8", None, (8, 16, 224, 255)),
        ("uint16", None, (12, 256, 3584, 4095)),
        ("uint16", 10, (10, 64, 896, 1023)),
        ("uint16", 16, (16, 4096, 57344, 65535)),
        ("float32", None, (None, 16, 224, math.inf)),
    ],
)
def test_levels_grow_with_the_bits(dtype: str, bits: int | None, levels: tuple[float, ...]) -> None:
    camera = make_camera(dtype, bits=bits)
    assert (camera.bits, camera.dark, camera.bright, camera.top) == levels


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"dtype": "int8"}, "frames cannot be int8"),
        ({"dtype": "uint8", "bits": 12}, "frames of uint8 cannot have 12 bits: take 8"),
        ({"dtype": "uint16", "bits": 8}, "frames of uint16 cannot have 8 bits: take 10, 12, 16"),
        ({"bits": 8}, "frames of float32 cannot have 8 bits: leave them out"),
        ({"noise": -0.1}, "noise -0.1"),
        ({"noise": math.nan}, "noise nan"),
        ({"seed": -1}, "seed -1"),
        ({"seed": 2**64}, "seed 18446744073709551616"),
        ({"electrons": 0}, "electrons 0"),
        ({"gain_deviation": -0.1}, "gain deviation -0.1"),
        ({"gain_deviation": 1}, "gain deviation 1"),
        ({"offset_deviation": -1}, "offset deviation -1"),
        ({"frame_rate": 0}, "frame rate 0"),
        ({"exposure": -0.001}, "exposure -0.001"),
        ({"frame_rate": 50, "exposure": 0.021}, r"exposure 0\.021 .*0 to a frame's 0\.02"),
        ({"point_spread": -1}, "point spread -1"),
        ({"distance": 0}, "distance 0"),
    ],
)
def test_impossible_input_is_refused_in_one_line(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        make_camera(**values)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("dtype", "bits"), [*KINDS, ("float32", None)])
def test_light_without_noise_gives_the_pixels_exact_counts(
    device: Device, dtype: str, bits: int | None
) -> None:
    camera = make_camera(dtype, bits=bits, noise=0, gain_deviation=0.05, offset_deviation=2)
    shape = (13, 22)
    sensor = Sensor(camera, shape, device)
    rounded = np.rint if dtype != "float32" else np.asarray
    dark, full = shoot(sensor, lit(0, shape), [0])[0], shoot(sensor, lit(1, shape), [0])[0]
    np.testing.assert_array_equal(dark, rounded(sensor.offset))
    np.testing.assert_array_equal(full, np.minimum(rounded(sensor.full), camera.top))
    light = np.random.default_rng(0).random(shape, np.float32)
    exact = sensor.offset + (sensor.full.astype(np.float64) - sensor.offset) * light
    slack = 1e-6 * camera.bright + (0.5 if dtype != "float32" else 0)
    np.testing.assert_allclose(
        shoot(sensor, light, [7])[0], np.minimum(exact, camera.top), rtol=0, atol=slack
    )
    assert len(np.unique(dark)) > 5


@pytest.mark.parametrize(
    ("dtype", "shape"),
    [
        ("uint8", (1, 1)),
        ("uint16", (7, 13)),
        ("float32", (1, 1027)),
        ("uint8", (1027, 1)),
        ("float32", (1, 2)),
    ],
)
def test_odd_sizes_agree_with_the_reference(device: Device, dtype: str, shape: tuple[int, int]) -> None:
    camera = make_camera(dtype, noise=3, seed=5, electrons=2.0, gain_deviation=0.02, offset_deviation=1)
    sensor = Sensor(camera, shape, device)
    light = np.random.default_rng(1).random(shape, np.float32)
    pixels, buffer = light.size, -(-light.size // 4) * 4
    maps = [np.zeros(buffer, np.float32) for _ in range(3)]
    for place, values in zip(maps, (light, sensor.offset, sensor.full - sensor.offset), strict=True):
        place[:pixels] = values.ravel()
    expected = np.empty(buffer, dtype)
    exposure.expose(*maps, frame=4, seed=5, read=3, grain=0.5, top=camera.top, counts=expected)
    actual = shoot(sensor, light, [4])[0].astype(np.float64)
    difference = np.abs(actual - expected[:pixels].reshape(shape))
    assert difference.max() < 0.01 or (dtype != "float32" and difference.sum() <= 1)


@pytest.mark.parametrize(("dtype", "light"), [("uint8", 0.5), ("uint16", 0.0), ("float32", 0.5)])
def test_read_noise_has_the_given_deviation(dtype: str, light: float) -> None:
    camera = make_camera(dtype, noise=2.5)
    counts = shoot(Sensor(camera, SHAPE), lit(light), range(20)).astype(np.float64)
    level = camera.dark + (camera.bright - camera.dark) * light
    variance = 2.5**2 + (1 / 12 if dtype != "float32" else 0)
    assert counts.mean() == pytest.approx(level, abs=4 * np.sqrt(variance / counts.size))
    assert counts.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / counts.size))


def test_read_noise_is_gaussian() -> None:
    counts = shoot(Sensor(make_camera(noise=3, seed=2), SHAPE), lit(0.25), range(20))
    score = (counts.ravel() - 68.0) / 3
    assert stats.kstest(score, "norm").pvalue > 0.01
    assert np.abs(score).max() > 4


@pytest.mark.parametrize(
    ("dtype", "bits", "electrons"),
    [("uint8", 8, 30.0), ("uint16", 12, 2.0), ("uint16", 16, 0.2), ("float32", None, 5.0)],
)
def test_the_photon_transfer_curve_has_the_slope_of_a_count_and_the_height_of_the_read_noise(
    dtype: str, bits: int | None, electrons: float
) -> None:
    camera = make_camera(dtype, bits=bits, noise=2.0, electrons=electrons)
    sensor = Sensor(camera, SHAPE)
    frames = 20
    lights = np.linspace(0, 1, 9)
    stacks = [
        shoot(sensor, lit(light), range(i * frames, (i + 1) * frames)) for i, light in enumerate(lights)
    ]
    signal = (camera.bright - camera.dark) * lights
    mean = np.array([stack.mean(dtype=np.float64) for stack in stacks]) - camera.dark
    variance = np.array([stack.var(dtype=np.float64) for stack in stacks])
    expected = 2.0**2 + (1 / 12 if dtype != "float32" else 0) + signal / electrons
    assert np.abs((mean - signal) / np.sqrt(expected / stacks[0].size)).max() < 4
    error = expected * np.sqrt(2 / stacks[0].size)
    assert np.abs((variance - expected) / error).max() < 4
    slope, height = np.polyfit(mean, variance, 1, w=1 / error)
    assert slope == pytest.approx(1 / electrons, rel=0.02)
    assert height == pytest.approx(expected[0], rel=0.02)


def test_noise_of_a_pixel_depends_on_no_other_pixel_frame_or_seed() -> None:
    def noise(frame: int, seed: int = 0) -> NDArray[np.float64]:
        counts = shoot(Sensor(make_camera(noise=1, seed=seed), (384, 512)), lit(0, (384, 512)), [frame])[0]
        return counts.astype(np.float64) - 16

    first = noise(0)
    pairs = [(first[:, 1:], first[:, :-1]), (first[1:], first[:-1]), (first[1:, 1:], first[:-1, :-1])]
    pairs += [(first, noise(1)), (first, noise(-1)), (first, noise(2**40)), (first, noise(0, seed=1))]
    pairs += [(first, noise(0, seed=2**63)), (noise(1), noise(0, seed=1))]
    for left_picture, right in pairs:
        for power in (1, 2):
            correlation = np.corrcoef(left_picture.ravel() ** power, right.ravel() ** power)[0, 1]
            assert abs(correlation) < 4 / np.sqrt(left_picture.size)


@pytest.mark.parametrize(("dtype", "bits"), KINDS)
def test_counts_stop_at_both_ends_and_do_not_wrap(dtype: str, bits: int) -> None:
    scale = 2.0 ** (bits - 8)
    camera = make_camera(dtype, bits=bits, noise=20 * scale)
    # The same noise, eight bits wide, in a camera that keeps all of it.
    sensor, free = Sensor(camera, SHAPE), Sensor(make_camera(noise=20), SHAPE)
    for light, end, level in ((0, 0, camera.dark), (1, camera.top, camera.bright)):
        counts = shoot(sensor, lit(light), range(5))
        kept = shoot(free, lit(light), range(5)).astype(np.float64) * scale
        expected = np.clip(kept, 0, camera.top)
        np.testing.assert_allclose(counts, expected, rtol=0, atol=0.5 + 1e-6 * camera.top)
        fraction = stats.norm.sf((abs(level - end) - 0.5) / camera.noise)
        assert (counts == end).mean() == pytest.approx(fraction, abs=4 * np.sqrt(fraction / counts.size))


def test_pixels_deviate_as_much_as_stated() -> None:
    shape = (300, 400)
    sensor = Sensor(make_camera("uint16", gain_deviation=0.02, offset_deviation=5, seed=1), shape)
    gain = (sensor.full - sensor.offset) / 3328
    error = 4 / np.sqrt(2 * gain.size)
    assert gain.std() == pytest.approx(0.02, rel=error)
    assert sensor.offset.std() == pytest.approx(5, rel=error)
    assert gain.mean() == pytest.approx(1, abs=0.02 * 2 * error)
    assert sensor.offset.mean() == pytest.approx(256, abs=5 * 2 * error)
    assert abs(np.corrcoef(gain.ravel(), sensor.offset.ravel())[0, 1]) < 2 * error
    counts = shoot(sensor, lit(0, shape), [0])[0]
    assert abs(np.corrcoef(counts.ravel() - sensor.offset.ravel(), sensor.offset.ravel())[0, 1]) < 2 * error


def test_the_seed_decides_the_pixels_and_one_deviation_does_not_change_the_other() -> None:
    def maps(**values: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        sensor = Sensor(make_camera(**values), SHAPE)
        return sensor.offset, sensor.full

    both = maps(gain_deviation=0.1, offset_deviation=2)
    for left_map, right in zip(both, maps(gain_deviation=0.1, offset_deviation=2), strict=True):
        np.testing.assert_array_equal(left_map, right)
    np.testing.assert_array_equal(both[0], maps(offset_deviation=2)[0])
    np.testing.assert_allclose(both[1] - both[0], maps(gain_deviation=0.1)[1] - 16, rtol=1e-5)
    assert (both[0] != maps(offset_deviation=2, seed=1)[0]).all()


def test_no_pixel_is_blind() -> None:
    sensor = Sensor(make_camera(gain_deviation=0.9), SHAPE)
    gain = (sensor.full - sensor.offset) / 208
    assert gain.min() == pytest.approx(0.05, rel=1e-5)
    assert (gain < 0.051).mean() == pytest.approx(stats.norm.sf(0.95 / 0.9), abs=0.02)
