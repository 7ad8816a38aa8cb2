"""Presses without given counts of dark and light, compared with a known surface."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import engine

TRAVEL = np.arange(60) * 0.005
WIDTH = 0.021  # mm of travel in which a pixel turns from dark to light


def press(gains=0.0, offsets=0.0, low=12.0, high=182.0, seed=0):
    """Return frames of a bowl between these counts, and where pixels are half light, (H, W), mm of travel."""
    generator, (y, x) = np.random.default_rng(seed), np.mgrid[-24:24, -32:32]
    half = 0.05 + 0.3 * (x**2 + y**2) / 32**2
    fraction = np.clip((TRAVEL[:, None, None] - half) / WIDTH + 0.5, 0, 1)
    dark = low + offsets * generator.normal(size=half.shape)
    light = (high - low) * (1 + gains * generator.normal(size=half.shape))
    frames = dark + light * fraction + generator.normal(size=fraction.shape)
    return np.clip(np.rint(frames), 0, 255).astype(np.uint8), half


def errors(frames, half, **options):
    """Return the errors of heights, mm, and the result."""
    result = engine.reconstruct(frames, travel=TRAVEL, fill=False, **options)
    return (result.height + half)[result.status == 1], result


@pytest.mark.parametrize(
    ("camera", "levels"),
    [({}, {}), ({"high": 90}, {}), ({}, {"dark": 12}), ({}, {"bright": 182}), ({"low": 40}, {"hold": 1})],
)
def test_heights_are_those_of_the_levels_that_the_frames_have(camera, levels):
    miss, _ = errors(*press(**camera), **levels)
    assert abs(np.mean(miss)) < 0.0001  # by the range of uint8: 0.0038


@pytest.mark.parametrize("spread", [{}, {"gains": 0.05}, {"gains": 0.1, "offsets": 3.0}])
def test_sigma_holds_what_is_not_known_of_the_levels(spread):
    miss, result = errors(*press(**spread))
    z = miss / result.height_sigma[result.status == 1]
    # The light of a frame and the gamma of a camera that nobody characterised are in sigma, but not here.
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.15


def test_of_a_release_the_levels_are_estimated_as_well():
    frames, half = press()
    result = engine.reconstruct(frames[::-1], travel=TRAVEL[::-1], fill=False, event="release")
    miss = (result.height + half)[result.status == 1]
    assert abs(np.mean(miss)) < 0.0001


def test_the_result_lists_what_was_estimated():
    process = errors(*press())[1].process
    assert process["dark"] == "12, estimated from the frames"
    assert process["bright"] == "182, estimated from the frames"


def test_levels_that_are_given_are_used_as_they_are():
    frames, half = press(gains=0.05)
    _, result = errors(frames, half, dark=12, bright=182)
    onset = engine.find_onset(frames, TRAVEL, dark=12, bright=182)
    np.testing.assert_array_equal(result.height, onset.height)
    np.testing.assert_array_equal(result.height_sigma, onset.height_sigma)


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_where_nothing_turns_light_the_range_of_the_type_is_taken_and_reported():
    frames, _ = press(high=14.0)
    result = engine.reconstruct(frames, travel=TRAVEL, fill=False)
    assert result.process["bright"] == "range of the type"
    assert not np.isfinite(result.height).any()


def test_frames_are_scanned_once(device):
    frames, _ = press(gains=0.05)
    device.profile.clear()
    engine.find_onset(frames, TRAVEL, device=device)
    scans = {record.name: record.runs for record in device.profile.records() if "scan" in record.name}
    assert sum(scans.values()) <= -(-frames.nbytes // 64_000_000)
