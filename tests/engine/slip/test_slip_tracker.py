"""Slip along a stream of frames: sigma, onset, keys, and what is not slip."""

from __future__ import annotations

import math
import tracemalloc

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from speckle import Speckle

from mirrorskin import engine, io
from mirrorskin.engine.slip import SlipTracker
from mirrorskin.twin import Body, Camera, Horizontal, SheetTexture, Sphere, Twin, Twist

SHAPE, PIXEL, NOISE = (96, 120), 0.05, 2.0
SPECKLE = Speckle(2)
CONTACT = np.zeros(SHAPE, np.uint8)
CONTACT[24:72, 30:90] = 1
SLIPPED, STICKS, NO_CONTACT = 1, 2, 3


def frame(right=0.0, down=0.0, seed=0, shape=SHAPE):
    return np.clip(SPECKLE.frame(shape, right, down, NOISE, seed), 0, 254).round().astype(np.uint8)


def turned(angle, centre=(60, 48)):
    """Displacements, pixels to the right and down, of points that are turned clockwise."""
    c, s = math.cos(angle) - 1, math.sin(angle)
    x0, y0 = centre
    return lambda x, y: c * (x - x0) - s * (y - y0), lambda x, y: s * (x - x0) + c * (y - y0)


def chi_square(result, right, down):
    error = result.displacement - np.array([right, -down]) * PIXEL
    return np.nanmean((error / result.displacement_sigma) ** 2)


@pytest.fixture(scope="module")
def followed():
    """Results of frames in which all skin moves alike."""
    tracker = SlipTracker(CONTACT, PIXEL)
    moves = [(0.31 * k, -0.17 * k) for k in range(12)]
    return [tracker.push(frame(*move, seed=k)) for k, move in enumerate(moves)], moves


def test_sigma_of_windows_matches_their_scatter(followed):
    results, moves = followed
    assert (results[0].displacement == 0).all()
    ratios = [chi_square(result, *move) for result, move in zip(results[1:], moves[1:], strict=True)]
    assert 0.7 < np.mean(ratios) < 1.5
    found, variances = results[-1], results[-1].displacement_covariance
    np.testing.assert_allclose(variances[..., :2], found.displacement_sigma**2, rtol=1e-5)
    inside = np.isfinite(variances[..., 0])
    assert (variances[..., 2] ** 2 < variances[..., 0] * variances[..., 1])[inside].all()


def test_windows_are_as_accurate_as_dense_displacements(followed):
    results, moves = followed
    dense = engine.slip.find_displacement(frame(seed=0), frame(*moves[-1], seed=11)[None], PIXEL)
    truth = np.array([moves[-1][0], -moves[-1][1]]) * PIXEL
    rows, columns = (
        np.searchsorted(axis, part) for axis, part in ((-dense.y, -results[-1].y), (dense.x, results[-1].x))
    )
    close = dense.displacement[0][np.ix_(rows, columns)] - truth
    error = results[-1].displacement - truth
    both = np.isfinite(error) & np.isfinite(close)
    assert np.mean(error[both] ** 2) < 1.5 * np.mean(close[both] ** 2)  # interpolation between nodes averages


def test_skin_that_sticks_does_not_slip(followed):
    results, moves = followed
    for result in results:
        touched = result.contact > 0
        assert (result.status[touched] == STICKS).all()
        assert (result.status[~touched] == NO_CONTACT).all()
        assert result.stick_ratio == 1
        assert (result.frame == -1).all()
    assert results[-1].shift_x == pytest.approx(moves[-1][0] * PIXEL, abs=5 * results[-1].shift_x_sigma)
    assert results[-1].shift_x_sigma < 0.3 * np.nanmedian(results[-1].displacement_sigma)


