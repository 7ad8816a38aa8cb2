"""Brightness that has changed since the calibration is stated, and reported where it is clear."""

from contextlib import nullcontext

import numpy as np
import pytest
from live_frames import paced

from mirrorskin import engine, io
from mirrorskin.engine.calibration import fit_zenith, measure_references
from mirrorskin.engine.live import LiveRun
from mirrorskin.engine.metrology import table
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.calibration import fisher, scorer
from mirrorskin.evaluation.calibration.scenes import BALL, Lab, nine_balls, press_for
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.io.files.arrays import ArrayRecording

COUNT, DARK, PIXEL = 12, 20.0, fisher.PIXEL
PHASE = np.arange(COUNT) * 2 * np.pi / COUNT
SETUP = rotations.Setup(noise=1.0, offset=DARK, dtype="float32", phase=tuple(PHASE))
TEXTURED = [fisher.OBJECTS[name](*fisher.axes()) for name in ("rough", "woven", "dimpled", "knurled")]
CHARACTERISED = {"zenith_gain_sigma": 0.003, "tilt_sigma": 0.003, "gamma_sigma": 0.005}
X, Y = np.meshgrid(np.linspace(-1, 1, fisher.SHAPE[1]), np.linspace(1, -1, fisher.SHAPE[0]))
TO_RIM = (X**2 + Y**2 - 2 / 3) * 3 / 4


