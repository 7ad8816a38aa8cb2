"""Fringes: decoded phases are right, standard errors equal the scatter, and orders are right or marked."""

import re

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mirrorskin import engine, io
from mirrorskin.engine.optical.fringes import (
    Fringes,
    decode_gray,
    fit_fringes,
    unwrap_frequencies,
    unwrap_gray,
)

TURN = 2 * np.pi
EVEN = np.arange(5) * TURN / 5
UNEVEN = np.array([0.0, 0.4, 1.1, 1.9, 2.6, 4.0])
FIELD = np.tile(np.linspace(0.03, 0.97, 400), (50, 1))  # place along x, of the field's width
RATES = [1, 6, 36]
BITS = 6


def shown(phase, shift, noise=0.0, dtype="float32", seed=1, mean=100.0, modulation=40.0):
    """Frames (N, H, W) of fringes."""
    light = mean + modulation * np.cos(phase - np.reshape(shift, (-1, 1, 1)))
    light += noise * np.random.default_rng(seed).normal(size=light.shape)
    return light.astype(dtype) if dtype == "float32" else np.rint(light).astype(dtype)


def wrap(angle):
    return (angle + np.pi) % TURN - np.pi


def fitted(noise, place=FIELD):
    """Phases and standard deviations of the field seen with fringes of several frequencies."""
    stacks = [shown(TURN * rate * place, EVEN, noise, seed=rate) for rate in RATES]
    return [fit_fringes(stack, EVEN, noise=noise) for stack in stacks]


def phase_maps(phase, sigma):
    """Maps of phases, (F, H, W), that come from elsewhere."""
    return [
        {"phase": phases, "phase_sigma": other}
        for phases, other in zip(*np.broadcast_arrays(phase, sigma), strict=True)
    ]


def coded(noise, contrast=40.0, seed=5):
    """Pictures of the Gray code of stripes half a fringe wide, their borders blurred over a few pixels."""
    place = 2**BITS * FIELD[0, np.newaxis] + np.linspace(-0.2, 0.2, 41)[:, np.newaxis]
    stripe = np.clip(np.floor(place), 0, 2**BITS - 1).astype(int)
    bits = [((stripe ^ stripe >> 1) >> bit & 1).mean(axis=0) for bit in reversed(range(BITS))]
    frames = 100 + contrast * (2 * np.array(bits)[:, np.newaxis] - 1) * np.ones((BITS, *FIELD.shape))
    return frames + noise * np.random.default_rng(seed).normal(size=frames.shape)


@pytest.mark.parametrize("shift", [EVEN, UNEVEN, -UNEVEN[:3]], ids=["even", "uneven", "three"])
def test_phases_without_noise_are_those_encoded(shift):
    fringes = fit_fringes(shown(TURN * 3 * FIELD, shift), shift, noise=1)
    np.testing.assert_allclose(wrap(fringes.phase - TURN * 3 * FIELD), 0, atol=3e-6)


def test_hot_samples_do_not_change_orders():
    generator = np.random.default_rng(4)
    fringes = []
    for rate in RATES:
        stack = shown(TURN * rate * FIELD, EVEN, 1.0, seed=rate)
        stack[generator.uniform(size=stack.shape) < 1e-3] = 255
        fringes.append(fit_fringes(stack, EVEN, noise=1.0))
    unwrapped = unwrap_frequencies(fringes, RATES)
    safe = unwrapped.risk < 0.01
    assert np.mean(safe) > 0.97
    assert np.all(np.abs(unwrapped.phase - TURN * RATES[-1] * FIELD)[safe] < np.pi)


def test_mean_and_modulation_are_those_encoded():
    fringes = fit_fringes(shown(FIELD, UNEVEN), UNEVEN)
    np.testing.assert_allclose(fringes.mean, 100, rtol=1e-5)
    np.testing.assert_allclose(fringes.modulation, 40, rtol=1e-5)


