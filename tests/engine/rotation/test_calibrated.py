"""Rotations under a calibrated wall: the twin's counts, and normals by its true response."""

import math
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
import walls
from stacks import MadeUp

from mirrorskin import engine, io
from mirrorskin.engine.diagnosis.registration import Registered, Sight
from mirrorskin.engine.live import LiveRun
from mirrorskin.engine.rotation.rotation import first_turn
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT
from mirrorskin.twin import Axial, Body, Camera, Twin

SHAPE, PIXEL, PRESS = (68, 71), 0.085, 0.7
PIVOT = (0.3, -0.2, 4.0)
BODY = Body(asymmetry=0.05, asymmetry_azimuth=0.7)
DISTANCE = 150.0


class Ball:
    """A ball of 5 mm beside the axis."""

    name, radius, at, size = "ball", 4.0, (0.9, -0.7), 2.5

    def height(self, x, y, /):
        return self._rise(x, y) - self.size

    def slope(self, x, y, /):
        rise = self._rise(x, y)
        return (self.at[0] - x) / rise, (self.at[1] - y) / rise

    def _rise(self, x, y):
        square = self.size**2 - (x - self.at[0]) ** 2 - (y - self.at[1]) ** 2
        return np.sqrt(np.where(square > 0, square, np.nan))


class Frames(MadeUp):
    """Frames in memory, which may be read again if that is said."""

    def __init__(self, frames, phase, header, rewindable=True):
        super().__init__(frames, header, phase=phase)
        self.phase, self.rewindable = phase, rewindable

    def rewind(self):
        self.frames_read = 0


class Scene(NamedTuple):
    frames: np.ndarray
    header: io.Header
    truth: io.Truth
    calibration: io.Calibration

    def source(self, turns=1, rewindable=True, calibration=None, **header):
        frames = np.concatenate([self.frames] * turns)
        phase = np.concatenate([np.array(EIGHTHS) + 2 * np.pi * turn for turn in range(turns)])
        source = Frames(frames, phase, replace(self.header, **header), rewindable)
        return io.Calibrated(source, calibration or self.calibration)

    def errors(self, result):
        """Return errors in contact: of zeniths, degrees, and of directions, in standard errors."""
        true = rotations.direction(self.truth.zenith, self.truth.azimuth)
        good = (result.contact > 0) & (np.degrees(self.truth.zenith) < 42)
        assert good.sum() > 600
        zenith = np.degrees(result.zenith - self.truth.zenith)[good]
        angle = rotations.between(result.normals.astype(float), true)[good]
        return zenith, angle / result.normals_sigma[good]


@cache
def scene():
    twin = Twin(
        object=Ball(),
        shape=SHAPE,
        pixel_size=PIXEL,
        movement=Axial(np.array(EIGHTHS), TILT, PRESS, PIVOT),
        optics="cylinder",
        pattern="linear",
        body=BODY,
        camera=Camera(noise=1.0, seed=5, distance=DISTANCE, gain_deviation=0.05),
    )
    frames = np.empty(twin.shape, np.uint8)
    twin.read(frames)
    nothing = np.zeros(SHAPE, np.float32)
    levels = (
        np.broadcast_to(level, SHAPE).astype(np.float32) for level in (twin.header.dark, twin.header.bright)
    )
    calibration = io.Calibration(
        io.CameraId("", SHAPE, np.dtype(np.uint8)),
        io.References(*levels, nothing, nothing, nothing.astype(np.uint8)),
        zenith=walls.response_of_twin(SHAPE, PIXEL, BODY, DISTANCE),
    )
    return Scene(frames, twin.header, twin.truth, calibration)


@cache
def plain():
    return engine.reconstruct(scene().source())


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_normals_are_as_good_as_the_noise_lets_them_be():
    result = plain()
    zenith, ratio = scene().errors(result)
    assert abs(zenith.mean()) < 0.04
    assert rms(ratio) == pytest.approx(1, abs=0.08)
    assert result.process["zenith"] == "calibrated"
    assert result.process["heights"] == "found in the first turn"
    assert result.process["registered"] is True
    assert result.process["zenith_error"] == pytest.approx(0.002)
    height, true = result.height[result.contact > 0], scene().truth.height[result.contact > 0]
    assert rms(height - height.mean() - (true - true.mean())) < 0.004


def test_heights_that_are_given_do_as_well():
    result = engine.reconstruct(scene().source(), heights=scene().truth.height)
    zenith, ratio = scene().errors(result)
    assert abs(zenith.mean()) < 0.03
    assert rms(ratio) == pytest.approx(1, abs=0.08)
    assert result.process["heights"] == "given"