def test_rotation_has_a_centre():
    tracker, centre = SlipTracker(CONTACT, PIXEL), (66, 44)
    for k in range(9):
        result = tracker.push(frame(*turned(0.05 * k, centre), seed=k))
    assert result.angle == pytest.approx(-0.4, abs=5 * result.angle_sigma)
    assert result.angle_sigma < 0.002
    place = (centre[0] - (SHAPE[1] - 1) / 2) * PIXEL, ((SHAPE[0] - 1) / 2 - centre[1]) * PIXEL
    assert result.centre_x == pytest.approx(place[0], abs=5 * result.centre_x_sigma)
    assert result.centre_y == pytest.approx(place[1], abs=5 * result.centre_y_sigma)
    assert result.centre_x_sigma < 0.1 * PIXEL
    assert result.stick_ratio == 1
    still = SlipTracker(CONTACT, PIXEL)
    still.push(frame(seed=20))
    assert math.isnan(still.push(frame(seed=21)).centre_x)


def test_changes_of_the_light_are_not_slip():
    tracker = SlipTracker(CONTACT, PIXEL)
    tracker.push(frame(seed=0))
    for k in range(1, 6):
        lit = frame(0.2 * k, 0, seed=k) * (1 - 0.06 * k) + 6 * k + np.linspace(0, 2 * k, SHAPE[1])
        result = tracker.push(lit.round().astype(np.uint8))
    assert result.stick_ratio == 1
    assert 0.5 < chi_square(result, 1.0, 0) < 1.8  # brightness is not quite a plane


def test_a_covered_window_has_no_value_and_does_not_slip():
    tracker = SlipTracker(CONTACT, PIXEL)
    for k in range(8):
        picture = frame(0.2 * k, 0, seed=k)
        if k > 3:
            picture[40:60, 50:70] = np.random.default_rng(k).integers(0, 250, (20, 20))
        result = tracker.push(picture)
    column, row = np.argmin(abs(result.x)), np.argmin(abs(result.y))
    assert np.isnan(result.displacement[row, column]).all()
    assert result.status[row, column] == 0
    assert result.stick_ratio == 1
    assert chi_square(result, 1.4, 0) < 1.5


def test_a_step_of_many_pixels_is_found(followed):
    tracker = SlipTracker(CONTACT, PIXEL)
    tracker.push(frame(seed=0))
    assert 0.6 < chi_square(tracker.push(frame(7.3, -4.6, seed=1)), 7.3, -4.6) < 1.6


def test_sigma_includes_the_errors_of_keys():
    ratios, tracker = [], SlipTracker(np.ones(SHAPE), PIXEL, window_step=12)
    for k in range(60):
        result = tracker.push(frame(0.9 * k, 0.4 * k, seed=k))
        if tracker.keys > 1:
            ratios.append(chi_square(result, 0.9 * k, 0.4 * k))
    assert tracker.keys > 1
    assert 0.5 < np.mean(ratios) < 1.7
    assert result.process["keys"] == tracker.keys


def disc(radius, shape=SHAPE):
    y, x = np.indices(shape)
    return (np.hypot(x - shape[1] / 2, y - shape[0] / 2) < radius).astype(np.uint8)


def growing(frames, first=16, rate=2.0, step=0.35):
    """Frames and contacts of an object that moves to the right while the contact grows and takes skin along.

    Skin moves with the object from when it is touched.
    """
    for k in range(frames):
        radius = first + rate * k

        def right(x, y, k=k):
            touched = np.maximum((np.hypot(x - SHAPE[1] / 2, y - SHAPE[0] / 2) - first) / rate, 0)
            return step * np.maximum(k - touched, 0)

        yield frame(right, lambda x, y: 0 * x, seed=k), disc(radius)


def test_skin_that_a_growing_contact_takes_along_sticks():
    tracker = SlipTracker(pixel_size=PIXEL)
    for k, (picture, contact) in enumerate(growing(12)):
        result = tracker.push(picture, contact)
        assert result.stick_ratio > 0.95  # the displacement bends sharply at the border
        assert result.shift_x == pytest.approx(0.35 * k * PIXEL, abs=5 * result.shift_x_sigma + 1e-9)
    assert result.shift_x_sigma < 0.2 * PIXEL
    assert (result.contact > 0).sum() > 2 * (disc(16) > 0).sum() / tracker._step**2


