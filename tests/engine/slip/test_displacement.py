"""Displacement from frames: exact textures, the Cramer-Rao bound, and sheets without texture."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from speckle import Speckle

from mirrorskin import io
from mirrorskin.engine.slip import find_displacement
from mirrorskin.io import InputError
from mirrorskin.twin import SheetTexture

SHAPE, NOISE, PIXEL = (96, 128), 2.0, (0.1, 0.05)
SPECKLE = Speckle()
REFERENCE = SPECKLE.frame(SHAPE, 0, 0, NOISE, 99)
INSIDE = np.s_[..., 16:-16, 16:-16, :]


def turned(angle, centre=(64, 48)):
    """Displacements, pixels to the right and down, of points that are turned clockwise."""
    c, s = math.cos(angle) - 1, math.sin(angle)
    x0, y0 = centre
    return lambda x, y: c * (x - x0) - s * (y - y0), lambda x, y: s * (x - x0) + c * (y - y0)


def in_mm(right, down):
    return np.stack([right * PIXEL[0], -down * PIXEL[1]], axis=-1)


def grid(right, down, shape=SHAPE):
    row, column = np.mgrid[: shape[0], : shape[1]].astype(float)
    return in_mm(right(column, row), down(column, row))


@pytest.mark.parametrize("window", [9, 15])
def test_errors_are_at_the_bound_and_sigma_is_true(device, window):
    shifts = [(0.3 * k, -0.17 * k) for k in range(1, 5)]
    squares, bound = [], []
    for seed, (right, down) in enumerate(shifts):
        reference = SPECKLE.frame(SHAPE, 0, 0, NOISE, 50 + seed)
        frames = SPECKLE.frame(SHAPE, right, down, NOISE, seed)[None]
        slip = find_displacement(
            reference, frames, PIXEL, window_size=window, window_step=1, noise=NOISE, device=device
        )
        error = (slip.displacement - in_mm(np.float64(right), np.float64(down)))[INSIDE]
        squares.append(error**2)
        bound.append(slip.displacement_sigma[INSIDE].astype(float) ** 2)
    assert np.sqrt(np.mean(squares) / np.mean(bound)) == pytest.approx(1, abs=0.07)
    assert np.mean(np.array(squares) / np.array(bound)) == pytest.approx(1, abs=0.12)


@pytest.mark.parametrize(("kind", "size"), [("dots", 3.0), ("random-dots", 4.0), ("flakes", 4.0)])
def test_errors_on_a_sheet_s_own_texture_are_at_the_bound(kind, size):
    column, row = np.meshgrid(np.arange(128.0), np.arange(96.0))
    squares, bound = [], []
    for seed in range(1, 5):
        sheet, random = SheetTexture(kind, size=size, seed=seed), np.random.default_rng(seed)
        right, down = 0.3 * seed, -0.17 * seed
        reference, frame = (
            (20 + 100 * sheet.reflectance(np.stack([column - x, row - y]), (1.0, 1.0))
             + random.normal(0, NOISE, SHAPE)).astype(np.float32)
            for x, y in ((0, 0), (right, down))
        )  # fmt: skip
        slip = find_displacement(reference, frame[None], PIXEL, window_step=1)
        assert (slip.status[INSIDE[:-1]] == 1).mean() > 0.99
        squares.append((slip.displacement - in_mm(np.float64(right), np.float64(down)))[INSIDE] ** 2)
        bound.append((slip.displacement_sigma[INSIDE] * NOISE / slip.process["noise"]) ** 2)
    assert np.sqrt(np.nanmean(squares) / np.nanmean(bound)) == pytest.approx(1, abs=0.1)


def test_the_noise_is_estimated_from_what_the_fit_leaves():
    slip = find_displacement(REFERENCE, SPECKLE.frame(SHAPE, 0.4, 0.7, NOISE, 1)[None], PIXEL)
    assert slip.process["noise"] == pytest.approx(NOISE, rel=0.03)


@pytest.mark.parametrize("angle", [0.05, 0.2])
def test_a_turn_is_followed_frame_by_frame(angle):
    steps = [turned(angle * k / 5) for k in range(1, 6)]
    frames = np.stack([SPECKLE.frame(SHAPE, *step, NOISE, k) for k, step in enumerate(steps)])
    slip = find_displacement(REFERENCE, frames, PIXEL)
    part = np.s_[24:-24, 24:-24]
    error = (slip.displacement[-1] - grid(*steps[-1]))[part]
    assert (slip.status[-1][part] == 1).all()
    assert np.mean((error / slip.displacement_sigma[-1][part]) ** 2) == pytest.approx(1, abs=0.15)


def test_sigma_counts_that_the_movement_bends_inside_windows():
    def right(x, y):
        return 0.003 * (x - 64) ** 2 + 0 * y

    frames = np.stack([SPECKLE.frame(SHAPE, right, 0, NOISE, k) for k in range(4)])
    slip = find_displacement(REFERENCE, frames, PIXEL, window_size=16)
    part = np.s_[:, 24:-24, 40:88, 0]
    error = (slip.displacement - grid(right, lambda x, y: 0 * x))[part]
    assert np.mean((error / slip.displacement_sigma[part]) ** 2) == pytest.approx(1, abs=0.4)


@pytest.mark.parametrize("far", [6.0, 40.0])
def test_a_long_displacement_in_one_step_is_found(far):
    frame = SPECKLE.frame(SHAPE, far, 0, NOISE, 1)[None]
    slip = find_displacement(REFERENCE, frame, PIXEL, window_size=16)
    displaced = slip.displacement[0, 16:-16, 16 : -16 - int(far), 0]
    assert np.nanmedian(displaced) == pytest.approx(far * PIXEL[0], abs=1e-3)
    assert np.mean(np.abs(displaced - far * PIXEL[0]) < 0.01) > 0.95
    assert np.isnan(slip.displacement[0, :, -int(far) :]).all()
    assert (slip.status[0, :, -int(far) :] == 0).all()


def as_jpeg(frame, quality):
    encoded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("seed", [3, 4])
def test_sigma_counts_errors_that_are_correlated_within_windows(seed):
    texture = Speckle(seed)
    shifts = [(0.37 * k, -0.21 * k) for k in range(5)]
    frames = np.stack([texture.frame(SHAPE, *shift, 1.5, k).round() for k, shift in enumerate(shifts)])
    true = np.stack([in_mm(*np.float64(shift)) for shift in shifts[1:]])[:, None, None]

    def squares(frames):
        slip = find_displacement(frames[0], frames[1:], PIXEL)
        assert "neighbouring windows" not in slip.process.get("warnings", "")
        return np.mean(((slip.displacement - true)[INSIDE] / slip.displacement_sigma[INSIDE]) ** 2)

    frames = frames.clip(0, 255).astype(np.uint8)
    assert squares(frames) == pytest.approx(1, abs=0.2)
    lossy = np.stack([as_jpeg(frame, 75) for frame in frames])
    assert squares(lossy) == pytest.approx(1, abs=0.2)  # 1.4 with the residuals alone


def test_displacements_that_scatter_far_more_than_noise_explains_have_a_warning():
    noise = np.random.default_rng(3).normal(0, 12, (4, *SHAPE))
    frames = np.stack(
        [SPECKLE.frame(SHAPE, 0.3 * k, 0) + cv2.GaussianBlur(noise[k], (0, 0), 1.5) for k in range(4)]
    )
    slip = find_displacement(frames[0], frames[1:], PIXEL)
    assert "neighbouring windows differ by" in slip.process["warnings"]
    error = (slip.displacement - in_mm(0.3 * np.arange(1, 4), np.zeros(3))[:, None, None])[INSIDE]
    assert np.mean((error / slip.displacement_sigma[INSIDE]) ** 2) == pytest.approx(1, abs=0.3)


def test_another_gain_and_offset_of_brightness_change_nothing():
    frame = SPECKLE.frame(SHAPE, 1.2, 0.4, NOISE, 1)
    row = np.arange(SHAPE[0])[:, None]
    plain, other = (
        find_displacement(REFERENCE, counts.astype(np.float32)[None], PIXEL, noise=NOISE)
        for counts in (frame, 1.3 * frame - 40 + 0.5 * row)
    )
    error = (other.displacement - plain.displacement)[INSIDE] / plain.displacement_sigma[INSIDE]
    assert np.sqrt(np.mean(error**2)) < 0.4


def test_the_frames_own_types_give_the_same():
    frames = [SPECKLE.frame(SHAPE, 0.3 * k, 0.2 * k, NOISE, k).round() for k in range(3)]
    by_type = [
        find_displacement(
            frames[0].astype(dtype), np.stack(frames[1:]).astype(dtype), PIXEL, noise=NOISE
        ).displacement
        for dtype in (np.uint8, np.uint16, np.float32)
    ]
    np.testing.assert_array_equal(by_type[0], by_type[1])
    np.testing.assert_array_equal(by_type[0], by_type[2])


def test_where_the_sheet_is_clear_there_is_no_answer():
    clear = np.random.default_rng(1).normal(100, NOISE, (2, *SHAPE)).astype(np.float32)
    half = np.s_[:, 64:]
    reference, frame = REFERENCE.copy(), SPECKLE.frame(SHAPE, 0.5, 0, NOISE, 3)
    reference[half], frame[half] = clear[0][half], clear[1][half]
    slip = find_displacement(reference, frame[None], PIXEL)
    assert (slip.status[0, :, 76:] == 3).mean() > 0.99
    assert np.isnan(slip.displacement[0, :, 76:]).mean() > 0.99
    assert (slip.status[0, 16:-16, 16:56] == 1).all()


def test_a_clear_sheet_is_refused():
    clear = np.random.default_rng(2).normal(100, NOISE, (3, *SHAPE)).astype(np.float32)
    with pytest.raises(
        InputError, match=r"no texture beyond the noise of 2(\.0)? counts: displacement needs"
    ):
        find_displacement(clear[0], clear[1:], PIXEL)


def test_a_texture_that_is_not_found_again_has_no_answer():
    other = Speckle(7).frame(SHAPE, 0, 0, NOISE, 1)
    slip = find_displacement(REFERENCE, other[None], PIXEL, noise=NOISE)
    assert np.isin(slip.status, [0, 2]).mean() > 0.9
    assert np.isnan(slip.displacement).mean() > 0.9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"window_size": 5}, "window_size 5: 6 to 96 pixels"),
        ({"window_size": 97}, "window_size 97: 6 to 96 pixels"),
        ({"window_step": 0}, "window_step 0: 1 to 64 pixels"),
        ({"noise": 0.0}, "noise 0.0: a standard deviation"),
        ({"pixel_size": -1}, "pixel size -1: a length"),
        ({"frames": REFERENCE}, r"frames \(96, 128\): \(H, W\) and \(T, H, W\) are needed"),
        ({"frames": REFERENCE[None, :-1]}, r"float32 \(n, .*\) is needed"),
        ({"reference": REFERENCE.astype(complex)}, "reference is .*: numbers are needed"),
    ],
)
def test_bad_input_is_one_line(change, message):
    arguments = {"reference": REFERENCE, "frames": REFERENCE[None], "pixel_size": PIXEL} | change
    with pytest.raises(InputError, match=message):
        find_displacement(**arguments)


def test_a_displacement_is_a_result_that_files_and_datasets_keep(tmp_path):
    frames = SPECKLE.frame(SHAPE, 0.4, 0.7, NOISE, 1)[None]
    slip = find_displacement(REFERENCE, frames, PIXEL)
    io.save_result(slip, tmp_path / "moved.h5")
    for other in (io.open_result(tmp_path / "moved.h5"), io.Result.from_xarray(slip.to_xarray())):
        for name in ("displacement", "displacement_sigma", "status"):
            np.testing.assert_array_equal(other[name], slip[name], err_msg=name)
        assert other.declaration("status").codes[3] == "no texture"
        np.testing.assert_allclose(np.diff(other.x), PIXEL[0])
    assert slip.to_xarray().displacement_sigma.dims == ("frame", "y", "x", "direction")
