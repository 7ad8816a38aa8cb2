"""Stacks for the onset's tests, and independent searches for the onset."""

from __future__ import annotations

import numpy as np

from mirrorskin.engine.base.frames import reference_maps
from mirrorskin.io import Result
from mirrorskin.kernels.press import onset as reference

SPEC = {"uint8": (20, 220), "uint16": (300, 3500), "float32": (0.1, 0.9)}
LEVELS = {dtype: {"dark": dark, "bright": bright} for dtype, (dark, bright) in SPEC.items()}


def random_press(dtype, frames, shape, seed=0, noise=0.008):
    """Ramps and steps of random height, place and duration, with noise: some pixels never turn light."""
    generator = np.random.default_rng(seed)
    dark, bright = SPEC[dtype]
    start = generator.integers(-2, frames + 2, shape)
    lasts = generator.choice([1e-3, 1, 4, 20], shape)
    plateau = generator.uniform(0.2, 1.1, shape)
    number = np.arange(frames)[:, np.newaxis, np.newaxis]
    light = plateau * np.clip((number - start) / lasts, 0, 1) + generator.normal(0, noise, (frames, *shape))
    counts = dark + (bright - dark) * light
    if dtype == "float32":
        return counts.astype(dtype)
    return np.clip(np.rint(counts), 0, np.iinfo(dtype).max).astype(dtype)


def numpy_onset(
    frames,
    travel,
    dark,
    bright,
    noise,
    threshold=0.5,
    hold=2,
    subframe=True,
    own_dark=False,
    event="onset",
):
    """Run the kernels' NumPy references over a stack, in one block."""
    shape, dtype, release = frames.shape[1:], frames.dtype, event == "release"
    low, high = (
        np.broadcast_to(part, shape).reshape(-1) for part in reference_maps(dark, bright, shape, dtype)
    )
    level, plateau, light = reference.onset_levels(high, low, threshold - 1e-12, dtype, release)
    flat = frames.reshape(len(frames), -1)
    flat = reference.complement(flat) if release else flat
    plateau = flat[0].astype(np.float32) if own_dark else plateau
    sure = reference.onset_sure(level, light, 6 * noise)
    near = reference.onset_near(level, plateau, sure)
    below, last_dark = np.zeros((2, level.size), np.int32)
    onset = np.where(np.isnan(level), reference.INVALID, reference.DARK).astype(np.int32)
    risen, last, before, at, after = (np.zeros(level.size, dtype) for _ in range(5))
    reference.onset_scan(
        flat, 0, hold, light, sure, near, onset, below, last_dark, risen, last, before, at, after
    )
    height, sigma, status = reference.onset_heights(
        onset,
        below,
        last_dark,
        risen,
        before,
        at,
        after,
        level,
        plateau,
        1 - threshold if release else threshold,
        np.asarray(travel, float),
        noise,
        3 * noise * (np.sqrt(2) if own_dark else 1),
        3 * noise * np.sqrt(2),
        subframe,
    )
    if release:
        status = np.array([0, 1, 3, 2], np.uint8)[status]
    maps = {"height": height, "height_sigma": sigma, "status": status}
    maps["frame"] = np.maximum(onset, reference.DARK)
    return Result({name: values.reshape(shape) for name, values in maps.items()}, process={"noise": noise})


def first_run(light, hold):
    """Return the first index of the first run of `hold` trues, or of one that lasts to the end; else -1."""
    for start in range(len(light)):
        run = light[start : start + hold]
        if all(run):
            return start
    return -1


def assert_equal(first, right):
    """Hold two onsets equal to the last bit."""
    for name in ("height", "height_sigma", "status", "frame"):
        np.testing.assert_array_equal(getattr(first, name), getattr(right, name), err_msg=name)


def assert_within_an_ulp(actual, expected, travel):
    """Hold a device's onset against the reference's: same states, heights within one float32 ulp."""
    np.testing.assert_array_equal(actual.status, expected.status)
    np.testing.assert_array_equal(actual.frame, expected.frame)
    answered = expected.status == 1
    np.testing.assert_array_equal(np.isnan(actual.height), ~answered)
    exact = expected.height[answered]
    # A travel and a share of a step, each known to half an ulp, and their sum.
    travel = np.asarray(travel, float)
    ulp = np.spacing(np.abs(exact).astype(np.float32)) + np.spacing(
        np.float32(np.max(np.abs(np.diff(travel))))
    )
    assert np.all(np.abs(actual.height[answered] - exact) <= 2 * ulp)
    sigma, exact_sigma = (result.height_sigma[answered] for result in (actual, expected))
    np.testing.assert_allclose(sigma, exact_sigma, rtol=1e-4, atol=1e-9)
