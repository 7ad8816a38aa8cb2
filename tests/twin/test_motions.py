"""The twin in all its movements: positions and truth, and reproducible frames."""

from __future__ import annotations

from typing import Any

import contact_theory
import geometry
import numpy as np
import poses
import pytest
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.kernels.device import Device
from mirrorskin.twin import (
    Axial,
    Body,
    Camera,
    Cylinder,
    Horizontal,
    Sphere,
    Twin,
    Twist,
    Vertical,
    design_range,
)
from mirrorskin.twin import twin as twin_module
from mirrorskin.twin.movement import Movement

Frames = NDArray[Any]

SHAPE, PIXEL = (45, 56), 0.16
FLOAT = np.dtype(np.float32)
# A tenth of a turn is no binary number; two turns and a bit.
PHASES = np.arange(23) * 2 * np.pi / 10
TILT, PRESS, APEX = np.radians(2.5), 1.2, (0.0, 0.0, 1.2)

MOVEMENTS: dict[str, Movement] = {
    "vertical": Vertical([0.1, 0.5, 1.0, 1.4, 0.7]),
    "axial": Axial(PHASES, TILT, PRESS, APEX),
    "horizontal": Horizontal([[0.0, 0.0], [0.02, 0.0], [0.3, -0.2], [0.1, 0.1]], PRESS),
    "twist": Twist([0.0, 0.05, 0.2, -0.1], PRESS),
}
# What is worked out again and again.
SHORT: dict[str, Movement] = {
    **MOVEMENTS,
    "vertical": Vertical([0.1, 0.6, 1.4, 0.7]),
    "axial": Axial(np.arange(5) * 2 * np.pi / 3, TILT, PRESS, APEX),
}
BALL = poses.Ball()


def make_twin(movement: Movement | str, **changes: Any) -> Twin:
    movement = MOVEMENTS[movement] if isinstance(movement, str) else movement
    options: dict[str, Any] = {"object": "sphere", "shape": SHAPE, "pixel_size": PIXEL}
    names = ("dtype", "noise", "seed", "exposure", "gain_deviation", "offset_deviation", "electrons")
    names += ("point_spread", "distance")
    camera = {"dtype": FLOAT, "noise": 0.0} | {name: changes.pop(name) for name in names if name in changes}
    return Twin(movement=movement, camera=Camera(**camera), **(options | changes))


def read_all(twin: Twin, size: int = 1000) -> Frames:
    """Read what is left in blocks of this size."""
    frames = []
    while (block := twin.read(np.empty((size, *twin.shape[1:]), twin.dtype))) is not None:
        frames.append(block.frames.copy())
    return np.concatenate(frames)


def book(movement: Movement) -> list[poses.Pose]:
    """Return each frame's pose by the tests' own book."""
    if isinstance(movement, Axial):
        tilt, pivot = movement.tilt, movement.pivot
        return [poses.leaning(phase, tilt, movement.deepest, pivot) for phase in movement.positions]
    if isinstance(movement, Horizontal):
        return [poses.moved_aside(aside, movement.deepest) for aside in movement.positions]
    if isinstance(movement, Twist):
        return [poses.twisted(angle, movement.deepest) for angle in movement.positions]
    return [poses.lowered(travel) for travel in movement.positions]


# What it tells.


def test_headers_contain_the_motion() -> None:
    for name in MOVEMENTS:
        twin = make_twin(name, pixel_size=(0.16, 0.2), dtype=np.uint8)
        header = twin.header
        assert header.motion == twin.motion == name
        assert (
            header.title
            == f"Digital twin, sphere, {name} motion, sheet takes the object's shape, ideal optics"
        )
        assert header.pixel_size == (0.16, 0.2)
        assert header.press == (None if name == "vertical" else PRESS)
        assert (header.tilt, header.pivot) == ((TILT, APEX) if name == "axial" else (None, None))
        assert header.zenith_gain is None
        assert header.zenith_offset is None
        np.testing.assert_array_equal(header.dark, np.full(SHAPE, 16, np.float32))
        np.testing.assert_array_equal(header.bright, np.full(SHAPE, 224, np.float32))
        assert twin.shape == (len(MOVEMENTS[name].positions), *SHAPE)
        assert (twin.travel is None) == (name != "vertical")


