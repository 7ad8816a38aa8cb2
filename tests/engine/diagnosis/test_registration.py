"""Registered frames: places of the object's points, eq. 10 there, and no invented values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import poses
import pytest
from stacks import MadeUp, read_all

from mirrorskin import io
from mirrorskin.engine.diagnosis.registration import Registered
from mirrorskin.twin import Axial, Body, Camera, Twin

TILT, PRESS = np.radians(2.5), 1.2
# Uneven, out of order, and more than a turn.
PHASES = np.array([0.0, 0.9, 2.2, 8.0, -1.2, 4.1])
SHAPE, PIXEL_SIZE = (23, 31), (0.11, 0.13)
PIVOTS = {
    "centre": (0.0, 0.0, 0.0),
    "apex": (0.0, 0.0, PRESS),
    "40 mm up": (0.0, 0.0, 40.0),
    "off the axis": (3.0, -2.0, 10.0),
}
HEADER = io.Header("axial", pixel_size=PIXEL_SIZE, tilt=TILT, press=PRESS, pivot=PIVOTS["off the axis"])


def some_heights(shape=SHAPE, seed=0):
    return np.random.default_rng(seed).uniform(-PRESS, 0, shape).astype(np.float32)


def made_up(frames, header=HEADER, phase=PHASES):
    return MadeUp(frames, header, phase=np.asarray(phase)[: len(frames)])


def places(header, heights, phase):
    """Where the points of the mean pose are at a phase: columns, rows and mm above the sheet's plane."""
    along_x, along_y = header.pixel_size
    rows, columns = heights.shape
    row, column = np.indices(heights.shape)
    x, y = (column - (columns - 1) / 2) * along_x, ((rows - 1) / 2 - row) * along_y
    pose = poses.leaning(phase, header.tilt, header.press, header.pivot)
    body = pose.to_body(np.stack([x, y, heights.astype(float)], axis=-1))
    return body[..., 0] / along_x + (columns - 1) / 2, (rows - 1) / 2 - body[..., 1] / along_y, body[..., 2]


def usable(column, row, fine):
    """Whether all 16 samples round a place are there and fine: one by one."""
    usable_samples = np.zeros(column.shape, bool)
    rows, columns = fine.shape
    for pixel in np.ndindex(column.shape):
        if np.isfinite(column[pixel]):
            west, north = int(np.floor(column[pixel])), int(np.floor(row[pixel]))
            if 1 <= west < columns - 2 and 1 <= north < rows - 2:
                usable_samples[pixel] = fine[north - 1 : north + 3, west - 1 : west + 3].all()
    return usable_samples


def register(source, heights, device=None):
    return read_all(Registered(source, heights, device=device), 4).frames


def ramp(shape=SHAPE):
    """Frames whose brightness is a straight line along rows and columns, which any interpolation keeps."""
    row, column = np.indices(shape, float)
    return np.stack([50 + 3 * column + 2 * row + frame for frame in range(len(PHASES))]).astype(np.float32)


@pytest.mark.parametrize("pivot", ["40 mm up", "off the axis"])
def test_each_pixel_sees_where_its_point_has_gone(device, pivot):
    header, heights = replace(HEADER, pivot=PIVOTS[pivot]), some_heights()
    registered = register(made_up(ramp(), header), heights, device)
    for number, (frame, phase) in enumerate(zip(registered, PHASES, strict=True)):
        column, row, _ = places(header, heights, phase)
        expected_usable = usable(column, row, np.ones(SHAPE, bool))
        assert expected_usable.sum() > (30 if pivot == "40 mm up" else 300)
        np.testing.assert_array_equal(np.isfinite(frame), expected_usable)
        expected = 50 + 3 * column + 2 * row + number
        np.testing.assert_allclose(frame[expected_usable], expected[expected_usable], atol=1e-3)


