import math

import numpy as np
import pytest

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.rig.delay import block_means, estimate_delay, frame_times
from mirrorskin.hw.stages.trajectory import Trapezoid

PATH = Trapezoid(1.0, 0.6, 10.0)
THERE, BACK = 0.3, 2.4


def place(time):
    """There and back again."""
    return PATH.place(time - THERE) - PATH.place(time - BACK)


def pictures(where, noise, random, width=0.05):
    """Light that spreads as the body goes down, in 32 places."""
    edge = 0.1 + 0.8 * np.linspace(0, 1, 32)
    light = 200 / (1 + np.exp((edge - where[:, None]) / width))
    return light + noise * random.standard_normal(light.shape)


def watch(seed, delay, jitter=0.005, noise=0.5, rate=60.0):
    random = np.random.default_rng(seed)
    exposed = np.arange(0, BACK + 3, 1 / rate) + random.uniform(0, 1 / rate)
    arrival = exposed + delay + jitter * random.standard_normal(len(exposed))
    return arrival, pictures(place(exposed), noise, random)


@pytest.mark.parametrize(("seed", "rate"), [(0, 30.0), (1, 30.0), (2, 100.0)])
def test_a_delay_of_50_ms_is_found_within_2_ms_although_frames_jitter_by_5(seed, rate):
    actual = estimate_delay(*watch(seed, 0.05, rate=rate), place)
    assert actual.seconds == pytest.approx(0.05, abs=0.002)
    assert actual.error < 0.001


@pytest.mark.parametrize("delay", [0.0, 0.0123, 0.45])
def test_a_steady_delay_is_found_within_a_tenth_of_a_millisecond(delay):
    actual = estimate_delay(*watch(0, delay, jitter=0.0, noise=0.1), place)
    assert actual.seconds == pytest.approx(delay, abs=1e-4)


def test_the_standard_error_is_what_the_estimate_scatters_by():
    actual = [estimate_delay(*watch(seed, 0.05), place) for seed in range(8)]
    scatter = np.std([result.seconds for result in actual])
    stated = np.mean([result.error for result in actual])
    assert 0.5 < scatter / stated < 1.7


def test_frames_that_are_late_in_turn_make_the_delay_as_uncertain():
    number, random = np.arange(300), np.random.default_rng(3)
    even = number / 60
    for wander, lowest, limit in ((0.0, 0.0, 0.0012), (0.008, 0.003, 0.008)):
        late = wander * np.sin(math.tau * even / 2) + 0.003 * random.standard_normal(len(even))
        _, error = frame_times(number, even + late)
        assert lowest <= error < limit


def test_frames_of_a_camera_that_keeps_time_are_on_a_line():
    even = np.arange(300) / 60
    arrival = even + 0.003 * np.random.default_rng(3).standard_normal(len(even))
    times, _ = frame_times(np.arange(300), arrival)
    assert np.abs(times - even).max() < 0.001


def test_lamps_that_warm_up_do_not_matter():
    arrival, pictures = watch(0, 0.05)
    warm = np.linspace(0, 20, len(arrival))[:, None]
    assert estimate_delay(arrival, pictures + warm, place).seconds == pytest.approx(0.05, abs=0.002)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_picture_that_does_not_change_is_refused(noise):
    random = np.random.default_rng(0)
    arrival, _ = watch(0, 0.05)
    with pytest.raises(HardwareError, match=r"press deeper.*delay.*rig file"):
        estimate_delay(arrival, 50 + noise * random.standard_normal((len(arrival), 32)), place, "cam")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(48, 64), (37, 53), (5, 70), (1, 1)])
def test_block_means_are_the_means_of_blocks(dtype, shape):
    frames = np.random.default_rng(2).integers(0, 255, (3, *shape)).astype(dtype)
    means = block_means(frames)
    rows, columns = (min(16, size) for size in shape)
    assert means.shape == (3, rows * columns)
    tall, wide = (np.linspace(0, size, min(16, size) + 1).astype(int) for size in shape)
    for k in range(rows * columns):
        y, x = divmod(k, columns)
        block = frames[:, tall[y] : tall[y + 1], wide[x] : wide[x + 1]].astype(float)
        np.testing.assert_allclose(means[:, k], block.mean(axis=(1, 2)))