def test_exact_references_are_each_pixels_own() -> None:
    twin = make_twin(Vertical([-1.0, 1.4]), noise=0, gain_deviation=0.1)
    dark, bright = twin.header.dark, twin.header.bright
    assert dark is not None
    assert bright is not None
    assert bright.std() == pytest.approx(20.8, rel=0.1)
    frames = read_all(twin)
    np.testing.assert_array_equal(frames[0], dark)
    full = (
        (twin.truth.zenith > np.radians(15))
        & (twin.truth.zenith < np.radians(40))
        & (twin.truth.contact == 1)
    )
    assert full.sum() > 100
    np.testing.assert_allclose(frames[1][full], bright[full], rtol=1e-6)


@pytest.mark.parametrize("name", MOVEMENTS)
def test_blocks_contain_the_position(name: str) -> None:
    movement = MOVEMENTS[name]
    twin = make_twin(name)
    buffer = np.empty((3, *SHAPE), np.float32)
    at = 0
    part = {"vertical": "travel", "axial": "phase", "horizontal": "displacement", "twist": "twist"}
    while (block := twin.read(buffer)) is not None:
        assert block.index == at
        here = slice(at, at + len(block.frames))
        for motion, field in part.items():
            positions = getattr(block, field)
            if motion == name:
                np.testing.assert_array_equal(positions, movement.positions[here])
            else:
                assert positions is None
        np.testing.assert_allclose(block.time, np.arange(*here.indices(1000)) / 30)
        at += len(block.frames)
    assert at == len(movement.positions)


@pytest.mark.parametrize(
    ("name", "contact"),
    [
        ("vertical", "elastic"),
        ("axial", "elastic"),
        ("axial", "conform"),
        ("twist", "conform"),
        ("horizontal", "elastic"),
    ],
)
def test_truth_is_the_object_under_the_upright_body(name: str, contact: str) -> None:
    truth = make_twin(name, contact=contact).truth
    for actual, expected in zip(
        (truth.height, truth.zenith, truth.azimuth), geometry.sphere(SHAPE, PIXEL), strict=True
    ):
        np.testing.assert_allclose(actual, expected, atol=1e-6)
    assert truth.contact.dtype == np.uint8
    assert 0 < truth.contact.sum() < truth.contact.size
    assert (truth.slip is None) == (contact == "conform" or name in ("vertical", "axial"))


def test_truth_under_an_oblique_view_is_of_what_each_pixel_sees() -> None:
    still = Axial([0.0, 1.0], 1e-6, PRESS, (0.0, 0.0, 0.0))
    twin = make_twin(still, distance=70.0)
    truth, sheet = twin.truth, twin.sheet(0)
    sees = truth.contact == 1
    assert 0.1 < sees.mean() < 0.9
    zenith, azimuth = np.arctan(np.hypot(sheet.dz_dx, sheet.dz_dy)), np.arctan2(-sheet.dz_dy, -sheet.dz_dx)
    np.testing.assert_allclose(truth.zenith[sees], zenith[sees], atol=1e-5)
    np.testing.assert_allclose(truth.azimuth[sees], azimuth[sees], atol=1e-4)
    np.testing.assert_allclose(truth.height[sees], sheet.height[sees] - PRESS, atol=1e-4)
    assert np.isnan(truth.zenith[~sheet.contact]).mean() > 0.99
    upright = make_twin(still).truth
    assert np.nanmax(np.abs(truth.zenith - upright.zenith)) > 0.003  # it does matter


@pytest.mark.parametrize(
    ("tilt", "pivot"),
    [(TILT, APEX), (TILT, (0.0, 0.0, 40.0)), (np.radians(12), APEX), (np.radians(12), (1.0, -2.0, 6.0))],
)
def test_contact_of_a_rotation_is_that_in_every_frame(tilt: float, pivot: tuple[float, float, float]) -> None:
    movement = Axial(PHASES[:10], tilt, PRESS, pivot)
    x, y = geometry.pixel_centres(SHAPE, PIXEL)
    touched, clear, once = np.ones(SHAPE, bool), np.ones(SHAPE, bool), np.zeros(SHAPE, bool)
    for pose in book(movement):
        sight = poses.see(BALL, pose, x, y)
        clear &= poses.clear(BALL, pose, x, y, hair=1e-3, edge=0.01)
        touched &= sight.contact
        once |= sight.contact
    actual = make_twin(movement).truth.contact
    np.testing.assert_array_equal(actual[clear], touched[clear])
    assert clear.mean() > 0.9
    assert 50 < touched.sum() < once.sum() - 20


