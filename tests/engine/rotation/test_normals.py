"""Normals of turns pushed block by block: equal for any division; and refusals."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.engine import Normals, estimate_normals
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT, Setup
from mirrorskin.io import Header, InputError

EXACT = Header("axial", **rotations.EXACT)
SETUP = Setup(gain=60.0, noise=20.0, offset=150.0, dtype="uint16")
SHAPE = (5, 7)
MAPS = ("normals", "normals_sigma", "contact", "mean", "cosine", "sine", "residual")


def facing(shape=SHAPE, zenith=(0, 55)):
    return rotations.random_normals(shape[0] * shape[1], 2, bins=[zenith]).reshape(*shape, 3)


def phases(setup, turns):
    """Phases that go on and on."""
    return np.concatenate([np.array(setup.phase) + 2 * np.pi * turn for turn in range(turns)])


def frames_of(setup=SETUP, turns=1, shape=SHAPE, seed=3):
    return rotations.expose(facing(shape), replace(setup, phase=tuple(phases(setup, turns))), seed)


def options_of(setup=SETUP, **options):
    """What the lab has measured."""
    return {
        "tilt": setup.tilt,
        "zenith_gain": setup.slope,
        "zenith_offset": setup.offset,
        "noise": setup.spread,
        "blur": 0.0,  # neighbours are no neighbours
        "header": EXACT,
        **options,
    }


def run_of(device, setup=SETUP, **options):
    return engine.Run(Normals(device=device, **options_of(setup, **options)))


def push(run, frames, phase, cuts=(), weights=None):
    """Push frames in blocks that are cut as told."""
    for start, stop in pairwise([0, *cuts, len(frames)]):
        part = None if weights is None else weights[start:stop]
        run.push(frames[start:stop], phase=phase[start:stop], frame_weights=part)
    return run


def same(first, other):
    for name in ("noise", "shot_noise", "tilt", "turns", "frames"):
        assert first.process[name] == other.process[name]
    assert [*first] == [*other]
    for name in first:
        np.testing.assert_array_equal(first[name], other[name], err_msg=name)


def close(first, other, fraction=0.02):
    """Hold normals against others, but for what rounding makes of them."""
    away = rotations.between(first.normals.astype(float), other.normals.astype(float))
    assert np.all(away < fraction * other.normals_sigma), np.max(away / other.normals_sigma)
    np.testing.assert_allclose(first.normals_sigma, other.normals_sigma, rtol=fraction)
    np.testing.assert_array_equal(first.contact, other.contact)


@pytest.mark.parametrize("kept", [[0, 4], []])
def test_blocks_make_no_difference_where_the_first_turn_determines_nothing(device, kept):
    frames, phase, weights = frames_of(turns=3), phases(SETUP, 3), np.ones(24)
    weights[:8] = 0
    weights[kept] = 1
    whole = push(run_of(device, noise=None), frames, phase, weights=weights).result()
    assert (whole.process["turns"], whole.process["frames"]) == (2, 16)
    single = push(run_of(device, noise=None), frames, phase, range(1, 24), weights)
    same(single.result(), whole)


def test_turns_are_averaged_by_inverse_variance_or_given_alone(device):
    frames, phase = frames_of(turns=2), phases(SETUP, 2)
    frames[8, 2, 3:5] = 65_535  # which leaves less to the second turn
    both = estimate_normals(frames, phase, **options_of(), device=device)
    each = push(run_of(device, per_turn=True), frames, phase).result()
    assert each.zenith.shape == each.azimuth.shape == each.modulation.shape == (2, *SHAPE)
    for turn in range(2):
        part = slice(8 * turn, 8 * turn + 8)
        alone = estimate_normals(frames[part], EIGHTHS, **options_of(), device=device)
        for name in MAPS:
            np.testing.assert_array_equal(getattr(each, name)[turn], getattr(alone, name))
    weight = np.nan_to_num(each.normals_sigma[..., np.newaxis].astype(float) ** -2)  # 0 without an answer
    mean = np.sum(weight * np.nan_to_num(each.normals), axis=0)
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    np.testing.assert_allclose(both.normals, mean, atol=1e-6)
    np.testing.assert_allclose(both.normals_sigma, np.sum(weight[..., 0], axis=0) ** -0.5, rtol=1e-5)
    np.testing.assert_array_equal(both.contact, each.contact.min(axis=0))
    np.testing.assert_allclose(both.cosine, each.cosine.mean(axis=0), rtol=1e-5, atol=1e-2)
    np.testing.assert_allclose(both.residual, np.sqrt(np.mean(each.residual**2, axis=0)), rtol=1e-5)


def test_phases_may_be_given_modulo_a_turn_and_go_backwards(device):
    frames, phase = frames_of(turns=2), phases(SETUP, 2)
    result = estimate_normals(frames, phase, **options_of(), device=device)
    close(estimate_normals(frames, phase % 6.2831853, **options_of(), device=device), result, 1e-3)
    clockwise = np.concatenate([np.arange(8)[::-1], np.arange(8, 16)[::-1]])
    phases_of_two = np.concatenate([phase[:8][::-1], phase[:8][::-1] - 2 * np.pi])
    close(estimate_normals(frames[clockwise], phases_of_two, **options_of(), device=device), result, 1e-3)


def test_an_incomplete_last_turn_counts_if_it_goes_round(device):
    frames, phase = frames_of(turns=3), phases(SETUP, 3)
    result = estimate_normals(frames[:21], phase[:21], **options_of(), device=device)
    assert (result.process["turns"], result.process["frames"]) == (3, 21)
    complete = estimate_normals(frames[:16], phase[:16], **options_of(), device=device)
    assert np.all(result.normals_sigma < complete.normals_sigma)
    for count in (18, 20):
        same(estimate_normals(frames[:count], phase[:count], **options_of(), device=device), complete)


def test_a_frame_of_weight_0_or_of_no_numbers_is_a_missing_one(device):
    frames, weights = frames_of(), np.array([1, 1, 0, 1, 1, 0, 0, 1.0])
    counts, phase = weights > 0, np.array(EIGHTHS)
    without = estimate_normals(frames[counts], phase[counts], **options_of(), device=device)
    frames[2], frames[6] = 65_535, 0
    result = estimate_normals(frames, phase, **options_of(), frame_weights=weights, device=device)
    same(result, without)
    assert result.process["frames"] == 5
    shape, setup = (20, 20), replace(SETUP, dtype="float32")
    frames, weight = frames_of(setup, shape=shape), np.ones((8, 1, 1))
    frames[3], weight[3] = np.nan, 0
    result = estimate_normals(frames, EIGHTHS, **options_of(setup, noise=None), device=device)
    assert result.process["noise"] == pytest.approx(20, rel=0.1)
    best = np.sqrt(rotations.bound(facing(shape), setup, weight))
    assert np.median(result.normals_sigma / best) == pytest.approx(1, abs=0.1)
    error = rotations.between(result.normals.astype(float), facing(shape))
    assert np.mean((error / best) ** 2) == pytest.approx(1, abs=0.3)
    assert np.mean(result.contact) > 0.98
    assert np.isnan(result.mean).all()


def test_a_turn_may_have_64_frames_and_no_more(device):
    setup = replace(SETUP, dtype="uint8", gain=3.6, offset=12.0, noise=1.0)
    setup = replace(setup, phase=tuple(2 * np.pi * np.arange(64) / 64), low=3)
    frames = frames_of(setup, turns=2)
    result = estimate_normals(frames, phases(setup, 2), **options_of(setup), dark=3, device=device)
    assert (result.process["turns"], result.process["frames"]) == (2, 128)
    error = rotations.between(result.normals.astype(float), facing())
    assert np.mean((error / result.normals_sigma) ** 2) < 2
    message = r"a turn of \d+ frames or more: .* take 64 at most; leave some out"
    with pytest.raises(InputError, match=message):
        estimate_normals(frames[:65], 0.01 * np.arange(65), **options_of(setup), dark=3, device=device)
    with pytest.raises(InputError, match="a turn of 9 frames"):
        push(run_of(device, setup, longest=8, dark=3), frames[:9], 0.01 * np.arange(9), range(1, 9))


def test_three_frames_are_enough_where_the_noise_is_known(device):
    phase, frames = np.array(EIGHTHS)[[0, 3, 5]], frames_of()[[0, 3, 5]]
    with pytest.raises(InputError, match="3 frames a turn leave no residual"):
        estimate_normals(frames, phase, **options_of(noise=None), device=device)
    result = estimate_normals(frames, phase, **options_of(), device=device)
    answered = np.isfinite(result.normals_sigma)
    assert answered.mean() > 0.9
    assert np.isnan(result.residual).all()
    error = rotations.between(result.normals.astype(float), facing())
    assert np.median((error / result.normals_sigma)[answered]) < 1.5
    # Of three samples and three unknowns nothing is left that could speak against contact.
    np.testing.assert_array_equal(result.contact, answered)


@pytest.mark.parametrize("method", ["exact", "paper"])
def test_steeper_may_be_darker(device, method):
    frames = frames_of()
    bright = estimate_normals(frames, EIGHTHS, **options_of(), method=method, device=device)
    turned = options_of(zenith_gain=-SETUP.slope, zenith_offset=10_000 - SETUP.offset)
    dark = estimate_normals(10_000 - frames, EIGHTHS, **turned, method=method, device=device)
    close(dark, bright, 1e-3)
    np.testing.assert_allclose(dark.mean, 10_000 - bright.mean, rtol=1e-6)
    np.testing.assert_allclose(dark.residual, bright.residual, rtol=1e-3)


@pytest.mark.parametrize(
    ("dtype", "shape"), [("uint8", (1, 1)), ("uint16", (1, 7)), ("float32", (13, 37)), ("uint8", (13, 37))]
)
def test_pictures_of_any_size_are_answered(device, dtype, shape):
    setup = replace(SETUP, dtype=dtype, gain=3.6, noise=1.0, offset=12.0)
    frames = frames_of(setup, shape=shape)
    result = estimate_normals(frames, EIGHTHS, **options_of(setup, noise=None), device=device)
    assert result.normals.shape == (*shape, 3)
    assert {getattr(result, name).shape for name in MAPS[1:]} == {shape}
    kinds = {getattr(result, name).dtype.name for name in (*MAPS, "zenith", "azimuth", "modulation")}
    assert kinds == {"float32", "uint8"}
    error = rotations.between(result.normals.astype(float), facing(shape))
    assert np.median(error / result.normals_sigma) < (2.5 if result.normals_sigma.size > 1 else 20)
    again = rotations.direction(result.zenith, result.azimuth)
    np.testing.assert_allclose(again, result.normals.astype(float), atol=1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_frames_that_are_all_the_same_show_an_upright_sheet_or_none(device, dtype):
    setup = Setup(gain=4.0, noise=0.2, offset=10.0, dtype=dtype, tilt=np.radians(5))
    levels = np.array(
        [[30, 10, 100]]
    )  # at the tilt's zenith, at 0: there the sheet does not follow, and at 22
    frames = np.broadcast_to(levels, (8, 1, 3)).astype(dtype)
    result = estimate_normals(frames, EIGHTHS, **options_of(setup), device=device)
    np.testing.assert_allclose(result.zenith[0, :2], 0, atol=1e-3)
    assert result.contact.tolist() == [[1, 0, 0]]
    np.testing.assert_allclose(result.mean, levels, rtol=1e-6)
    np.testing.assert_allclose([result.modulation, result.residual], 0, atol=1e-4)
    paper = estimate_normals(frames, EIGHTHS, **options_of(setup), method="paper", device=device)
    assert np.isnan([paper.normals_sigma, paper.azimuth]).all()
    assert not paper.contact.any()


@pytest.mark.parametrize("value", [0, 255, np.nan, np.inf])
def test_frames_without_light_full_of_it_or_of_no_numbers_have_no_answer(device, value):
    frames = np.full((8, 2, 3), value, np.uint8 if np.isfinite(value) else np.float32)
    for noise in (None, 1.0):
        result = estimate_normals(frames, EIGHTHS, **options_of(Setup(), noise=noise), device=device)
        assert np.isnan(result.normals).all()
        assert np.isnan(result.normals_sigma).all()
        assert not result.contact.any()
        assert result.process["noise"] > 0


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_a_sample_far_off_the_others_makes_the_normal_as_uncertain_as_it_is(device, dtype):
    setup = Setup(gain=3.6, noise=1.2, offset=20.0, dtype=dtype, phase=tuple(np.arange(16) * np.pi / 8))
    normals = facing((30, 40), (15, 50))
    frames = rotations.expose(normals, setup, 3)
    frames[5] = 250  # as of a hot pixel
    result = rotations.estimate(frames, setup.phase, device=device, **options_of(setup))
    error = np.linalg.norm(np.cross(result.normals.astype(float), normals), axis=-1)
    assert 0.5 < np.nanmean((error / result.normals_sigma) ** 2) < 2  # 400 by noise alone


def test_the_noise_and_the_tilt_are_estimated_from_the_first_turn(device):
    setup = replace(SETUP, tilt=np.radians(3))
    frames, phase = frames_of(setup, 2, (20, 20)), phases(setup, 2)
    unknown = options_of(setup, tilt="estimate", noise=None)
    result = estimate_normals(frames, phase, **unknown, device=device)
    first = estimate_normals(frames[:8], phase[:8], **unknown, device=device)
    assert (result.process["tilt"], result.process["shot_noise"]) == (
        first.process["tilt"],
        first.process["shot_noise"],
    )
    assert result.process["tilt"] == pytest.approx(setup.tilt, rel=0.02)
    assert first.process["noise"] == pytest.approx(setup.spread, rel=0.1)
    stated = estimate_normals(frames, phase, **options_of(setup), device=device)
    assert (stated.process["noise"], stated.process["shot_noise"], stated.process["tilt"]) == (
        pytest.approx(setup.spread),
        0.0,
        setup.tilt,
    )


def test_weights_are_inverse_variances(device):
    shape, weights = (20, 20), np.array([1, 4, 0.25, 1, 1, 9, 1, 0.01])
    clean = rotations.levels(facing(shape), SETUP)
    noise = np.random.default_rng(5).normal(0, 20, clean.shape) / np.sqrt(weights)[:, None, None]
    options = options_of(replace(SETUP, dtype="float32"), zenith_gain=np.full(shape, SETUP.slope))
    frames = (clean + noise).astype(np.float32)
    result = estimate_normals(frames, EIGHTHS, **options, frame_weights=weights, device=device)
    best = rotations.bound(facing(shape), SETUP, weights[:, None, None])
    error = rotations.between(result.normals.astype(float), facing(shape))
    assert np.mean(error**2 / best) == pytest.approx(1, abs=0.3)
    assert np.median(result.normals_sigma**2 / best) == pytest.approx(1, abs=0.05)


def stack(count=8, dtype=np.uint16):
    return np.full((count, *SHAPE), 900, dtype)


REFUSED = {
    "two phases": (stack(), [0, 3] * 4, {}, "8 frames at 2 different phases do not determine a fit"),
    "all missing": (stack(), EIGHTHS, {"frame_weights": np.zeros(8)}, "all 8 frames have weight 0|0 frames"),
    "a weight below 0": (stack(), EIGHTHS, {"frame_weights": [-1] + [1] * 7}, "weight -1 at frame 0"),
    "no tilt": (stack(), EIGHTHS, {"tilt": 0.0}, "tilt 0 deg: above 0 and up to 30 deg is needed"),
    "a tilt of 40 degrees": (stack(), EIGHTHS, {"tilt": np.radians(40)}, "tilt 40 deg: above 0"),
    "a tilt that cannot be seen": (stack(), EIGHTHS, {"tilt": "estimate"}, "to estimate the tilt"),
    "no scale": (stack(), EIGHTHS, {"zenith_gain": None}, "a zenith gain is needed"),
    "no gain": (
        stack(),
        EIGHTHS,
        {"zenith_gain": np.zeros(SHAPE)},
        "zenith_gain is 0 or not a number at every pixel",
    ),
    "a gain of no number": (
        stack(),
        EIGHTHS,
        {"zenith_gain": np.nan},
        "zenith_gain nan: a number in counts/rad",
    ),
    "a gain of others": (
        stack(),
        EIGHTHS,
        {"zenith_gain": np.ones((7, 5))},
        r"zenith gain has shape \(7, 5\)",
    ),
    "no offset": (stack(), EIGHTHS, {"zenith_offset": np.nan}, "zenith_offset nan: a number in counts"),
    "swapped ends": (stack(), EIGHTHS, {"dark": 900, "bright": 10}, "dark is not below bright"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line(case):
    frames, phase, options, message = REFUSED[case]
    with pytest.raises(InputError, match=message) as caught:
        estimate_normals(frames, phase, **{"tilt": TILT, "zenith_gain": 200.0, "noise": 1.0, **options})
    assert "\n" not in str(caught.value)


def test_a_block_that_does_not_fit_is_refused_and_changes_nothing():
    frames, phase = frames_of(turns=2), phases(SETUP, 2)
    run = run_of(None)
    with pytest.raises(InputError, match="none have been pushed"):
        run.result()
    push(run, frames[:10], phase[:10])
    with pytest.raises(InputError, match=r"weight -1\.0 at frame 0"):
        run.push(frames, phase=phase, frame_weights=-np.ones(16))
    with pytest.raises(InputError, match="a turn of 72 frames or more"):
        run.push(np.repeat(frames, 5, axis=0)[:70], phase=phase[9] + 1e-3 * np.arange(70))
    push(run, frames[10:], phase[10:])
    same(run.result(), estimate_normals(frames, phase, **options_of()))


def test_a_pixel_without_a_scale_has_no_answer(device):
    setup = replace(SETUP, phase=tuple(2 * np.pi * np.arange(9) / 9))
    frames, gain, offset = frames_of(setup), np.full(SHAPE, setup.slope), np.full(SHAPE, setup.offset)
    ends = {"dark": -1.0, "bright": 70_000.0}
    others = estimate_normals(
        frames, setup.phase, **options_of(setup, zenith_gain=gain), **ends, device=device
    )
    gain[1, 2], gain[4, 6], gain[0, 0], offset[3, 3] = 0, np.nan, np.inf, np.nan
    lost = ~(np.isfinite(gain) & (gain != 0) & np.isfinite(offset))
    options = options_of(setup, zenith_gain=gain, zenith_offset=offset)
    result = estimate_normals(frames, setup.phase, **options, **ends, device=device)
    np.testing.assert_array_equal(result.contact, ~lost)
    for name in MAPS:
        if name != "contact":
            np.testing.assert_array_equal(np.isnan(getattr(result, name))[lost], True)
        np.testing.assert_array_equal(getattr(result, name)[~lost], getattr(others, name)[~lost])


@pytest.mark.filterwarnings("ignore:estimate_normals. phase is in radians")
def test_phases_in_degrees_are_refused_with_the_remedy():
    message = r"phase is in radians; yours steps by 45 rad, more than a turn: convert degrees with"
    with pytest.raises(InputError, match=message):
        engine.estimate_normals(stack(), np.degrees(EIGHTHS), tilt=0.05, zenith_gain=200.0)
    with pytest.raises(InputError, match=message):
        engine.reconstruct(stack(), phase=np.degrees(EIGHTHS), tilt=0.05, zenith_gain=200.0)