def test_a_contact_of_a_few_windows_starts_when_it_is_larger():
    tracker = SlipTracker(pixel_size=PIXEL)
    for k, radius in enumerate((0, 5, 8, 30, 30)):
        result = tracker.push(frame(0.3 * k, 0, seed=k), disc(radius))
        if radius < 30:
            assert math.isnan(result.shift_x)
            assert np.isnan(result.stick_ratio)
    assert result.shift_x == pytest.approx(0.3 * PIXEL, abs=5 * result.shift_x_sigma)
    assert result.stick_ratio == 1


def test_a_contact_that_is_found_again_starts_anew():
    tracker = SlipTracker(CONTACT, PIXEL)

    def slides(x, y):
        return np.where(abs(y - 48) < 12, 0.0, 3.0) + 0 * x

    for k in range(6):
        result = tracker.push(frame(lambda x, y, k=k: k / 5 * slides(x, y), lambda x, y: 0 * x, seed=k))
    assert (result.status == SLIPPED).any()
    lost = tracker.push(frame(slides, lambda x, y: 0 * x, seed=6), 0 * CONTACT)
    assert (lost.status == NO_CONTACT).all()
    assert np.isnan(lost.stick_ratio)
    assert math.isnan(lost.shift_x)
    again = tracker.push(frame(slides, lambda x, y: 0 * x, seed=7), CONTACT)
    assert again.stick_ratio == 1
    assert again.shift_x == 0
    assert (again.frame == -1).all()


def test_skin_from_outside_the_contact_is_known_after_a_change_of_the_key():
    contact = np.zeros(SHAPE, np.uint8)
    contact[30:66, 6:36] = 1
    tracker, frames = SlipTracker(contact, PIXEL, window_step=6), 44
    for k in range(frames):
        result = tracker.push(frame(-1.1 * k, 0, seed=k))
    assert tracker.keys > 1
    touched = result.contact > 0
    found = touched & np.isfinite(result.displacement[..., 0])
    assert found.sum() > 0.6 * touched.sum()  # others have left the picture since the last key
    error = result.displacement - [-1.1 * (frames - 1) * PIXEL, 0]
    assert 0.4 < np.mean((error / result.displacement_sigma)[found] ** 2) < 2


def test_the_contact_is_that_of_the_picture():
    contact = np.zeros(SHAPE, np.uint8)
    contact[30:66, 6:36] = 1
    tracker = SlipTracker(contact, PIXEL, window_step=6)
    for k in range(24):
        result = tracker.push(frame(-1.1 * k, 0, seed=k), contact)
    touched = result.contact > 0
    now = (result.x + np.zeros(touched.shape) + result.displacement[..., 0])[touched]
    assert np.isfinite(now).mean() > 0.9
    place = now[np.isfinite(now)] / PIXEL + (SHAPE[1] - 1) / 2
    assert (place > 2).all()
    assert (place < 40).all()


def test_results_have_one_shape_for_all_contacts():
    tracker = SlipTracker(CONTACT, PIXEL)
    first = tracker.push(frame(seed=0))
    moved = tracker.push(frame(0.2, 0, seed=1), np.roll(CONTACT, 20, axis=1))
    for name in ("displacement", "status", "contact", "frame"):
        assert first[name].shape == moved[name].shape
    np.testing.assert_array_equal(first.x, moved.x)
    assert (moved.contact > 0)[:, moved.x > 1.5].any()


def pressed(movement):
    return Twin(
        object=Sphere(10.0),
        shape=(144, 144),
        pixel_size=0.03,
        movement=movement,
        contact="elastic",
        body=Body(friction=0.5),
        camera=Camera(noise=1.0, electrons=40.0, point_spread=0.5),
        texture=SheetTexture("flakes", size=0.12, contrast=0.9),
    )