def test_a_frame_of_weight_0_is_left_out_and_weights_are_inverse_variances():
    frames = shown(TURN * FIELD, UNEVEN, 1.5)
    expected = fit_fringes(np.delete(frames, 2, 0), np.delete(UNEVEN, 2))
    run = engine.Run(Fringes)
    run.push(frames, phase=UNEVEN, frame_weights=[1, 1, 0, 1, 1, 1])
    result = run.result()
    np.testing.assert_allclose(result.phase, expected.phase, atol=1e-5)
    np.testing.assert_allclose(result.phase_sigma, expected.phase_sigma, rtol=1e-3)
    twice = engine.Run(Fringes(noise=2))
    twice.push(frames, phase=UNEVEN, frame_weights=np.full(6, 4.0))
    once = fit_fringes(frames, UNEVEN, noise=2)
    np.testing.assert_allclose(twice.result().phase_sigma, once.phase_sigma / 2, rtol=1e-4)


@pytest.mark.parametrize("count", [3, 4, 8])
def test_the_standard_error_of_even_shifts_is_the_cramer_rao_bound(count):
    shift = np.arange(count) * TURN / count
    fringes = fit_fringes(shown(TURN * FIELD, shift), shift, noise=2)
    np.testing.assert_allclose(fringes.phase_sigma, 2 * np.sqrt(2 / count) / 40, rtol=1e-4)