def turn(height, light=1.0, seed=1, **stated):
    """Return a turn in light that has changed by a factor, a number or a map."""
    down, right = np.gradient(height, PIXEL)
    normals = np.stack([-right, down, np.ones_like(height)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    counts = DARK + light * (rotations.levels(normals, SETUP) - DARK)
    counts = np.rint(counts + np.random.default_rng(seed).normal(0, SETUP.noise, counts.shape))
    header = {"tilt": SETUP.tilt, "zenith_gain": SETUP.slope, "zenith_offset": DARK, "dark": np.float32(DARK)}
    frames = counts.clip(0, 255).astype(np.uint8)
    return ArrayRecording(frames, {"phase": PHASE}, header | {"pixel_size": (PIXEL, PIXEL)} | stated)


def quietly(recording):
    """Return the result of a recording whose warnings are not of interest."""
    with pytest.warns(match="brightness"):
        return engine.reconstruct(recording)


def aged(numbers, loss):
    """Yield results of a sensor that loses brightness from recording to recording."""
    for number in numbers:
        yield engine.reconstruct(turn(TEXTURED[number % 4], 1 - loss * number, seed=number))


def changes(results):
    return np.array([result.fitted.light_change[0] for result in results])


@pytest.mark.parametrize("height", TEXTURED)
def test_a_change_of_brightness_is_stated(height):
    result = engine.reconstruct(turn(height, 0.96))
    assert result.fitted.light_change[0] == pytest.approx(-0.04, abs=0.005)


def test_a_clear_change_is_a_warning():
    result = quietly(turn(TEXTURED[0], 0.9))
    assert result.process["warnings"].startswith("brightness is lower by ")


def test_a_characterised_sensor_shows_a_smaller_change():
    result = quietly(turn(TEXTURED[0], 0.96, **CHARACTERISED))
    assert "than the stated zenith gain and tilt predict: check both" in result.process["warnings"]


def test_a_change_of_a_calibrated_sensor_is_one_since_the_calibration():
    recording = turn(TEXTURED[0], 0.96, tilt_sigma=0.003)
    shape = recording.shape[1:]
    maps = (np.full(shape, counts, np.float32) for counts in (SETUP.slope, DARK))
    sigma = {"gain": 0.003 * SETUP.slope, "offset": 0.1, "gamma": 0.005}
    response = io.LinearResponse(
        *maps, 1.0, ("gain",), np.zeros(1), np.eye(1), np.zeros(1), touches=1, time=np.nan, sigma=sigma
    )
    calibration = io.Calibration(io.CameraId("", shape, np.dtype("uint8")), response=response)
    with pytest.warns(match="brightness has fallen by .* since the calibration, because of the lamp"):
        engine.reconstruct(recording, calibration=calibration)


def test_brightness_that_falls_at_the_rim_is_named():
    result = quietly(turn(TEXTURED[0], 1 - 0.06 * TO_RIM, uneven_light_sigma=0.005))
    assert result.process["warnings"].startswith("brightness from the centre to the rim is lower by ")


def test_brightness_that_falls_towards_one_side_is_named():
    result = quietly(turn(TEXTURED[0], 1 + 0.06 * X, uneven_light_sigma=0.005))
    assert result.process["warnings"].startswith("brightness towards the left is lower by 6")


def test_what_is_uncertain_of_the_calibration_is_in_the_standard_deviation():
    sigma = [
        engine.reconstruct(turn(TEXTURED[0], zenith_gain_sigma=share)).fitted.light_change_sigma[0]
        for share in (0.0, 0.05)
    ]
    assert sigma[1] == pytest.approx(np.hypot(sigma[0], 0.05))


def test_a_ball_does_not_show_the_brightness():
    ball = np.sqrt(16 - (X * 2.8) ** 2 - (Y * 2.2) ** 2)
    assert engine.reconstruct(turn(ball, 0.95)).fitted.light_change is None


def test_an_unchanged_sensor_says_nothing():
    results = aged(range(20), 0.0)
    said = [text for result in results for text in (result.process.get("warnings", ""),) if text]
    assert not said


def test_ageing_by_five_percent_in_a_hundred_recordings_is_a_trend_by_the_twentieth():
    trend = table(aged(range(20), 0.0005), form="none").trend("brightness change")
    assert trend is not None
    assert trend.step.value == pytest.approx(-0.05, abs=0.02)


@pytest.mark.slow
def test_ageing_is_tracked():
    numbers = np.arange(100)
    tracked = changes(aged(numbers, 0.0005))
    assert np.abs(tracked + 0.0005 * numbers).max() < 0.006


@pytest.mark.slow
def test_two_hundred_healthy_sensors_say_nothing():
    results = [engine.reconstruct(turn(TEXTURED[seed % 4], seed=seed)) for seed in range(200)]
    assert not any("brightness" in result.process.get("warnings", "") for result in results)
    lots = [results[first : first + 20] for first in range(0, 200, 20)]
    assert not any(table(lot, form="none").trend("brightness change") for lot in lots)


def press(light):
    """Return a press on a cone whose full light has changed by a factor."""
    travel = np.arange(0.0, 1.0, 0.02)
    x, y = np.meshgrid(np.arange(-35, 35) * 0.05, np.arange(-30, 30) * 0.05)
    height = -0.1 - 0.3 * np.hypot(x, y)
    share = np.clip((travel[:, np.newaxis, np.newaxis] + height) / 0.02 + 0.5, 0, 1)
    counts = DARK + 200 * share * light + np.random.default_rng(1).normal(0, 1, share.shape)
    frames = np.rint(counts).clip(0, 255).astype(np.uint8)
    return engine.reconstruct(
        frames, travel=travel, pixel_size=0.05, dark=DARK, bright=DARK + 200, fill=False
    )


def test_the_full_light_of_a_press_is_compared_with_its_reference():
    assert press(0.96).fitted.light_change[0] == pytest.approx(-0.04, abs=0.002)


def test_a_press_whose_light_has_changed_has_a_note():
    assert "brightness has fallen by 4" in press(0.96).process["notes"]


def test_a_press_as_its_references_has_no_note():
    assert "brightness" not in press(1.0).process.get("notes", "")


def test_a_recording_is_compared_without_a_result():
    recording = turn(TEXTURED[0], 0.9)
    finding = engine.calibration.compare_brightness(recording)
    assert finding is not None
    assert finding.text in quietly(recording).process["warnings"]


WAVES = scorer.waves(0.22, 2.4, 0.35, 6.0)


@pytest.fixture(scope="module")
def walled():
    """Return a sensor with a wall, and its calibration by balls, at a coarse resolution."""
    lab = Lab(shape=(72, 72), pixel_size=0.125)
    levels = [lab.flat(light, 32, take) for light, take in ((0.0, 900), (1.0, 901))]
    taken = measure_references(levels[:1], levels[1:]).references
    response = fit_zenith(nine_balls(lab, 3.0, 1), BALL / 2, references=taken)
    still = io.Precession(lab.tilt, 0.0, 1, 0.0, 0.0, (0.0, 0.0), lab.pivot)
    camera = io.CameraId("", lab.shape, np.dtype("uint8"))
    return lab, io.Calibration(camera, taken, zenith=response, precession=still)


@pytest.mark.slow
@pytest.mark.parametrize("light", [1.0, 0.95])
def test_a_wall_whose_light_has_changed_states_it(walled, light):
    lab, calibration = walled
    turned = lab.turned(WAVES, press_for(WAVES), 30)
    dark = np.nan_to_num(calibration.references.dark)
    frames = np.rint(dark + light * (turned.frames - dark)).clip(0, 255).astype(np.uint8)
    changed = Frames(frames, turned.header, turned.name, **turned.series)
    told = pytest.warns(io.MirrorskinWarning, match="has fallen by") if light < 1 else nullcontext()
    with told:
        result = engine.reconstruct(changed, calibration=calibration)
    assert result.fitted.light_change[0] == pytest.approx(light - 1, abs=0.01)


@pytest.mark.slow
def test_a_live_turn_under_a_wall_states_no_change_by_points_that_move(walled):
    lab, calibration = walled
    turned = lab.turned(WAVES, press_for(WAVES), 30)
    live = io.Calibrated(paced(turned.frames, turned.header, turned.series["phase"]), calibration)
    run = LiveRun(live, engine.Rotation(window_frames=len(turned.frames)))
    run.push(turned.frames, phase=turned.series["phase"])
    result = run.result()
    assert np.isfinite(result.zenith).any()
    assert result.fitted.light_change is None
