"""Slip from frames of known stick and slip, in slides and twists."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion
from speckle import Speckle
from stacks import MadeUp

from mirrorskin import engine, io
from mirrorskin.engine.slip import SlipOnset
from mirrorskin.io import InputError
from mirrorskin.twin import Body, Camera, Horizontal, SheetTexture, Sphere, Twin

SHAPE, PIXEL, NOISE = (128, 140), 0.05, 1.5
CONTACT, FULL, STEP = 44.0, 11.0, 0.35  # pixels
SPECKLE = Speckle(5)
ROW, COLUMN = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
CENTRE = (SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2


def radius(x, y):
    return np.hypot(x - CENTRE[0], y - CENTRE[1])


def onset(x, y):
    """As under a ball (Cattaneo and Mindlin), pixels of the way."""
    return FULL * (1 - (radius(x, y) / CONTACT) ** 2)


def departure(x, y, distance):
    """The slip of Cattaneo and Mindlin: a shift FULL (1 - r^2 / (2 a^2)) less that of what sticks."""
    fraction = np.minimum(radius(x, y) / CONTACT, 1) ** 2
    q = np.clip((1 - distance / FULL) / np.maximum(fraction, 1e-9), 0, 1)  # of what sticks: (c / r)^2
    part = (1 - 2 / np.pi * np.arcsin(np.sqrt(q))) * (1 - 2 * q) + 2 / np.pi * np.sqrt(q * (1 - q))
    slip = FULL * fraction / 2 * part
    return distance - (distance - slip) * np.minimum(CONTACT / np.maximum(radius(x, y), 1e-9), 1) ** 2


@cache
def slide(direction=(1.0, 0.0), count=20, drawn=0.0, step=STEP):
    """Frames of a body that slides along a direction, y up, and the places where it was, mm.

    The skin seems drawn to halves of a pixel by so many pixels, as coarsely sampled texture does.
    """
    right, up = direction
    frames = []
    for k in range(count):
        distance = k * step

        def lag(x, y, distance=distance):
            moved = distance - departure(x, y, distance)
            return moved + drawn * np.sin(2 * np.pi * moved)

        frames.append(
            SPECKLE.frame(
                SHAPE,
                lambda x, y, lag=lag: -right * lag(x, y),
                lambda x, y, lag=lag: up * lag(x, y),
                NOISE,
                k,
            )
        )
    return np.stack(frames), np.arange(count)[:, None] * step * PIXEL * np.array(direction)


INSIDE = radius(COLUMN, ROW) < CONTACT


def search(**options):
    return SlipOnset(**({"contact": INSIDE, "pixel_size": PIXEL} | options))


@pytest.fixture(scope="module")
def slid():
    frames, places = slide()
    run = engine.Run(search())
    run.push(frames, displacement=places)
    return run.result(), float(places[-1, 0])


def test_slip_and_stick_are_distinguished_within_a_pixel(slid):
    result, distance = slid
    true = onset(COLUMN, ROW) * PIXEL < distance
    border = binary_dilation(true & INSIDE) & ~binary_erosion(true & INSIDE)
    part = INSIDE & ~border & np.isin(result.status, [1, 2])
    slipped = result.status == 1
    assert part[INSIDE & ~border].mean() > 0.97
    assert (slipped & true & part).sum() >= 0.98 * (true & part).sum()
    assert (slipped & true & part).sum() >= 0.98 * (slipped & part).sum()
    assert (result.status[~INSIDE] == 3).all()


def test_texture_that_seems_drawn_to_halves_of_a_pixel_does_not_pass_for_slip():
    frames, places = slide(count=18, drawn=0.06)
    run = engine.Run(search())
    run.push(frames, displacement=places)
    result, true = run.result(), onset(COLUMN, ROW) * PIXEL
    assert np.sqrt(np.nanmean((result.slip_onset - true)[INSIDE] ** 2)) < 0.3 * STEP * PIXEL
    assert (result.status[INSIDE] == 1).sum() == pytest.approx((true[INSIDE] < places[-1, 0]).sum(), rel=0.02)


def test_the_moment_of_slip_is_known_within_a_frame_and_its_sigma_is_of_that_size(slid):
    slip, _ = slid
    error = (slip.slip_onset - onset(COLUMN, ROW) * PIXEL)[INSIDE]
    assert np.sqrt(np.nanmean(error**2)) < 0.35 * STEP * PIXEL
    assert abs(np.nanmean(error)) < 0.15 * STEP * PIXEL
    assert 0.2 < np.nanmean((error / slip.slip_onset_sigma[INSIDE]) ** 2) < 1.5  # the exponent is right here
    assert np.isnan(slip.slip_onset[slip.status == 2]).all()


def test_the_stick_ratio_is_that_of_the_disc_that_sticks(slid):
    result, _ = slid
    ways = np.arange(20) * STEP
    expected = np.sqrt(1 - ways / FULL)  # of the radii
    np.testing.assert_allclose(np.sqrt(result.stick_ratio[3:]), expected[3:], rtol=0.01)
    assert result.stick_ratio[0] == 1


def test_the_displacement_is_that_of_the_skin(slid):
    result, distance = slid
    lag = distance / PIXEL - departure(COLUMN, ROW, distance / PIXEL)
    error = result.displacement - np.stack([-lag * PIXEL, 0 * lag], axis=-1)
    sigma = result.displacement_sigma[..., None]
    part = radius(COLUMN, ROW) < CONTACT / 2  # farther out the movement bends within a window
    assert np.nanmean((error / sigma)[part] ** 2) == pytest.approx(1, abs=0.25)


def test_the_direction_of_a_slide_does_not_matter(slid):
    frames, places = slide((-0.6, 0.8), count=14)
    run = engine.Run(search())
    run.push(frames, displacement=places)
    assert run.result().stick_ratio[-1] == pytest.approx(slid[0].stick_ratio[13], rel=0.05)


def test_contact_is_estimated_if_it_is_not_given(slid):
    frames, places = slide()
    run = engine.Run(search(contact=None))
    run.push(frames, displacement=places)
    result = run.result()
    assert result.contact[INSIDE].mean() > 0.97
    assert result.contact.sum() < 1.1 * INSIDE.sum()
    stuck = [np.count_nonzero(slip.status == 2) for slip in (result, slid[0])]
    assert stuck[0] == pytest.approx(stuck[1], rel=0.15)


def test_skin_that_sticks_does_so_to_the_end():
    frames = np.stack([SPECKLE.frame(SHAPE, -0.4 * k, 0, NOISE, k) for k in range(8)])
    run = engine.Run(search())
    run.push(frames, displacement=0.4 * PIXEL * np.arange(8)[:, None] * [1, 0])
    result = run.result()
    assert (result.status[INSIDE] == 1).mean() < 0.01
    assert (result.stick_ratio > 0.99).all()


def test_a_body_that_turns_back_is_followed_until_then():
    frames, places = slide()
    positions = np.r_[np.arange(20), np.arange(18, 14, -1)]
    run = engine.Run(search())
    run.push(frames[positions], displacement=places[positions])
    result = run.result()
    assert np.isfinite(result.stick_ratio[:20]).all()
    assert np.isnan(result.stick_ratio[20:]).all()


def test_centre_and_angle_of_a_twist_are_those_of_the_skin_that_sticks():
    about, steps = (6.0, -4.0), np.linspace(0, 0.12, 7)  # pixels right and up of the middle
    x0, y0 = CENTRE[0] + about[0], CENTRE[1] - about[1]

    def turned(angle):  # the body counter-clockwise, the skin clockwise in the picture
        c, s = math.cos(angle) - 1, math.sin(angle)
        return (lambda x, y: c * (x - x0) - s * (y - y0)), (lambda x, y: s * (x - x0) + c * (y - y0))

    frames = np.stack([SPECKLE.frame(SHAPE, *turned(angle), NOISE, k) for k, angle in enumerate(steps)])
    centre = (about[0] * PIXEL, about[1] * PIXEL)
    run = engine.Run(search(motion="twist", centre=centre))
    run.push(frames, twist=steps)
    result = run.result()
    assert result.process["angle"] == pytest.approx(-0.12, abs=2e-4)
    assert (result.process["centre_x"], result.process["centre_y"]) == pytest.approx((0, 0), abs=0.1 * PIXEL)
    assert result.twist_angle.tolist() == pytest.approx(steps)
    assert result.declaration("slip_onset").unit == result.declaration("slip_onset_sigma").unit == "rad"
    assert (result.status[INSIDE] == 1).mean() < 0.01


def test_bad_input_is_one_line():
    frames, places = slide()
    for options, message in [
        ({"motion": "axial"}, "unknown motion 'axial'. Use horizontal or twist"),
        ({"contact": INSIDE[:-1]}, "contact has shape"),
        ({"contact": 0 * INSIDE}, "contact is nowhere"),
        ({"window_size": 4}, "window_size 4"),
        ({"window_size": 200}, "window_size 200: 6 to 128 pixels"),
        ({"window_step": 65}, "window_step 65: 1 to 64 pixels"),
        ({"noise": 0.0}, r"noise 0(\.0)?: a number in counts above 0 is needed"),
        ({"pixel_size": None}, "the pixel size is missing"),
    ]:
        with pytest.raises(InputError, match=message):
            engine.run(frames, search(**options), displacement=places)
    run = engine.Run(search())
    with pytest.raises(InputError, match="displacement is missing: SlipOnset needs it of each frame"):
        run.push(frames)
    with pytest.raises(InputError, match="SlipOnset has no position twist: it has displacement"):
        run.push(frames, displacement=places, twist=np.arange(20.0))
    with pytest.raises(InputError, match=r"displacement has shape \(20,\) for 20 frames: two numbers"):
        run.push(frames, displacement=places[:, 0])
    with pytest.raises(InputError, match="SlipOnset needs at least 3 frames; none have been pushed so far"):
        run.result()
    run.push(frames[:4], displacement=0 * places[:4])
    with pytest.raises(InputError, match="the body does not move"):
        run.result()


def test_a_source_is_reconstructed_as_the_operation_does(slid):
    frames, places = slide()
    source = MadeUp(frames, io.Header("horizontal", pixel_size=(PIXEL, PIXEL)), displacement=places)
    result = engine.reconstruct(source, contact=INSIDE)
    for name in ("displacement", "displacement_sigma", "slip_onset", "slip_onset_sigma", "status", "contact"):
        np.testing.assert_array_equal(result[name], slid[0][name], err_msg=name)
    np.testing.assert_array_equal(result.slide_distance, slid[0].slide_distance)
    expected = {"motion": "horizontal", "frames": 20, "window_size": 8, "window_step": 4, "contact": "given"}
    assert expected.items() <= result.process.items()
    assert result.process["noise"] == slid[0].process["noise"]
    assert result.x[0] == pytest.approx(-PIXEL * (SHAPE[1] - 1) / 2)
    assert result.traction is None


@pytest.mark.parametrize("kind", ["result", "mapping", "dataset", "file", "pressure", "heights"])
def test_the_contact_comes_from_wherever_there_is_one(kind, slid, tmp_path):
    result = io.Result(contact=INSIDE.astype(np.uint8))
    heights = io.Result(
        {"depth": np.where(INSIDE, -0.1, np.nan)},
        declarations={"depth": io.Map(unit="mm", quantity="height")},
    )
    io.save_result(result, tmp_path / "press.h5")
    contact = {
        "result": result,
        "mapping": {"contact": INSIDE},
        "dataset": result.to_xarray(),
        "file": tmp_path / "press.h5",
        "pressure": io.Result(pressure=INSIDE * np.float32(0.1)),
        "heights": heights,
    }[kind]
    frames, places = slide()
    run = engine.Run(search(contact=contact))
    run.push(frames, displacement=places)
    slipped = run.result()
    np.testing.assert_array_equal(slipped.contact, INSIDE)
    np.testing.assert_array_equal(slipped.slip_onset, slid[0].slip_onset)
    assert slipped.process["contact"] == ("given, by light" if kind == "heights" else "given")


def test_a_modulus_gives_traction_and_force(slid):
    frames, places = slide()
    source = MadeUp(frames, io.Header("horizontal", pixel_size=(PIXEL, PIXEL)), displacement=places)
    result = engine.reconstruct(source, contact=INSIDE, modulus=0.1)
    assert result.process["modulus"] == "0.1 MPa, given"
    assert result.force_x < -3 * result.force_x_sigma
    expected = engine.force.find_tangential_force(slid[0], PIXEL, 0.1, window_size=8)
    np.testing.assert_array_equal(result.traction, expected.traction)
    assert (result.force_x, result.force_y_sigma) == (expected.force_x, expected.force_y_sigma)
    assert result.traction[..., 0].sum() * PIXEL**2 == pytest.approx(result.force_x, rel=0.1)


def test_free_skin_in_windows_at_the_rim_of_an_estimated_contact_does_not_look_like_early_slip():
    frames, places = slide()
    run = engine.Run(search(contact=None))
    run.push(frames[:14], displacement=places[:14])  # to 0.4 of the way at which all slides
    result = run.result()
    error = (result.slip_onset - onset(COLUMN, ROW) * PIXEL)[INSIDE]
    assert abs(np.nanmean(error)) < 0.3 * STEP * PIXEL  # 1.1 frames early with all windows
    assert 0.2 < np.nanmean((error / result.slip_onset_sigma[INSIDE]) ** 2) < 1.5  # 12 with all windows


def test_noise_does_not_pass_for_the_bias_towards_halves_of_a_pixel_where_steps_are_whole_pixels():
    frames, places = slide(count=5, step=1.0)
    run = engine.Run(search(contact=None))
    run.push(frames, displacement=places)
    result = run.result()
    error = (result.slip_onset - onset(COLUMN, ROW) * PIXEL)[INSIDE]
    assert np.sqrt(np.nanmean(error**2)) < 0.2 * PIXEL  # 0.4 with the bias of measured displacements
    assert 0.2 < np.nanmean((error / result.slip_onset_sigma[INSIDE]) ** 2) < 2


@pytest.mark.parametrize("contact", ["given", "estimated"])
@pytest.mark.parametrize(("count", "share", "texture"), [(4, 0.35, "flakes"), (10, 0.3, "random-dots")])
def test_onsets_of_short_slides_have_true_sigmas(count, share, texture, contact):
    """``share`` of the distance after which all slides: slip reaches less than a fifth of the radius."""
    press, friction, size = 0.5, 0.5, 144
    path = np.outer(1.5 * friction * press * np.linspace(0, share, count), [1.0, 0.0])
    twin = Twin(
        object=Sphere(10.0),
        shape=(size, size),
        pixel_size=0.03,
        movement=Horizontal(path, press),
        contact="elastic",
        body=Body(friction=friction),
        camera=Camera(noise=1.0, electrons=40.0, point_spread=0.5),
        texture=SheetTexture(texture, size=0.12, contrast=0.9),
    )
    touched = twin.sheet(0).contact
    result = engine.reconstruct(twin, **({"contact": touched} if contact == "given" else {}))
    error = (result.slip_onset - twin.truth.slip_onset)[touched]
    assert 0.2 < np.nanmean((error / result.slip_onset_sigma[touched]) ** 2) < 2
    assert result.contact.sum() == pytest.approx(touched.sum(), rel=0.04)