@pytest.mark.parametrize(
    ("name", "contact"),
    [("vertical", "conform"), ("axial", "elastic"), ("horizontal", "conform"), ("twist", "elastic")],
)
def test_a_sheet_asked_for_is_that_of_its_frame(contact: str, name: str) -> None:
    twin = make_twin(SHORT[name], contact=contact, object=Cylinder(10.0, 4.0, 0.3))
    frames = read_all(twin)
    for number in (2, 1):
        sheet = twin.sheet(number)
        zenith = np.arctan(np.hypot(sheet.dz_dx, sheet.dz_dy))
        expected = geometry.light_level(zenith, 16, 224)
        np.testing.assert_allclose(frames[number], expected, atol=1e-3 if contact == "conform" else 0.5)
    assert np.abs(frames[2] - frames[1]).max() > 50
    twin.rewind()
    np.testing.assert_array_equal(read_all(twin), frames)  # asking left no trace


# Frames against the paper.


def test_counts_are_linear_in_the_zenith_of_each_frame() -> None:
    twin = make_twin("axial", pattern="linear")
    gain, offset = twin.header.zenith_gain, twin.header.zenith_offset
    assert gain is not None
    assert offset is not None
    assert gain.shape == offset.shape == SHAPE
    np.testing.assert_allclose(gain, 208 / (np.pi / 4 - np.arctan(17.5 / 40) / 2))
    frames = read_all(twin)
    x, y = geometry.pixel_centres(SHAPE, PIXEL)
    low, high = design_range(Body())
    for frame, pose in zip(frames, book(MOVEMENTS["axial"]), strict=True):
        sight = poses.see(BALL, pose, x, y)
        linear = sight.contact & (sight.zenith > low) & (sight.zenith < high)
        assert linear.sum() > 200
        expected = (offset + gain * sight.zenith)[linear]
        np.testing.assert_allclose(frame[linear], expected, rtol=0, atol=1e-4)
        assert (frame[~sight.contact] == 16).all()


def test_a_rolled_ball_determines_the_nominal_zenith_scale() -> None:
    exact = make_twin("axial", pattern="linear").header
    header = make_twin("axial", pattern="linear", references="ball", gain_deviation=0.1).header
    for scale, expected in zip(
        (header.zenith_gain, header.zenith_offset), (exact.zenith_gain, exact.zenith_offset), strict=True
    ):
        assert scale is not None
        assert scale.shape == ()
        np.testing.assert_allclose(expected, scale)


@pytest.mark.parametrize("references", ["exact", "ball"])
def test_where_brightness_is_not_linear_there_is_no_zenith_scale(references: str) -> None:
    header = make_twin("axial", pattern="linear", optics="cylinder", references=references).header
    assert header.zenith_gain is None
    assert header.zenith_offset is None


def turn(pivot: tuple[float, float, float]) -> tuple[Frames, Frames, NDArray[np.bool_]]:
    """Return the zeniths that the frames of one turn tell, those of eq. 10, and where both should hold."""
    movement = Axial(PHASES[:10], TILT, PRESS, pivot)
    twin = make_twin(movement, pattern="linear")
    assert twin.header.zenith_gain is not None
    zenith = (read_all(twin).astype(float) - twin.header.zenith_offset) / twin.header.zenith_gain
    low, high = design_range(Body())
    good = ((zenith > low) & (zenith < high)).all(axis=0) & (twin.truth.contact == 1)
    surface = geometry.sphere(SHAPE, PIXEL)
    modulation = np.cos(surface.azimuth - movement.positions[:, np.newaxis, np.newaxis])
    cosine = np.cos(surface.zenith) * np.cos(TILT) - np.sin(surface.zenith) * np.sin(TILT) * modulation
    return zenith, np.arccos(cosine), good


