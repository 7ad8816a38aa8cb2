"""What is wrong with the light of a rotation is removed, or part of the errors; independent renderings."""

import numpy as np
import pytest

from mirrorskin import engine
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import Setup
from mirrorskin.io.files.arrays import ArrayRecording

SIZE, PIXEL, COUNT = 72, 0.05, 16
SETUP = Setup(noise=1.2, offset=20.0, dtype="float32", phase=tuple(np.arange(COUNT) * 2 * np.pi / COUNT))
FLICKER = 1 + 0.02 * np.random.default_rng(3).standard_normal(COUNT)
DRIFT = np.linspace(0, 4, COUNT)
STEADY = np.ones(COUNT), np.zeros(COUNT)


WAVES = rotations.waves((SIZE, SIZE), (PIXEL, PIXEL))


def plate():
    """Return the normals of an inclined plate."""
    return np.broadcast_to(rotations.direction(np.radians(20), 0.3), (SIZE, SIZE, 3))


def turn(normals, gain, offset, seed, setup=SETUP):
    """Return a turn in light with a gain and an offset of each frame."""
    light = rotations.levels(normals, setup) - 20
    counts = 20 + light * gain[:, np.newaxis, np.newaxis] + offset[:, np.newaxis, np.newaxis]
    counts = np.rint(counts + np.random.default_rng(seed).normal(0, setup.noise, counts.shape))
    header = {"tilt": setup.tilt, "zenith_gain": setup.slope, "zenith_offset": setup.offset}
    frames = counts.clip(0, 255).astype(np.uint8)
    return ArrayRecording(frames, {"phase": np.array(setup.phase)}, header | {"dark": np.float32(20)})


def errors(result, normals):
    """Return the angular errors and their standard deviations, radians."""
    error = np.linalg.norm(np.cross(result.normals.astype(float), normals), axis=-1)
    valid = np.isfinite(error) & np.isfinite(result.normals_sigma)
    return error[valid], result.normals_sigma[valid]


def reconstruct(normals, gain, offset, seed=1):
    return engine.reconstruct(turn(normals, gain, offset, seed), blur=0.0)


def test_flicker_is_removed_as_if_it_were_not_there():
    steady, _ = errors(reconstruct(WAVES, *STEADY), WAVES)
    error, _ = errors(reconstruct(WAVES, FLICKER, STEADY[1]), WAVES)
    assert np.sqrt(np.mean(error**2)) < 1.06 * np.sqrt(np.mean(steady**2))  # 1.3 times without


def test_normals_in_flickering_light_have_the_errors_that_they_state():
    error, sigma = errors(reconstruct(WAVES, FLICKER, STEADY[1]), WAVES)
    assert 0.8 < np.mean((error / sigma) ** 2) < 1.2


def test_drift_is_removed():
    error, sigma = errors(reconstruct(WAVES, STEADY[0], DRIFT), WAVES)
    assert 0.8 < np.mean((error / sigma) ** 2) < 1.3  # 4 without


def test_what_was_removed_is_stated():
    process = reconstruct(WAVES, FLICKER, STEADY[1]).process
    share, corrected = process["flicker"].split(" %, ")
    assert float(share) == pytest.approx(100 * np.std(FLICKER), rel=0.05)
    assert corrected == "corrected"
    assert "drift" not in process


def test_flicker_that_was_removed_is_a_note():
    result = reconstruct(WAVES, FLICKER, STEADY[1])
    assert "warnings" not in result.process
    assert "flickers" in result.process["notes"]
    assert "corrected" in result.process["notes"]


@pytest.mark.parametrize("normals", [WAVES, plate()], ids=["waves", "plate"])
def test_steady_light_is_left_alone(normals):
    assert {"flicker", "drift"} & set(reconstruct(normals, *STEADY).process) == set()


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_a_plate_does_not_show_the_light():
    assert "flicker" not in reconstruct(plate(), FLICKER, STEADY[1]).process


def test_arrays_are_corrected_as_recordings_are():
    source = turn(WAVES, FLICKER, STEADY[1], 1)
    options = {"tilt": SETUP.tilt, "zenith_gain": SETUP.slope, "zenith_offset": SETUP.offset, "dark": 20.0}
    frames = source.read(np.empty(source.shape, source.dtype)).frames
    result = engine.estimate_normals(frames, SETUP.phase, **options)
    assert np.array_equal(result.normals, engine.reconstruct(source, blur=0.0).normals, equal_nan=True)


def test_an_operation_forgets_the_light_with_the_frames():
    operation = engine.Normals(tilt=SETUP.tilt, zenith_gain=SETUP.slope, zenith_offset=SETUP.offset)
    results = [
        engine.run(turn(WAVES, gain, STEADY[1], 1), operation) for gain in (STEADY[0], FLICKER, STEADY[0])
    ]
    assert np.array_equal(results[0].normals, results[2].normals, equal_nan=True)


def test_a_response_that_is_not_as_stated_is_no_flicker():
    light = rotations.levels(WAVES, SETUP)
    floor = np.maximum(light, 20 + SETUP.slope * np.radians(12))  # level surfaces do not get darker
    counts = np.rint(floor + np.random.default_rng(1).normal(0, SETUP.noise, light.shape))
    header = {"tilt": SETUP.tilt, "zenith_gain": SETUP.slope, "zenith_offset": SETUP.offset}
    phase = {"phase": np.array(SETUP.phase)}
    result = engine.reconstruct(ArrayRecording(counts.clip(0, 255).astype(np.uint8), phase, header))
    assert {"flicker", "drift"} & set(result.process) == set()


Y, X = np.mgrid[(SIZE - 1) / 2 : -SIZE / 2 : -1, -(SIZE - 1) / 2 : SIZE / 2 : 1] * PIXEL
SURFACES = {
    "plane": (0.4 * X, 0.4 + 0 * X, 0 * X),
    "roof": (-0.45 * np.abs(X) + 0.25 * Y, -0.45 * np.sign(X), 0.25 + 0 * X),
    "cone": (-0.6 * np.hypot(X, Y), -0.6 * X / np.hypot(X, Y), -0.6 * Y / np.hypot(X, Y)),
}
PHASE = np.array(SETUP.phase)
LIGHT = {
    "a wave": (1 + 0.01 * np.cos(PHASE - 1), STEADY[1]),
    "fading": (np.linspace(1, 0.98, COUNT), STEADY[1]),
    "a dark level that drifts": (STEADY[0], np.linspace(0, 1.5, COUNT)),
    "brighter light": (1.01 * STEADY[0], STEADY[1]),
}


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
@pytest.mark.parametrize("light", LIGHT)
@pytest.mark.parametrize("surface", SURFACES)
def test_heights_include_what_a_surface_of_one_slope_does_not_show_of_the_light(surface, light):
    height, *slope = SURFACES[surface]
    normals = np.stack([-slope[0], -slope[1], np.ones_like(height)], axis=-1)
    source = turn(normals / np.linalg.norm(normals, axis=-1, keepdims=True), *LIGHT[light], seed=1)
    result = engine.integrate(engine.reconstruct(source, blur=0.0), pixel_size=PIXEL)
    error = (result.height - height)[2:-2, 2:-2]
    error -= np.mean(error)
    assert np.mean((error / result.height_sigma[2:-2, 2:-2]) ** 2) < 2


def test_a_note_names_what_a_plate_does_not_show():
    notes = reconstruct(plate(), *STEADY).process["notes"]
    assert "not identifiable on this object" in notes
    assert "light of the frames" in notes