@pytest.mark.parametrize("shift", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_the_standard_error_is_the_scatter_at_every_phase(shift):
    fringes = fit_fringes(shown(TURN * FIELD, shift, 1.5), shift)
    square = (wrap(fringes.phase - TURN * FIELD) / fringes.phase_sigma) ** 2
    for part in np.split(square, 8, axis=1):
        assert part.mean() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("count", [4, 5, 16])
def test_noise_is_estimated_from_the_residual(count):
    shift = np.arange(count) * TURN / count
    frames = shown(FIELD, shift, 1.5)
    frames[:, :, :100] = 10  # no fringes there, and no noise
    assert fit_fringes(frames, shift).process["noise"] == pytest.approx(1.5, rel=0.04)


def test_a_pixel_without_fringes_has_no_phase():
    fringes = fit_fringes(np.full((5, 1, 1), 7, np.uint8), EVEN, noise=1)
    assert np.isnan(fringes.phase).all()
    assert np.isposinf(fringes.phase_sigma).all()


def test_frequencies_unwrap_exactly_without_noise():
    unwrapped = unwrap_frequencies(fitted(0), RATES)
    np.testing.assert_allclose(unwrapped.phase, TURN * 36 * FIELD, atol=3e-6)
    assert (unwrapped.risk <= 1e-3).all()


def test_frequencies_unwrap_the_whole_field_in_noise():
    unwrapped = unwrap_frequencies(fitted(1.0), RATES)  # the coarsest to 0.016 rad
    error = unwrapped.phase - TURN * 36 * FIELD
    assert np.abs(error).max() < np.pi
    assert np.mean((error / unwrapped.phase_sigma) ** 2) == pytest.approx(1, abs=0.05)


def test_the_field_may_have_its_zero_in_the_middle():
    true = np.linspace(-3, 3, 50)[np.newaxis]
    fringes = phase_maps(wrap(np.stack([true, 7 * true])), 0.01)
    unwrapped = unwrap_frequencies(fringes, [1, 7], start=-np.pi)
    np.testing.assert_allclose(unwrapped.phase, 7 * true)


def test_the_risk_is_how_often_the_order_is_wrong():
    place = 0.25 + 0.5 * FIELD  # far from the ends
    unwrapped = unwrap_frequencies(fitted(14.0, place), RATES)
    wrong = np.abs(unwrapped.phase - TURN * 36 * place) > np.pi
    for low, high in [(0.0, 1e-3), (0.01, 0.1), (0.1, 0.3), (0.3, 0.6)]:
        part = (unwrapped.risk >= low) & (unwrapped.risk < high)
        assert part.sum() > 200
        assert wrong[part].mean() == pytest.approx(unwrapped.risk[part].mean(), rel=0.25, abs=1e-3)


def test_the_end_of_the_field_is_at_risk_where_it_may_be_the_other_end():
    unwrapped = unwrap_frequencies(phase_maps(np.full((1, 1, 2), [[0.02, 1.0]]), 0.02), [1])
    assert unwrapped.risk[0].tolist() == pytest.approx([0.1587, 0], abs=1e-4)


def test_the_gray_code_of_every_stripe_is_read():
    stripe = np.arange(2**BITS)[np.newaxis]
    frames = np.stack([(stripe ^ stripe >> 1) >> bit & 1 for bit in reversed(range(BITS))])
    np.testing.assert_array_equal(decode_gray(frames, 0.5, noise=0.05).stripe, stripe)


@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_a_gray_code_unwraps_the_whole_field(noise):
    true = TURN * 2 ** (BITS - 1) * FIELD
    fringes = fit_fringes(shown(true, EVEN, noise), EVEN, noise=noise)
    stripes = decode_gray(coded(noise), fringes.mean, noise=fringes.process["noise"])
    unwrapped = unwrap_gray(fringes, stripes)
    assert np.abs(unwrapped.phase - true).max() < np.pi
    assert (unwrapped.risk <= 1e-3).all()


@pytest.mark.parametrize("width", [0.75 * TURN, TURN])
@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_stripes_up_to_the_width_of_a_fringe_unwrap_the_whole_field(width, noise):
    true = width * 2**BITS * FIELD
    fringes = fit_fringes(shown(true, EVEN, noise), EVEN, noise=noise)
    stripes = decode_gray(coded(noise), fringes.mean, noise=fringes.process["noise"])
    unwrapped = unwrap_gray(fringes, stripes, width=width)
    right = np.abs(unwrapped.phase - true) < np.pi
    assert right[unwrapped.risk <= 1e-3].all()
    assert (unwrapped.risk <= 1e-3).mean() > 0.98


def test_the_risk_of_a_gray_code_is_a_little_more_than_how_often_the_number_is_off():
    code = decode_gray(coded(14.0), 100, noise=14)
    risk, off = code.risk, np.abs(code.stripe - np.floor(2**BITS * FIELD)) > 1
    assert 0.55 * risk.mean() < off.mean() < risk.mean()
    assert off[risk <= 1e-3].mean() < 1e-3


@pytest.mark.parametrize("value", [0, 255])
def test_numbers_that_hot_or_dead_samples_make_wrong_are_not_safe(value):
    frames = coded(2.0).copy()
    frames[np.random.default_rng(4).random(frames.shape) < 0.003] = value
    code = decode_gray(frames, 100, noise=2)
    off = np.abs(code.stripe - np.floor(2**BITS * FIELD)) > 1
    assert off.mean() > 0.003
    assert off[code.risk < 0.01].mean() < 2e-4
    assert (code.risk < 0.01).mean() > 0.97


def test_what_is_missing_is_never_safe():
    gone = np.full((1, 1, 1), np.nan)
    unwrapped = unwrap_frequencies(phase_maps(gone, gone), [1])
    stripes = decode_gray(gone, 1, noise=1)
    grays = unwrap_gray(*phase_maps(gone, gone), stripes)
    assert [result.risk.item() for result in (unwrapped, stripes, grays)] == [1, 1, 1]
    assert np.isnan(unwrapped.phase).all()


def test_fringes_of_a_dataset_and_of_a_file_unwrap_as_the_results_do(tmp_path):
    fringes = fitted(1.0)
    expected = unwrap_frequencies(fringes, RATES)
    path = tmp_path / "fine.h5"
    io.save_result(fringes[2], path)
    unwrapped = unwrap_frequencies([fringes[0], fringes[1].to_xarray(), path], RATES)
    for name in ("phase", "phase_sigma", "order", "risk"):
        np.testing.assert_array_equal(unwrapped[name], expected[name])
    assert unwrapped.declaration("phase").unit == unwrapped.declaration("phase_sigma").unit == "rad"


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.3, 3.0])
@pytest.mark.parametrize("rates", [[1], [0.5], [1, 7.3, 50.1], [1, 30], [1, 1000]], ids=str)
def test_risk_is_not_below_the_share_of_wrong_orders(rates, sigma):
    place, random = np.linspace(0.02, 0.98, 20_000)[np.newaxis], np.random.default_rng(1)
    true = TURN * np.multiply.outer(np.array(rates), place)
    unwrapped = unwrap_frequencies(
        phase_maps(np.mod(true + random.normal(0, sigma, true.shape), TURN), sigma), rates
    )
    wrong, safe = np.abs(unwrapped.phase - true[-1]) > np.pi, unwrapped.risk < 0.01
    assert wrong.mean() < 1.05 * unwrapped.risk.mean() + 0.002
    assert np.count_nonzero(wrong & safe) <= 0.01 * np.count_nonzero(safe)