def test_equation_10_holds_with_the_pivot_in_the_apex_and_fails_with_it_far_up() -> None:
    zenith, azimuth = geometry.sphere(SHAPE, PIXEL)[1:]
    seen_zenith, expected, good = turn(APEX)
    assert good.sum() > 300
    # What lies deeper than the pivot moves in the picture, and the ball bends: to first order that is
    error = np.abs(seen_zenith - expected)[:, good]
    bend = TILT * (1 / np.cos(zenith) - 1)[good]
    assert (error <= 1.1 * bend + 1e-3).all()
    assert np.median(error) < TILT / 5
    # The paper's estimates over the turn, eq. 16 to 22, hardly feel it.
    turned = -np.tensordot(np.exp(1j * PHASES[:10]), seen_zenith, 1)[good]
    away = np.angle(-turned * np.exp(-1j * azimuth[good]))
    assert np.abs(seen_zenith.mean(axis=0) - zenith)[good].max() < np.radians(0.3)
    assert np.abs(away).max() < np.radians(0.5)

    seen_zenith, expected, good = turn((0.0, 0.0, 40.0))
    assert good.sum() > 50
    assert np.median(np.abs(seen_zenith - expected)[:, good]) > np.radians(5)


def test_what_moves_in_the_picture_is_the_object() -> None:
    # Aside by 5 pixels to the right and 3 up: the picture goes 5 to the left and 3 down.
    still, aside = read_all(make_twin(Horizontal([[0, 0], [5 * PIXEL, 3 * PIXEL]], PRESS)))
    np.testing.assert_allclose(aside[3:, :-5], still[:-3, 5:], atol=1e-3)
    assert np.abs(aside - still).max() > 100
    turned, upright = (
        read_all(make_twin(Twist([angle], PRESS), object="plane", shape=(41, 41)))[0]
        for angle in (np.pi / 2, 0.0)
    )
    # The body turns counter-clockwise, the picture clockwise.
    np.testing.assert_allclose(turned, np.rot90(upright, -1), atol=1e-3)
    assert np.abs(turned - upright).max() > 100


@pytest.mark.parametrize("contact", ["conform", "elastic"])
def test_an_exposure_is_seconds_of_the_time_between_frames(contact: str) -> None:
    travel = [0.4, 0.8, 1.2]

    def shoot(exposure: float, frame_rate: float) -> Frames:
        camera = Camera(FLOAT, 0.0, exposure=exposure, frame_rate=frame_rate)
        twin = Twin(
            object="sphere",
            shape=SHAPE,
            pixel_size=PIXEL,
            movement=Vertical(travel),
            contact="elastic" if contact == "elastic" else "conform",
            camera=camera,
        )
        return read_all(twin)

    blurred = shoot(0.05, 10.0)
    np.testing.assert_array_equal(blurred, shoot(0.0125, 40.0))
    # Half the time between frames: a quarter of the way there and back.
    fine = np.linspace(-0.25, 0.25, 41)[:-1] + 0.5 / 80
    moments = make_twin(Vertical(0.8 + 0.4 * fine), contact=contact)
    expected = read_all(moments).mean(axis=0)
    assert np.abs(blurred[1] - expected).mean() < 0.5
    assert np.abs(blurred[1] - shoot(0.0, 10.0)[1]).mean() > 1.5


# Friction.

RADIUS = 1.6  # of the contact with a ball of 20 mm, mm
HERTZ = contact_theory.sphere(10.0, RADIUS, 1.0)
MU = 0.8
FAR = contact_theory.sliding_distance(HERTZ, MU, 1.0)
FINE = {"object": Sphere(20.0), "contact": "elastic", "shape": (60, 60), "pixel_size": 0.06}


def slip(movement: Movement, **changes: Any) -> NDArray[np.bool_]:
    truth = make_twin(movement, **(FINE | changes)).truth
    assert truth.slip is not None
    assert truth.slip.dtype == np.uint8
    assert set(np.unique(truth.slip)) <= {0, 1}
    return truth.slip.astype(bool)


def pressed() -> NDArray[np.bool_]:
    return make_twin(Vertical([HERTZ.depth]), **FINE).truth.contact.astype(bool)


def aside(*shares: float) -> Horizontal:
    return Horizontal(FAR * np.outer(shares, [0.6, -0.8]), HERTZ.depth)


