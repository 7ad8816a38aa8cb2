"""Growth of contact in a dithering press, compared with Hertz, the twin in steps, and known noise."""

from __future__ import annotations

import contact_theory
import numpy as np
import pytest
from bare import bare
from commands import run
from scipy import optimize

from mirrorskin import engine, io
from mirrorskin.engine.vibration.lock_in import LockIn
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.twin import Camera, Twin, Vertical

RADIUS, DEPTH, SWING = 5.0, 1.0, 0.05
DITHER = DEPTH + SWING * np.cos(2 * np.pi / 7.3 * np.arange(110))
SIZE, PIXEL = 96, 0.06


def test_a_disc_grows_as_in_hertz_theory():
    """A paraboloid's contact has the radius a = sqrt(R s): dA/ds = pi R, and da/ds = sqrt(R / s) / 2."""
    x, y = io.pixel_axes((SIZE, SIZE), (PIXEL, PIXEL))
    square = x**2 + y[:, np.newaxis] ** 2
    frames = np.where(square <= RADIUS * DITHER[:, np.newaxis, np.newaxis], 220, 20).astype(np.uint8)
    growth = engine.vibration.find_growth(frames, DITHER, dark=20, bright=220, pixel_size=(PIXEL, PIXEL))
    assert (growth.process["travel"], growth.process["travel_amplitude"]) == pytest.approx(
        (DEPTH, SWING), rel=1e-3
    )
    assert growth.process["area_growth"] == pytest.approx(np.pi * RADIUS, rel=0.02)
    border = growth.process["area_growth"] / (2 * np.pi * np.sqrt(RADIUS * DEPTH))
    assert border == pytest.approx(np.sqrt(RADIUS / DEPTH) / 2, rel=0.02)
    ring = np.abs(np.sqrt(square) - np.sqrt(RADIUS * DEPTH)) < 0.5 * SWING
    assert growth.growth[ring].mean() > 2
    assert np.abs(growth.growth[square < 4]).max() < 1e-4


@pytest.fixture(scope="module")
def elastic():
    return Twin(
        object="sphere",
        shape=(SIZE, SIZE),
        pixel_size=PIXEL,
        movement=Vertical(DITHER),
        contact="elastic",
        camera=Camera(np.uint16, noise=12.0, seed=3),
        references="exact",
    )


def light_border(depth, slope):
    """Where the surface around a ball pressed so deep has a slope, mm from the axis."""
    contact = optimize.brentq(lambda a: contact_theory.sphere(RADIUS, a, 1.0).depth - depth, 0.5, 4)
    ball = contact_theory.sphere(RADIUS, contact, 1.0)

    def steepness(r):
        near = ball.surface(np.array([r - 1e-3, r + 1e-3]))
        return (near[0] - near[1]) / 2e-3 - slope

    return optimize.brentq(steepness, contact + 2e-3, 2 * contact)


