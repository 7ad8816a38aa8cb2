"""The change-point's NumPy references, applied to a stack in one block."""

from __future__ import annotations

import numpy as np

from mirrorskin.engine.base.frames import reference_pair
from mirrorskin.io import Result
from mirrorskin.kernels.press import changepoint as reference

EVIDENCE = 12


def numpy_change(frames, travel, dark, bright, noise, threshold=0.5, hold=2, event="onset"):
    """Known levels: one pass."""
    shape, dtype = frames.shape[1:], frames.dtype
    low, high = (part.reshape(-1) for part in reference_pair(dark, bright, shape, dtype))
    flat, unusable = frames.reshape(len(frames), -1), np.isnan(low)
    if event == "release":
        low, high, threshold = high, low, 1 - threshold
    gain = (1 / np.where(unusable, 1, high - low)).astype(np.float32)
    low = np.nan_to_num(low).astype(np.float32)
    start = np.where(unusable, reference.INVALID, 0).astype(np.int32)
    excess, below, since = np.zeros((3, low.size), np.int32)
    ring = np.zeros((reference.SLOTS, low.size), dtype)
    level, quiet = round(threshold * reference.UNIT), np.float32(EVIDENCE * noise**2)
    required = hold * (reference.UNIT - level)
    reference.changepoint_scan(flat, 0, level, required, quiet, low, gain, start, excess, below, ring)
    maps = reference.changepoint_heights(
        start,
        excess,
        below,
        since,
        low,
        gain,
        ring,
        np.asarray(travel, float),
        noise,
        quiet,
        threshold,
        False,
    )
    return _onset(maps, start, shape, noise, event)


def numpy_split(frames, travel, noise, threshold=0.5, event="onset"):
    """Unknown levels: two passes."""
    shape, dtype, count = frames.shape[1:], frames.dtype, len(frames)
    sign = -1 if event == "release" else 1
    threshold = 1 - threshold if event == "release" else threshold
    flat = frames.reshape(count, -1)
    total = np.zeros(flat.shape[1])
    reference.changepoint_sum(flat, total)
    mean = total / count
    split = np.arange(1, count)
    weight = np.zeros(count + 1, np.float32)
    weight[1:-1] = sign / np.sqrt(split * (count - split))
    start = np.where(np.isfinite(mean), 0, reference.INVALID).astype(np.int32)
    since, score = np.zeros_like(start), np.zeros(mean.size, np.float32)
    ring = np.zeros((reference.SLOTS, mean.size), dtype)
    reference.changepoint_split(flat, 0, mean, weight, np.zeros_like(mean), start, since, score, ring)
    changed = score.astype(float) ** 2 * count / 2 > (EVIDENCE + np.log(count)) * noise**2
    before = np.where(changed, start, 1)
    rest = np.sqrt((count - before) / before)
    dark = np.where(changed, mean - sign * score * rest, 0).astype(np.float32)
    gain = (sign / np.where(changed, score * (rest + 1 / rest), 1)).astype(np.float32)
    excess = np.where(changed, reference.DECIDED, 0).astype(np.int32)
    quiet, travel = np.float32(EVIDENCE * noise**2), np.asarray(travel, float)
    maps = reference.changepoint_heights(
        start, excess, start, since, dark, gain, ring, travel, noise, quiet, threshold, True
    )
    return _onset(maps, start, shape, noise, event)


def _onset(maps, start, shape, noise, event):
    height, sigma, status = maps
    frame = np.where((status == 1) | (status == 3), start, -1)
    if event == "release":
        status = np.array([0, 1, 3, 2])[status]
    maps = {"height": height, "height_sigma": sigma, "status": status, "frame": frame}
    return Result({name: values.reshape(shape) for name, values in maps.items()}, process={"noise": noise})


def assert_near(actual, expected, travel):
    """Hold a device's answer against the reference's: same states, heights far closer than their sigma."""
    np.testing.assert_array_equal(actual.status, expected.status)
    np.testing.assert_array_equal(actual.frame, expected.frame)
    answered = expected.status == 1
    np.testing.assert_array_equal(np.isnan(actual.height), ~answered)
    np.testing.assert_array_equal(np.isnan(actual.height_sigma), ~answered)
    gap = np.abs(actual.height - expected.height)[answered]
    # The weights of hypotheses have the rounding of the misfit, in square sigmas, of float32.
    assert np.all(gap <= 0.01 * expected.height_sigma[answered] + 1e-6 * np.max(np.abs(travel)))
    sigma, exact_sigma = (result.height_sigma[answered] for result in (actual, expected))
    np.testing.assert_allclose(sigma, exact_sigma, rtol=0.02, atol=1e-7)