@pytest.mark.parametrize(("name", "pivot"), [("sphere", "40 mm up"), ("cone", "off the axis")])
def test_equation_10_holds_for_the_normal_of_the_mean_pose(name, pivot):
    # A wall so high that brightness is linear from zenith 0 to 45 degrees.
    twin = Twin(
        object=name,
        shape=(61, 71),
        pixel_size=0.05,
        movement=Axial(PHASES, TILT, PRESS, PIVOTS[pivot]),
        pattern="linear",
        body=Body(height=1e7, scatter=0.0),
        camera=Camera(dtype=np.float32, noise=0.0),
    )
    header, truth = twin.header, twin.truth
    zenith, azimuth = truth.zenith.astype(float), np.nan_to_num(truth.azimuth.astype(float))
    level = np.sin(zenith)
    facing = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.cos(zenith)], axis=-1)
    registered = register(twin, truth.height)
    twin.rewind()
    raw = read_all(twin, 6).frames
    checked, away = 0, np.hypot(*np.meshgrid(*io.pixel_axes((61, 71), twin.header.pixel_size)))
    for phase, frame, before in zip(PHASES, registered, raw, strict=True):
        axis = np.array([-np.sin(TILT) * np.cos(phase), -np.sin(TILT) * np.sin(phase), np.cos(TILT)])
        expected = poses.between(facing, np.broadcast_to(axis, facing.shape))
        corrected, untold = (
            np.abs((counts - header.zenith_offset) / header.zenith_gain - expected)
            for counts in (frame, before)
        )
        # Not where a kink of the brightness is near: where the sheet faces the camera, and where it ends.
        smooth = np.isfinite(corrected) & (truth.zenith > 2 * TILT) & (away > 0.4)
        smooth &= places(header, truth.height, phase)[2] > 0.15
        checked += smooth.sum()
        assert corrected[smooth].max(initial=0) < np.radians(0.002)
        if pivot == "40 mm up" and name == "sphere":
            assert np.median(untold[smooth]) > np.radians(5)
    assert checked > 0.2 * registered.size


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_samples_made_of_what_is_clipped_or_missing_are_missing(device, dtype):
    generator, kind = np.random.default_rng(3), np.dtype(dtype)
    frames = generator.uniform(20, 200, (6, *SHAPE)).astype(kind)
    ends = [np.nan, np.inf] if kind.kind == "f" else [0, np.iinfo(kind).max]
    spots = generator.random(frames.shape)
    frames[spots < 0.004], frames[spots > 0.996] = ends
    heights = some_heights()
    heights[5:8, 11] = np.nan
    registered = register(made_up(frames), heights, device)
    for phase, frame, raw in zip(PHASES, registered, frames, strict=True):
        fine = np.isfinite(raw) if kind.kind == "f" else (raw > 0) & (raw < np.iinfo(kind).max)
        assert not fine.all()
        expected_usable = usable(*places(HEADER, heights, phase)[:2], fine)
        assert expected_usable.any()
        np.testing.assert_array_equal(np.isfinite(frame), expected_usable)


def test_counts_come_on_the_scale_of_the_pixel_that_they_come_to(device):
    generator = np.random.default_rng(4)
    offset, gain = generator.uniform(10, 30, SHAPE), generator.uniform(200, 300, SHAPE)
    gain[3, 4], gain[20, 20] = 0, np.nan
    header, heights = replace(HEADER, zenith_offset=offset, zenith_gain=gain), some_heights()
    alike = register(made_up(ramp()), heights, device)
    with np.errstate(invalid="ignore"):
        registered = register(made_up((offset + gain * ramp()).astype(np.float32), header), heights, device)
        np.testing.assert_allclose(
            (registered - offset) / gain, np.where(np.isnan(registered), np.nan, alike), rtol=1e-5
        )
    lost = np.isfinite(alike) & np.isnan(registered)
    assert set(zip(*np.nonzero(lost)[1:], strict=True)) == {(3, 4), (20, 20)}
    constant = replace(HEADER, zenith_offset=np.full(SHAPE, 16.0), zenith_gain=np.full(SHAPE, 250.0))
    np.testing.assert_array_equal(register(made_up(ramp(), constant), heights, device), alike)


LONE, CORNER = [(4, 20), (10, 12)], [(15, 5), (16, 5), (15, 6)]
BLOCK = [(row, column) for row in (8, 9, 10) for column in (21, 22, 23)]


@pytest.mark.parametrize(("places", "mended"), [([*LONE, *CORNER], True), (BLOCK, False)])
def test_a_pixel_without_a_scale_counts_as_those_on_opposite_sides_of_it(device, places, mended):
    gain = np.full(SHAPE, 250.0)
    gain[tuple(np.transpose(places))] = np.nan
    header, heights = replace(HEADER, zenith_offset=np.full(SHAPE, 16.0), zenith_gain=gain), some_heights()
    counts = 16 + np.float32(250) * ramp()
    fractions = (register(made_up(counts, header), heights, device) - 16) / 250
    alike = register(made_up(ramp()), heights, device)
    np.testing.assert_allclose(fractions, np.where(np.isnan(fractions), np.nan, alike), rtol=1e-5)
    lost = (np.isfinite(alike) & np.isnan(fractions)).any(axis=0)
    assert lost[tuple(np.transpose(places))].all()
    assert lost.sum() == len(places) if mended else lost.sum() > 2 * len(places)