def test_a_body_that_hardly_moves_sticks_and_one_that_goes_far_slides() -> None:
    contact = pressed()
    assert np.sqrt(contact.sum() / np.pi) * 0.06 == pytest.approx(RADIUS, rel=0.02)
    assert slip(aside(0.0, 0.0, 0.0)).sum() == 0
    hardly = slip(aside(0.0, 0.01))
    assert hardly.sum() < 0.05 * contact.sum()
    np.testing.assert_array_equal(slip(aside(0.5, 1.2)), contact)
    np.testing.assert_array_equal(slip(Horizontal([[FAR, FAR]], HERTZ.depth)), contact)


def test_a_small_field_shows_the_slip_of_the_whole_contact() -> None:
    whole = slip(aside(0.0, 0.6))
    part = slip(aside(0.0, 0.6), shape=(20, 34))
    np.testing.assert_array_equal(part, whole[20:40, 13:47])
    assert 0 < part.sum() < part.size


# A stage that gives way.


def test_a_compliant_stage_shows_the_frames_of_a_smaller_depth() -> None:
    compliance = 0.3
    # Travel that leaves Sneddon's contact of each radius: its depth and what its force lifts the body.
    books = [contact_theory.sphere(10.0, radius, 1.0) for radius in (0.6, 1.1, 1.6)]
    travel = [theory.depth + compliance * theory.force for theory in books]
    depth = [theory.depth for theory in books]
    assert travel[-1] > 1.3 * depth[-1]
    limp = make_twin(Vertical(travel, compliance=compliance), **FINE)
    stiff = make_twin(Vertical(depth), **FINE)
    np.testing.assert_array_equal(limp.travel, travel)
    for k, theory in enumerate(books):
        sheets = limp.sheet(k), stiff.sheet(k)
        np.testing.assert_allclose(sheets[0].height, sheets[1].height, atol=5e-3)
        assert sheets[0].height.max() == pytest.approx(theory.depth, rel=0.02)
    frames, expected = read_all(limp), read_all(stiff)
    assert np.mean(np.abs(frames - expected)) < 0.5
    assert np.mean(np.abs(read_all(make_twin(Vertical(travel), **FINE)) - expected)) > 3
    block = make_twin(Vertical(travel, compliance=compliance), **FINE).read()
    assert block is not None
    np.testing.assert_array_equal(block.travel, travel[:1])  # what the stage was told
    assert limp.truth.contact.sum() == pytest.approx(stiff.truth.contact.sum(), rel=0.03)


# The same frames, however they are read.

ALL = {
    "conform": {"contact": "conform"},
    "conform, blurred": {"contact": "conform", "exposure": 1 / 60},
    "elastic": {"contact": "elastic"},
    "elastic, forgetful": {"contact": "elastic", "memory": 0},
}