ONE = {"phase": np.ones((1, 1)), "phase_sigma": np.ones((1, 1))}
STRIPES = {"stripe": np.ones((1, 1)), "risk": np.ones((1, 1))}


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: fit_fringes(shown(FIELD, EVEN[:3]), EVEN[:3]), "no residual"),
        (lambda: fit_fringes(shown(FIELD, EVEN[:2]), EVEN[:2]), "Fringes needs at least 3 frames"),
        (lambda: fit_fringes(shown(FIELD, EVEN), EVEN, noise=-1), "noise -1: a number in counts"),
        (lambda: fit_fringes(shown(FIELD, EVEN), EVEN, noise=-FIELD), "noise is below 0"),
        (lambda: fit_fringes(shown(FIELD, EVEN), EVEN, noise=[1, 2]), "noise has shape (2,)"),
        (lambda: unwrap_frequencies([ONE], [1, 2]), "frequency has shape (2,)"),
        (lambda: unwrap_frequencies([ONE, ONE], [2, 1]), "coarse to fine"),
        (lambda: unwrap_frequencies([ONE, ONE], [1, 1]), "coarse to fine"),
        (lambda: unwrap_frequencies([ONE, ONE], [0, 1]), "coarse to fine"),
        (lambda: unwrap_frequencies([ONE, ONE], [np.nan, 1]), "coarse to fine"),
        (
            lambda: unwrap_frequencies([ONE, ONE], [16, 64]),
            "16 fringes over the field, so the absolute phase is not determined. Add a pattern of one fringe",
        ),
        (lambda: unwrap_frequencies([ONE], [2]), "the coarsest pattern has 2 fringes over the field"),
        (lambda: unwrap_frequencies(ONE, [1]), "fringes are a dict: a list of results"),
        (lambda: unwrap_frequencies([ONE["phase"]], [1]), "fringes[0] has no phase_sigma"),
        (lambda: unwrap_frequencies([ONE | {"phase": FIELD}], [1]), "give maps of one size"),
        (lambda: decode_gray(ONE["phase"], 1, noise=1), "frames have shape (1, 1)"),
        (lambda: decode_gray(ONE["phase"][None], [1, 2], noise=1), "threshold has shape (2,)"),
        (lambda: unwrap_gray(ONE, ONE), "stripes has no stripe and no risk"),
        (lambda: unwrap_gray(ONE, {"stripe": FIELD, "risk": FIELD}), "stripes have shape (50, 400)"),
        (lambda: unwrap_gray(ONE, STRIPES, width=1.1 * TURN), "at most a fringe"),
        (lambda: unwrap_gray(ONE, STRIPES, width=TURN), "stripes has no border and no border_risk"),
    ],
)
def test_bad_input_is_one_line(call, line):
    with pytest.raises(io.InputError, match=re.escape(line)):
        call()


def test_a_lens_that_blurs_curved_fringes_is_part_of_the_error():
    x, y = np.meshgrid(np.arange(80) * 2 * np.pi / 16, np.arange(60) * 2 * np.pi / 42)
    phase = x + 1.2 * np.sin(y)
    light = 100 + 80 * np.cos(phase - np.arange(8)[:, np.newaxis, np.newaxis] * TURN / 8)
    blurred = np.stack([gaussian_filter(frame, 1.5, mode="nearest") for frame in light])
    blurred += np.random.default_rng(2).normal(size=blurred.shape)
    result = fit_fringes(blurred.astype(np.float32), np.arange(8) * TURN / 8)
    ratio = (wrap(result.phase - phase) / result.phase_sigma)[5:-5, 5:-5]
    assert 0.3 < np.mean(ratio**2) < 2  # 7 without