def test_blocks_make_no_difference(device, monkeypatch):
    frames = np.random.default_rng(5).uniform(1, 250, (6, *SHAPE)).astype(np.uint8)
    answers = []
    for length in (1, 4, 9):
        source = Registered(made_up(frames), some_heights(), device=device)
        read = read_all(source, length)
        np.testing.assert_array_equal(read.phase, PHASES)
        answers.append((read.frames, source.noise_gain))
    again = made_up(frames)
    again.rewind = lambda: setattr(again, "frames_read", 0)
    source = Registered(again, some_heights(), device=device)
    source.read()
    source.rewind()
    assert np.isnan(source.noise_gain).all()
    answers.append((read_all(source, 2).frames, source.noise_gain))
    monkeypatch.setattr("mirrorskin.engine.diagnosis.registration._BLOCK", 2 * frames[0].nbytes)
    small = Registered(made_up(frames), some_heights(), device=device)
    assert len(small.read(np.empty((6, *SHAPE), np.float32)).frames) == 2
    with pytest.raises(ValueError, match="needed is"):
        small.read(np.empty((2, *SHAPE)))
    for registered, gain in answers:
        assert registered.tobytes() == answers[0][0].tobytes()
        assert gain.tobytes() == answers[0][1].tobytes()


def test_the_noise_gain_is_that_of_noise():
    turns = 100
    phase = np.tile(PHASES, turns)
    noise = np.random.default_rng(6).normal(0, 2.0, (len(phase), 9, 12)).astype(np.float32)
    header = replace(HEADER, pivot=PIVOTS["centre"])
    source = Registered(made_up(noise + 100, header, phase), some_heights((9, 12)))
    errors = read_all(source, 32).frames - 100
    finite = np.isfinite(errors)
    counted = finite.sum(axis=0)
    measured = np.sqrt(np.nansum(errors**2, axis=0) / np.where(counted, counted, np.nan)) / 2.0
    gain = source.noise_gain
    np.testing.assert_array_equal(np.isnan(gain), counted == 0)
    some = counted == len(phase)
    assert some.sum() > 20
    assert np.ptp(gain[some]) > 0.05
    # The deviation of an estimate from n samples is 1 / sqrt(2 n) of it.
    assert np.abs(measured / gain - 1)[some].max() < 4.5 / np.sqrt(2 * len(phase))
    assert gain[some].min() >= 0.64 - 1e-6
    assert gain[some].max() <= 1


def test_it_is_a_source_like_its_own():
    original = made_up(ramp())
    original.phase = PHASES
    source = Registered(original, some_heights())
    assert (source.name, source.shape, source.motion, source.header) == (
        original.name,
        original.shape,
        "axial",
        HEADER,
    )
    assert (source.dtype, source.rewindable) == (np.float32, False)
    assert source.phase is PHASES
    with source as entered:
        block = entered.read()
    assert (block.index, block.phase, block.stays_valid) == (0, [0.0], False)
    assert original.left


BAD: dict[str, tuple[dict[str, Any], Any, str]] = {
    "vertical": ({"motion": "vertical"}, None, "has vertical motion: only axial ones"),
    "no pixel size": ({"pixel_size": None}, None, "has no pixel size"),
    "no pivot": ({"pivot": None}, None, "has no pivot"),
    "tilt is NaN": ({"tilt": np.nan}, None, "tilt is nan"),
    "pivot is infinite": ({"pivot": (0.0, np.inf, 0.0)}, None, "pivot is .*inf"),
    "another size": ({}, np.zeros((23, 30)), r"shape \(23, 30\), the frames are 23 x 31"),
    "all unknown": ({}, np.full(SHAPE, np.nan), "no height is a number"),
    "not numbers": ({}, np.full(SHAPE, "high"), "heights are of type <U4"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_registered_is_refused_in_one_line(case):
    changes, heights, message = BAD[case]
    source = made_up(ramp(), replace(HEADER, **changes))
    with pytest.raises(io.InputError, match=message) as refusal:
        Registered(source, some_heights() if heights is None else heights)
    assert "\n" not in str(refusal.value)
    with pytest.raises(io.InputError, match="made up: the phase of frames from 0 on is missing"):
        Registered(MadeUp(ramp(), HEADER), some_heights()).read()
