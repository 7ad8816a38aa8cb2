"""Normals and correlation of the sliding window depend only on its frames."""

import numpy as np
import pytest
from live_frames import blocks, phases, turn_frames

from mirrorskin.engine import Correlate, Normals, Run, correlate, estimate_normals
from mirrorskin.evaluation.scenes.inputs import SCALES, TILT
from mirrorskin.io import InputError

SHAPE, WINDOW = (21, 13, 29), 8
PHASE = phases(SHAPE[0])
MAPS = "normals", "normals_sigma", "contact", "mean", "cosine", "sine", "residual"


def make(dtype="uint8", device=None, **other):
    offset, gain, _ = SCALES[dtype]
    options = {"window_frames": WINDOW, "tilt": TILT, "zenith_gain": gain, "zenith_offset": offset, **other}
    return Run(Normals(device=device, **options))


def push(run, frames, cuts, phase=PHASE):
    for block in blocks(frames, cuts, phase=phase):
        run.push(block.frames, phase=block.phase)


def same(first, other, maps=MAPS):
    for name in maps:
        np.testing.assert_array_equal(getattr(first, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_normals_are_bit_by_bit_those_of_the_windows_frames(device, dtype):
    frames, (offset, gain, noise) = turn_frames(SHAPE, dtype), SCALES[dtype]
    run = make(dtype, device, noise=noise)
    push(run, frames, [5, 1, 1, 9, 5])
    last = slice(-WINDOW, None)
    exact = estimate_normals(
        frames[last],
        PHASE[last],
        tilt=TILT,
        zenith_gain=gain,
        zenith_offset=offset,
        noise=noise,
        device=device,
    )
    assert np.mean(exact.contact) > 0.3
    same(run.result(), exact)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_noise_and_tilt_are_those_of_the_first_full_window(dtype):
    frames, (offset, gain, _) = turn_frames(SHAPE, dtype), SCALES[dtype]
    run = make(dtype, tilt="estimate")
    push(run, frames, [21])
    first = slice(WINDOW)
    exact = estimate_normals(
        frames[first], PHASE[first], tilt="estimate", zenith_gain=gain, zenith_offset=offset
    )
    normals = run.result()
    assert normals.process["tilt"] == exact.process["tilt"]
    assert normals.process["shot_noise"] == exact.process["shot_noise"]
    assert normals.process["noise"] == pytest.approx(
        exact.process["noise"], rel=0.1
    )  # it is told at the brightness of each


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_the_correlation_is_that_of_correlate(device, dtype):
    frames = turn_frames(SHAPE, dtype)
    run = make(dtype, device, noise=1.0)
    correlate_window = Run(Correlate(window_frames=WINDOW, device=device))
    for operation in (run, correlate_window):
        push(operation, frames, [4, 12, 5])
    run.result()  # which has maps of its own
    same(run.operation.window.correlation(), correlate_window.result(), MAPS[3:])
    if dtype != "float32":
        exact = correlate(frames[-WINDOW:], PHASE[-WINDOW:], device=device)
        np.testing.assert_allclose(
            run.operation.window.correlation().cosine, exact.cosine, rtol=1e-4, atol=1e-2
        )


def test_normals_with_ends_and_a_scale_of_each_pixel_go_round_the_ring_too():
    frames, (offset, gain, noise) = turn_frames(SHAPE), SCALES["uint8"]
    gains = gain * np.linspace(0.9, 1.1, SHAPE[2]) * np.ones(SHAPE[1:])
    options = {"noise": noise, "dark": offset + 4, "bright": offset + 150}
    run = make(zenith_gain=gains, **options)
    push(run, frames, [11, 10])
    last = slice(-WINDOW, None)
    same(
        run.result(),
        estimate_normals(
            frames[last], PHASE[last], tilt=TILT, zenith_gain=gains, zenith_offset=offset, **options
        ),
    )


def test_a_window_that_is_not_full_has_no_normals():
    run = make(noise=1.0)
    push(run, turn_frames(SHAPE)[:5], [5])
    assert not run.operation.window.is_full
    with pytest.raises(InputError, match="not full"):
        run.result()


def test_phases_that_contain_no_information_are_refused():
    run = make(noise=1.0)
    push(run, turn_frames(SHAPE), [21], np.zeros(21))
    with pytest.raises(InputError, match="8 frames at 1 phase do not determine"):
        run.result()