@pytest.mark.parametrize(
    ("how", "name"),
    [
        ("conform", "vertical"),
        ("conform, blurred", "axial"),
        ("conform, blurred", "vertical"),
        ("conform", "twist"),
        ("elastic", "horizontal"),
        ("elastic, forgetful", "axial"),
    ],
)
def test_frames_are_the_same_however_they_are_read(
    how: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    options: dict[str, Any] = {"shape": (22, 26), "pixel_size": 0.3, "noise": 1.5} | ALL[how]
    monkeypatch.setattr(twin_module, "_MEMORY", options.pop("memory", twin_module._MEMORY))
    twin = make_twin(SHORT[name], **options)
    whole = read_all(twin)
    assert np.unique(whole.reshape(len(whole), -1), axis=0).shape[0] == len(whole)  # noise, at least
    for size in (1, 3):
        twin.rewind()
        np.testing.assert_array_equal(read_all(twin, size), whole)
    fresh = make_twin(SHORT[name], **options)
    fresh.read(np.empty((2, *fresh.shape[1:]), fresh.dtype))
    contact = fresh.truth.contact  # in between
    np.testing.assert_array_equal(read_all(fresh), whole[2:])
    fresh.rewind()
    fresh.read()
    fresh.rewind()
    np.testing.assert_array_equal(read_all(fresh), whole)
    np.testing.assert_array_equal(make_twin(SHORT[name], **options).truth.contact, contact)


@pytest.mark.parametrize(("name", "contact"), [("vertical", "conform"), ("axial", "elastic")])
def test_frames_passed_over_are_missed_and_the_rest_is_as_ever(contact: str, name: str) -> None:
    whole = read_all(make_twin(SHORT[name], contact=contact))
    twin = make_twin(SHORT[name], contact=contact)
    twin.skip(2)
    block = twin.read()
    assert block is not None
    assert block.index == 2
    np.testing.assert_array_equal(block.frames[0], whole[2])
    np.testing.assert_array_equal(read_all(twin), whole[3:])
    twin.rewind()
    np.testing.assert_array_equal(read_all(twin), whole)
    twin.rewind()
    twin.skip(1000)
    assert twin.read() is None


EVERYTHING: dict[str, Any] = {
    "shape": (20, 24),
    "pixel_size": 0.3,
    "contact": "elastic",
    "optics": "cylinder",
    "body": Body(asymmetry=0.2, air_gap=0.5),
    "dtype": np.uint16,
    "noise": 3.0,
    "electrons": 100.0,
    "gain_deviation": 0.02,
    "exposure": 0.01,
    "point_spread": 0.8,
    "references": "ball",
}


@pytest.mark.parametrize("name", ["vertical", "twist"])
def test_a_seed_gives_one_recording_and_another_seed_another(device: Device, name: str) -> None:
    for options in ({"noise": 1.5, "shape": (24, 30)}, EVERYTHING):
        first, again, other = (
            make_twin(SHORT[name], seed=seed, device=device, **options) for seed in (7, 7, 8)
        )
        frames = read_all(first)
        np.testing.assert_array_equal(read_all(again, 2), frames)
        np.testing.assert_array_equal(again.header.dark, first.header.dark)
        np.testing.assert_array_equal(again.header.bright, first.header.bright)
        for part in ("height", "zenith", "azimuth", "contact", "slip"):
            np.testing.assert_array_equal(getattr(again.truth, part), getattr(first.truth, part))
        another = read_all(other)
        assert (another != frames).mean() > 0.8
        # Noise apart they show the same.
        close = 6 * np.hypot(2 * first._camera.noise, 0.1 * first._camera.bright * 0.5)
        assert np.abs(another.astype(float) - frames).max() < close


# What cannot be.


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"movement": Vertical([1.0, 40.0])},
            "sphere may rise 40 mm into the sensor's body, whose height is 40 mm",
        ),
        ({"pixel_size": 1e3}, "no pixel of 1000 x 1000 mm lies on the sensor.*smaller"),
        ({"movement": Axial([0.0], 0.1, 41.0)}, "rise 42.* mm into .*press less"),
        ({"movement": Twist([0.0], 3.0), "body": Body(height=3.0)}, "rise 3 mm into .* height is 3 mm"),
        ({"movement": Axial([0.0], 0.1, 1.0, (1e3, 0.0, 0.0))}, "rise 10.* mm .*use a nearer pivot"),
        ({"object": Sphere(36.0)}, "sphere is larger than the sensor.*36 mm.*35 mm"),
        ({"movement": Vertical([1.0], compliance=0.1)}, "compliance needs contact 'elastic'"),
        ({"distance": 30.0}, "not above the body"),
        ({"contact": "glue"}, "contact 'glue' is unknown: take conform, elastic"),
        ({"optics": "real"}, "optics 'real' is unknown: take ideal, cylinder"),
        ({"references": "guess"}, "references 'guess' is unknown: take exact, ball"),
        ({"pattern": "dots"}, "pattern 'dots' is unknown: take uniform, linear"),
        ({"pattern": "missing.png"}, "missing.png"),
        ({"body": Body(air_gap=1.0)}, "air gap.*cylinder"),
        ({"shape": (20_000, 20_000)}, "too large"),
        ({"contact": "elastic", "pixel_size": 0.001}, "points.*conform"),
    ],
)
def test_impossible_input_is_refused_in_one_line(changes: dict[str, Any], words: str) -> None:
    options: dict[str, Any] = {"movement": Vertical([1.0]), **changes}
    with pytest.raises(InputError, match=words) as caught:
        make_twin(options.pop("movement"), **options)
    assert "\n" not in str(caught.value)