def test_a_source_that_cannot_be_read_twice_is_assumed_at_half_the_press():
    result = engine.reconstruct(scene().source(rewindable=False))
    zenith, _ = scene().errors(result)
    assert 0.1 < rms(zenith) < 0.5
    assert result.process["heights"].startswith("half the press")
    assert result.process["registered"] is True


def test_without_a_pivot_frames_are_not_registered_but_heights_are_found():
    result = engine.reconstruct(scene().source(pivot=None))
    assert np.isfinite(result.zenith).sum() > 700
    assert result.process["registered"] is False
    assert result.process["heights"] == "found in the first turn"


def test_what_the_calibration_is_wrong_by_counts_in_the_errors_that_are_reported():
    wall = walls.response_of_twin(SHAPE, PIXEL, BODY, DISTANCE, sigma=(0.003, 0.004))
    calibrated = replace(scene().calibration, zenith=wall)
    doubtful = engine.reconstruct(scene().source(calibration=calibrated)).normals_sigma
    np.testing.assert_allclose(doubtful, np.sqrt(plain().normals_sigma ** 2 + 0.005**2), rtol=1e-5)


@pytest.mark.parametrize("missing", ["pixel_size", "press"])
def test_a_recording_without_lines_of_sight_is_refused(missing):
    with pytest.raises(io.InputError, match=f"has no {missing.replace('_', ' ')}"):
        engine.reconstruct(scene().source(**{missing: None}))


def test_a_uniform_pattern_leaves_the_wave_alone():
    wall = replace(scene().calibration.zenith, pattern="uniform")
    calibrated = replace(scene().calibration, zenith=wall)
    result = engine.reconstruct(scene().source(calibration=calibrated))
    assert result.normals is None
    assert result.mean is not None


def test_live_normals_are_those_of_the_calibration():
    source = scene().source()
    live = LiveRun(source, engine.Rotation(window_frames=8, noise=1.05))
    live.push_block(source.read(np.empty_like(scene().frames)))
    assert np.isfinite(live.maps()["normals"]).any()
    result = live.result()
    # The pivot is far from the ball, and live frames are not registered: this is no measure of errors.
    whole = engine.reconstruct(scene().source(pivot=None), noise=1.05)
    both = (result.contact > 0) & (whole.contact > 0)
    assert both.sum() > 50
    assert np.median(np.degrees(np.abs(result.zenith - whole.zenith))[both]) < 0.1
    assert result.process["zenith"] == "calibrated"


def test_the_first_turn_ends_before_the_second_begins():
    turn = first_turn(scene().source(turns=3))
    np.testing.assert_array_equal(turn.phase, EIGHTHS)
    assert turn.shape == (8, *SHAPE)
    for _ in range(2):
        turn.rewind()
        blocks = [turn.read(np.empty((3, *SHAPE), np.uint8)) for _ in range(3)]
        assert turn.read() is None
        np.testing.assert_array_equal(np.concatenate([block.frames for block in blocks]), scene().frames)
        assert [block.index for block in blocks] == [0, 3, 6]


def test_registered_frames_follow_points_that_an_oblique_camera_sees():
    # A frame that counts its own columns and rows tells where each sample is from.
    shape, pixel, lean, axis = (41, 61), 0.2, 0.006, (0.5, -0.4)
    tilt, press, pivot, phase = math.radians(3), 0.8, (1.0, -2.0, 6.0), 0.7
    header = io.Header("axial", pixel_size=(pixel, pixel), tilt=tilt, press=press, pivot=pivot)
    row, column = np.indices(shape).astype(np.float32)
    height = -0.5 * np.random.default_rng(0).random(shape)
    x, y = (column - 30) * pixel, (20 - row) * pixel
    out = np.stack([x - axis[0], y - axis[1]])
    point = np.stack([*(np.stack([x, y]) - lean * (height + press) * out), height + press]).reshape(3, -1)
    turn = walls.about_z(phase) @ walls.about_y(tilt) @ walls.about_z(-phase)
    centre = np.array(pivot)[:, np.newaxis]
    new = centre + turn @ (point - centre)
    place = np.array(axis)[:, np.newaxis] + (new[:2] - np.array(axis)[:, np.newaxis]) / (1 - lean * new[2])
    for frame, expected in ((column, place[0] / pixel + 30), (row, 20 - place[1] / pixel)):
        source = Frames(frame[np.newaxis], np.array([phase]), header)
        registered = Registered(source, height, sight=Sight(lean, axis)).read().frames[0]
        good = np.isfinite(registered)
        assert good.mean() > 0.6
        np.testing.assert_allclose(registered[good], expected.reshape(shape)[good], atol=0.01)  # of a pixel
        plain = Registered(source := Frames(frame[np.newaxis], source.phase, header), height).read().frames[0]
        assert np.nanmax(np.abs(plain - expected.reshape(shape))) > 0.03