@pytest.mark.parametrize("motion", ["slide", "twist"])
def test_onset_of_slip_is_found_within_two_frames(motion):
    share = np.linspace(0, 0.9 if motion == "slide" else math.radians(10.9), 24)
    path = 1.5 * 0.5 * 0.5 * share  # until all slides
    twin = pressed(Horizontal(np.outer(path, [1, 0]), 0.5) if motion == "slide" else Twist(share, 0.5))
    touched = twin.sheet(0).contact
    tracker, detected = SlipTracker(touched, 0.03, window_step=9), None
    for k, picture in enumerate(twin.read(np.empty(twin.shape, twin.dtype)).frames):
        result = tracker.push(picture)
        detected = np.full(result.status.shape, -1) if detected is None else detected
        detected[(result.frame >= 0) & (detected < 0)] = k
    places = 71.5 - result.y / 0.03, 71.5 + result.x / 0.03
    rows, columns = (np.clip(np.rint(place), 0, 143).astype(int) for place in places)
    distance = path if motion == "slide" else share
    onset = np.interp(twin.truth.slip_onset[np.ix_(rows, columns)], distance, np.arange(24), right=np.nan)
    # Windows that are in contact as a whole; others contain free skin.
    whole = cv2.erode(touched.view(np.uint8), np.ones((13, 13)))[np.ix_(rows, columns)] > 0
    slipped = whole & (onset < 20)
    assert slipped.sum() > 15
    assert (result.status[slipped] == SLIPPED).mean() > 0.9
    both = slipped & (result.status == SLIPPED)
    assert np.sqrt(np.mean((result.frame - onset)[both] ** 2)) < 2
    assert np.median(np.abs(detected - onset)[both]) < 2
    stuck = whole & np.isnan(onset)
    assert (result.status[stuck] == STICKS).mean() > 0.7  # the border runs through some windows
    place = np.meshgrid(*places, indexing="ij")
    truth = [
        map_coordinates(part, place, order=1) for part in np.moveaxis(twin.truth.displacement[-1], -1, 0)
    ]
    error = result.displacement - np.stack(truth, axis=-1)
    assert 0.5 < np.nanmean((error / result.displacement_sigma)[whole] ** 2) < 2


def test_a_result_gives_the_force(followed):
    result = followed[0][-1]
    force = engine.force.find_tangential_force(result, modulus=0.1)
    assert force.force_x > 3 * force.force_x_sigma
    assert force.force_y > 3 * force.force_y_sigma


def test_results_are_kept_in_files(followed, tmp_path):
    result = followed[0][-1]
    io.save_result(result, tmp_path / "slip.h5")
    other = io.open_result(tmp_path / "slip.h5")
    for name in result:
        np.testing.assert_array_equal(other[name], result[name], err_msg=name)


def test_frames_need_no_new_memory_of_their_size():
    shape = (480, 640)
    tracker = SlipTracker(np.ones(shape, np.uint8), PIXEL)
    pictures = [np.tile(frame(0.1 * k, 0, seed=k), (5, 6))[:480, :640].astype(np.float32) for k in range(5)]
    for picture in pictures[:4]:
        tracker.push(picture)
    tracemalloc.start()
    try:
        tracker.push(pictures[4])
        assert tracemalloc.get_traced_memory()[1] < pictures[4].nbytes / 8
    finally:
        tracemalloc.stop()


def test_bad_input_is_one_line():
    for options, message in [
        ({"window_size": 4}, "window_size 4"),
        ({"window_step": 65}, "window_step 65"),
        ({"noise": 0.0}, "noise 0"),
        ({"contact": 0 * CONTACT}, "contact is nowhere"),
        ({"contact": CONTACT[:-1]}, "contact has shape"),
        ({"pixel_size": None}, "no pixel size"),
        ({"contact": None, "pixel_size": None}, "pixel_size"),
    ]:
        with pytest.raises(io.InputError, match=message):
            SlipTracker(**({"contact": CONTACT, "pixel_size": PIXEL} | options)).push(frame())
    tracker = SlipTracker(CONTACT, PIXEL)
    tracker.push(frame())
    for bad in (frame().astype(np.uint16), frame()[:-1], frame()[None]):
        with pytest.raises(io.InputError, match="is needed"):
            tracker.push(bad)
    clear = SlipTracker(CONTACT, PIXEL)
    noise = np.random.default_rng(0).normal(100, 2, (2, *SHAPE)).round().astype(np.uint8)
    clear.push(noise[0])
    with pytest.raises(io.InputError, match="show no texture"):
        clear.push(noise[1])