def test_the_light_of_the_elastic_twin_grows_as_the_surface_around_a_ball(elastic):
    frames = elastic.read(np.empty(elastic.shape, elastic.dtype)).frames
    dark, bright = elastic.header.dark, elastic.header.bright
    options = {"dark": dark, "bright": bright, "pixel_size": (PIXEL, PIXEL)}
    growth = engine.vibration.find_growth(frames, DITHER, **options)
    light = np.sum((frames.astype(float) - dark) / (bright - dark), axis=(1, 2)) * PIXEL**2
    assert growth.process["area_growth"] == pytest.approx(np.polyfit(DITHER - DEPTH, light, 2)[1], rel=0.01)
    # Half the light is at the slope of the inner border, which lies on the ball itself.
    profile = (frames.mean(axis=0) - dark)[SIZE // 2, SIZE // 2 :] / (bright - dark)[0, 0]
    inner = PIXEL * (np.interp(0.5, profile[10:25], np.arange(10, 25)) + 0.5)
    slope = inner / np.sqrt(RADIUS**2 - inner**2)
    step = 0.01
    areas = [np.pi * light_border(DEPTH + sign * step, slope) ** 2 for sign in (-1, 1)]
    assert growth.process["area_growth"] == pytest.approx((areas[1] - areas[0]) / (2 * step), rel=0.03)


def test_sigma_matches_the_scatter():
    random = np.random.default_rng(3)
    steep = random.uniform(0.2, 3, (60, 70))
    counts = 100 + 200 * steep * (DITHER - DEPTH)[:, np.newaxis, np.newaxis]
    frames = (counts + random.normal(0, 4, counts.shape)).astype(np.float32)
    growth = engine.vibration.find_growth(frames, DITHER, dark=0, bright=200, pixel_size=(0.1, 0.1))
    error = growth.growth - steep
    assert np.mean((error / growth.growth_sigma) ** 2) == pytest.approx(1, abs=0.06)
    assert abs(growth.process["area_growth"] - 0.01 * steep.sum()) < 4 * growth.process["area_growth_sigma"]
    assert abs(error.mean()) < 4 * growth.growth_sigma.mean() / np.sqrt(error.size)


def test_the_command_adds_it_to_the_correlation(elastic, tmp_path):
    elastic.rewind()
    with io.Recorder(elastic, tmp_path / "d.h5") as recorder:
        recorder.drain(lambda count: None)
    ended = run("correlate", tmp_path / "d.h5", "--dither", "-o", tmp_path / "r.h5")
    assert ended.code == 0, ended.said
    result = io.open_result(tmp_path / "r.h5")
    elastic.rewind()
    frames = elastic.read(np.empty(elastic.shape, elastic.dtype)).frames
    header = elastic.header
    growth = engine.vibration.find_growth(
        frames, DITHER, dark=header.dark, bright=header.bright, pixel_size=(PIXEL, PIXEL)
    )
    np.testing.assert_allclose(result.growth, growth.growth, atol=1e-3)
    assert result.process["area_growth"] == pytest.approx(growth.process["area_growth"], rel=1e-4)
    refused = run("correlate", tmp_path / "d.h5", "--dither", "--phase-step", "45deg")
    assert refused.code == 2
    assert "--dither takes the phases from the travel" in refused.said


@pytest.mark.parametrize(
    ("travel", "line"),
    [
        (np.linspace(0, 1, 40), "travel does not dither about a mean"),
        (np.ones(40), "travel does not dither about a mean"),
        (np.ones(5), "travel does not dither about a mean: 5 frames"),
    ],
)
def test_a_travel_that_is_not_a_dither_is_one_line(travel, line):
    frames = np.zeros((len(travel), 2, 3), np.uint8)
    with pytest.raises(io.InputError, match=line) as caught:
        engine.vibration.find_growth(frames, travel)
    assert "\n" not in str(caught.value)


def test_the_frames_are_read_once_if_the_travel_is_known_and_twice_otherwise(elastic):
    elastic.rewind()
    frames = elastic.read(np.empty(elastic.shape, elastic.dtype)).frames.copy()
    levels = {"dark": elastic.header.dark, "bright": elastic.header.bright, "pixel_size": (PIXEL, PIXEL)}
    growth = engine.vibration.find_growth(frames, DITHER, **levels)
    source = ArrayRecording(frames, {"travel": DITHER}, {"dark": levels["dark"], "bright": levels["bright"]})
    operation = engine.vibration.Growth().configured_for(source)
    assert (operation.passes, engine.vibration.Growth(**levels).passes) == (1, 2)
    once = engine.run(source, engine.vibration.Growth(pixel_size=(PIXEL, PIXEL)))
    blocks = bare(engine.vibration.Growth(**levels), frames, [3, 50], travel=DITHER)
    for other in (once, blocks):
        for name in ("growth", "growth_sigma", "azimuth", "residual"):
            np.testing.assert_array_equal(other[name], growth[name])
        assert other.process["area_growth"] == growth.process["area_growth"]
    with pytest.raises(io.InputError, match="needs all frames twice"):
        engine.Run(engine.vibration.Growth(**levels)).push(frames, travel=DITHER)


def test_a_recording_of_a_dither_has_growth_and_correlation(elastic, tmp_path):
    elastic.rewind()
    with io.Recorder(elastic, tmp_path / "d.h5") as recorder:
        recorder.drain(lambda count: None)
    with io.open_recording(tmp_path / "d.h5") as recording:
        result = LockIn(dither=True).run(recording)
        alone = engine.run(recording, engine.vibration.Growth)
        with pytest.raises(io.InputError, match="takes the phase from the travel: leave harmonic out"):
            LockIn(dither=True, harmonic=2).run(recording)
    message = {
        "method": "correlation",
        "zenith": "none: the recording has no zenith gain",
        "frames": len(DITHER),
    }
    assert {name: result.process[name] for name in message} == message
    assert result.process["area_growth"] == alone.process["area_growth"]
    assert set(result) == {
        *("growth", "growth_sigma", "azimuth", "mean", "cosine", "sine", "modulation", "residual")
    }
    np.testing.assert_array_equal(result.growth, alone.growth)
