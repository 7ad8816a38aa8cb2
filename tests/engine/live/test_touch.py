"""Touches on the emulated rig, on simulated time."""

import dataclasses
import math
from contextlib import contextmanager

import msgspec
import numpy as np
import pytest
from rig_faults import FAULTS, FIRMWARE_ONLY

from mirrorskin import engine, io
from mirrorskin.engine.live.recipe import Contact, Measured, cheapest
from mirrorskin.hw import HardwareError, RigTouch
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.twin import Axial
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

SCENE = {"shape": (64, 80), "pixel_size": 0.045, "pattern": "linear", "rate": 20.0}
DEPTH, START = 0.6, -0.8


@contextmanager
def sensor_of(name="sphere", **changes):
    """Open an emulated rig as the sensor of a touch."""
    clock = SimulatedClock()
    emulated = EmulatedRig(name, clock=clock, **(SCENE | changes))
    with (
        emulated,
        Rig(emulated.open_stage(emulated.settings.stage), emulated.camera, emulated.settings, clock) as rig,
    ):
        yield emulated, rig, RigTouch(rig, DEPTH, START)


def errors(emulated, outcome, sigma):
    """Return the errors, mm, of the pixels that have the standard deviation."""
    movement = Axial(np.asarray(outcome.turn.phase), outcome.turn.header.tilt, outcome.turn.header.press)
    truth = emulated.twin(movement).truth
    known = np.isfinite(outcome.result.normals[..., 0]) & (outcome.result.height_sigma <= sigma)
    return (outcome.result.height - truth.height)[known]


@pytest.fixture(scope="module")
def reached():
    """A touch of a sphere that meets its request: the rig, the outcome, its texts and its frames."""
    texts, taken = [], []
    with sensor_of() as (emulated, rig, sensor):
        with sensor:
            outcome = engine.live.touch(
                sensor, 0.004, taken=taken, on_update=lambda text, result: texts.append(text)
            )
        yield emulated, outcome, texts, taken, rig.stage.report().position


def test_a_request_is_met_by_the_measured_standard_deviations(reached):
    _, outcome, *_ = reached
    result = outcome.result
    unknown = np.append(result.offset_unknown, 0)[result.component] != 0
    sigma = np.where(unknown, np.inf, result.height_sigma)[np.isfinite(result.normals[..., 0])]
    assert outcome.reached
    assert np.mean(sigma <= 0.004) == pytest.approx(outcome.share)
    assert outcome.share >= 0.95


def test_the_errors_are_within_the_request(reached):
    emulated, outcome, *_ = reached
    assert np.sqrt(np.mean(errors(emulated, outcome, 0.004) ** 2)) < 1.1 * 0.004


def test_it_says_what_it_expects(reached):
    _, outcome, texts, *_ = reached
    planned = outcome.planned
    assert texts[0] == f"expected: {planned}"
    assert planned.sigma <= 0.004
    assert 0 < planned.seconds < outcome.seconds


def test_it_stays_within_the_deepest_travel_and_lifts(reached):
    *_, taken, place = reached
    assert max(item.pose.travel for item in taken) <= DEPTH
    assert place.travel < START
    assert place.tilt == 0


def test_its_recording_repeats_the_result_bit_by_bit(reached, tmp_path):
    _, outcome, *_ = reached
    path = tmp_path / "frames.h5"
    io.save_touch(path, outcome.press, outcome.turn)
    with io.open_recording(path) as press, io.open_recording(path, dataset="turn") as turn:
        again = engine.live.fuse_touch(press, turn)
    assert set(again) == set(outcome.result)
    for name, values in outcome.result.items():
        np.testing.assert_array_equal(again[name], values, err_msg=name)


def test_a_request_that_cannot_be_met_ends_with_the_best_surface_and_the_reason():
    with sensor_of("cone") as (_, _, sensor), sensor:
        outcome = engine.live.touch(sensor, 1e-5)
    assert not outcome.reached
    assert "limited by" in outcome.reason
    assert np.isfinite(outcome.result.height).any()


def test_a_touch_ends_in_time():
    with sensor_of() as (_, _, sensor), sensor:
        outcome = engine.live.touch(sensor, 0.0005, within=10.0)
    assert outcome.seconds < 11.5  # with the lift
    assert "no time" in outcome.reason


REGION = io.Region((24, 40), (30, 50))
"""The middle of the picture."""


@pytest.fixture(scope="module")
def of_region():
    """A touch of the middle of a cone, and its rig."""
    with sensor_of("cone") as (emulated, _, sensor):
        with sensor:
            outcome = engine.live.touch(sensor, 0.004, region=REGION)
        yield emulated, outcome


def test_the_press_is_as_deep_as_the_region_needs(of_region):
    emulated, outcome = of_region
    deepest = outcome.press.travel.max()
    truth = emulated.twin(Axial(np.zeros(1), 0.01, DEPTH)).truth
    needed = -truth.height[REGION.slices].min()
    lean = outcome.turn.header.tilt * math.hypot(8, 10) * SCENE["pixel_size"]
    assert needed < deepest < needed + lean + 0.05 + 0.01
    assert deepest < DEPTH - 0.2


def test_the_share_is_that_of_the_region(of_region):
    _, outcome = of_region
    result = outcome.result
    unknown = np.append(result.offset_unknown, 0)[result.component] != 0
    sigma = np.where(unknown, np.inf, result.height_sigma)[REGION.slices]
    sigma = sigma[np.isfinite(result.normals[..., 0])[REGION.slices]]
    assert outcome.reached
    assert np.mean(sigma <= 0.004) == pytest.approx(outcome.share)


def test_the_surface_of_a_region_is_that_of_the_whole_picture(of_region):
    _, outcome = of_region
    assert outcome.result.height.shape == SCENE["shape"]
    outside = np.ones(SCENE["shape"], bool)
    outside[REGION.slices] = False
    assert np.isfinite(outcome.result.height[outside]).any()


def test_a_region_without_contact_is_not_reached():
    with sensor_of("coin", shape=(96, 128)) as (_, _, sensor), sensor:
        outcome = engine.live.touch(sensor, 0.004, region=io.Region((0, 8), (0, 8)))
    assert not outcome.reached
    assert "there is no contact" in outcome.reason


def test_no_contact_is_an_error_and_the_body_is_lifted():
    with sensor_of() as (_, rig, _):
        sensor = RigTouch(rig, -0.5, -3.0)
        with sensor, pytest.raises(io.InputError, match="no contact down to"):
            engine.live.touch(sensor, 0.01)
        assert rig.stage.report().position.travel < -3.0


AT_REST = {"G92 by another program": "did not send"}
"""What is said of a fault while nothing moves, if that differs."""


@pytest.mark.parametrize("fault", sorted(set(FAULTS) - FIRMWARE_ONLY - {"none"}))
def test_a_fault_of_the_rig_stops_the_stage_and_keeps_the_frames(fault):
    happen, words = FAULTS[fault]
    words = AT_REST.get(fault, words)
    taken = []
    with sensor_of() as (emulated, _, sensor):
        take = sensor.take

        def failing(*pose):
            if len(taken) == 6:
                happen(emulated)
            return take(*pose)

        sensor.take = failing
        with pytest.raises((HardwareError, KeyboardInterrupt)) as caught, sensor:
            engine.live.touch(sensor, 0.004, taken=taken)
        now = emulated.clock.now()
        emulated.clock.sleep(0.5)
        assert emulated.where(now + 0.3) == emulated.where(now + 0.5)
    assert words in (str(caught.value) or "stopped by the user")
    press, _ = engine.live.recordings_of(sensor, taken)
    assert press.shape[0] >= 4


def test_frames_that_are_lost_at_rest_do_no_harm():
    with sensor_of() as (emulated, _, sensor), sensor:
        emulated.camera.lateness = lambda number: math.inf if number % 3 == 1 else 0.0
        assert engine.live.touch(sensor, 0.01).reached


def test_flicker_is_taken_again():
    with sensor_of() as (_, _, sensor):
        take, count = sensor.take, 0

        def flickering(travel, tilt=0.0, phase=0.0):
            nonlocal count
            frame = take(travel, tilt, phase)
            count += tilt != 0
            bright = count == 2
            return np.clip(frame * (1.0 + 0.3 * bright), 0, 255).astype(frame.dtype)

        sensor.take = flickering
        with sensor:
            outcome = engine.live.touch(sensor, 0.004)
    assert outcome.retaken > 0
    assert outcome.reached


@pytest.fixture(scope="module")
def too_bright(tmp_path_factory):
    """A touch of a cone under a light that is twice too strong: the rig, the outcome, its recording."""
    with sensor_of("cone", light=2.0) as (emulated, _, sensor):
        with sensor:
            outcome = engine.live.touch(sensor, 0.004)
        path = tmp_path_factory.mktemp("too bright") / "frames.h5"
        io.save_touch(path, outcome.press, outcome.turn)
        yield emulated, outcome, path


def test_light_that_is_too_strong_is_taken_again_with_a_shorter_exposure(too_bright):
    _, outcome, path = too_bright
    assert outcome.retaken > 0
    with io.open_recording(path, dataset="turn") as turn:
        assert turn.header.exposure_ratio == pytest.approx(0.5)
        assert "cut off" not in {finding.kind for finding in io.check(turn).findings}


def test_a_touch_with_a_shorter_exposure_has_the_requested_errors(too_bright):
    emulated, outcome, _ = too_bright
    assert outcome.reached
    assert np.sqrt(np.mean(errors(emulated, outcome, 0.004) ** 2)) < 1.1 * 0.004


def test_the_response_of_a_shorter_exposure_is_in_the_recording(too_bright):
    emulated, _, path = too_bright
    stated = emulated.settings.camera
    with io.open_recording(path, dataset="turn") as turn:
        ratio, dark = turn.header.exposure_ratio, float(turn.header.dark.mean())
        assert float(turn.header.zenith_gain) == pytest.approx(ratio * stated.counts_per_radian)
        assert float(turn.header.zenith_offset) == pytest.approx(dark + ratio * (stated.zenith_offset - dark))


def test_the_recording_of_a_shorter_exposure_repeats_the_result_bit_by_bit(too_bright):
    _, outcome, path = too_bright
    with io.open_recording(path) as press, io.open_recording(path, dataset="turn") as turn:
        again = engine.live.fuse_touch(press, turn)
    for name, values in outcome.result.items():
        np.testing.assert_array_equal(again[name], values, err_msg=name)


def test_the_exposure_is_that_of_the_rig_file_afterwards(too_bright):
    emulated, *_ = too_bright
    assert emulated.camera.exposure == emulated.settings.camera.exposure


def test_the_exposure_is_kept_if_no_light_is_cut_off(reached):
    assert reached[1].turn.header.exposure_ratio is None


def test_stray_light_at_the_end_of_the_scale_is_found_before_contact():
    with sensor_of("cone") as (emulated, _, sensor):
        take = sensor.take

        def lit(*pose):
            counts = take(*pose) + 400.0 * emulated.camera.exposure / emulated.settings.camera.exposure
            return np.clip(counts, 0, 255).astype(np.uint8)

        def stop(text, _):
            raise InterruptedError(text)

        sensor.take = lit
        with sensor, pytest.raises(InterruptedError, match=r"again with 0\.50 of the exposure"):
            engine.live.touch(sensor, 0.004, on_update=stop)


@pytest.mark.parametrize(
    ("without", "words"),
    [("method", "cannot change its exposure"), ("exposure", "state camera.exposure in the rig file")],
)
def test_a_camera_that_keeps_its_exposure_leaves_light_cut_off_and_the_reason_says_so(
    without, words, monkeypatch
):
    with sensor_of("cone", light=2.0) as (emulated, rig, sensor):
        if without == "method":
            monkeypatch.delattr(type(emulated.camera), "set_exposure")
        else:
            camera = msgspec.structs.replace(rig.settings.camera, exposure=None)
            rig.settings = dataclasses.replace(rig.settings, camera=camera)
        with sensor:
            outcome = engine.live.touch(sensor, 0.02)
    assert outcome.retaken == 0
    assert "shorten the exposure" in outcome.reason
    assert words in outcome.reason


def test_frames_are_not_taken_again_with_a_shorter_exposure_if_there_is_no_time():
    with sensor_of("cone", light=2.0) as (_, _, sensor), sensor:
        outcome = engine.live.touch(sensor, 0.004, within=7.5)
    assert "no time to take all frames again" in outcome.reason
    assert outcome.seconds < 7.5


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_a_bump_between_press_and_turn_is_taken_again():
    with sensor_of("texture") as (_, _, sensor):
        take, count = sensor.take, 0

        def bumped(travel, tilt=0.0, phase=0.0):
            nonlocal count
            count += tilt != 0
            return np.roll(take(travel, tilt, phase), 4 if tilt and count <= 4 else 0, axis=1)

        sensor.take = bumped
        with sensor:
            outcome = engine.live.touch(sensor, 0.008)
    assert outcome.retaken > 0
    assert outcome.reached


def test_frames_that_are_interpolated_do_not_look_compressed():
    with sensor_of("texture", shape=(96, 128), pixel_size=0.03) as (_, _, sensor), sensor:
        outcome = engine.live.touch(sensor, 0.01)
    assert not any("compressed" in str(value) for value in outcome.result.process.values())


def test_a_frame_of_an_earlier_place_is_taken_again():
    with sensor_of() as (_, _, sensor):
        take, frames = sensor.take, []

        def held_up(travel, tilt=0.0, phase=0.0):
            frames.append(take(travel, tilt, phase))
            return (
                frames[-2]
                if len(frames) > 2 and travel == DEPTH and not tilt and len(frames) < 10
                else frames[-1]
            )

        sensor.take = held_up
        with sensor:
            outcome = engine.live.touch(sensor, 0.01)
    assert outcome.retaken > 0
    assert outcome.reached


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"sigma": 0.0}, "sigma 0 mm is not possible"),
        ({"sigma": 0.01, "share": 95.0}, "share 95 is not possible"),
        ({"sigma": 0.01, "within": 0.0}, "within 0 s is not possible"),
        ({"sigma": 0.01, "region": io.Region((0, 65), (0, 80))}, "a region of rows 0 to 65"),
    ],
)
def test_impossible_requests_are_refused_before_anything_moves(options, words):
    with sensor_of() as (_, _, sensor), pytest.raises(io.InputError, match=words):
        engine.live.touch(sensor, **options)


def test_a_sensor_without_zenith_gain_is_refused():
    with sensor_of(pattern="uniform") as (_, _, sensor), pytest.raises(io.InputError, match="zenith_gain"):
        engine.live.touch(sensor, 0.01)


CONTACT = Contact(0.03, noise=1.5, gain=360.0, tilt=0.044, zenith=0.4, depth=0.6)


def test_more_frames_are_expected_to_be_better():
    variances = [[CONTACT.variance(press, turn) for turn in (4, 8, 16)] for press in (2, 8, 30)]
    assert (np.diff(variances, axis=0) < 0).all()
    assert (np.diff(variances, axis=1) < 0).all()


def test_the_cheapest_recipe_has_the_fewest_frames():
    recipe = cheapest(CONTACT.variance, 0.002)
    assert recipe.sigma <= 0.002
    fewer = [(p, t) for p in range(2, 31) for t in range(4, 25) if p + t < recipe.frames]
    assert all(CONTACT.variance(*counts) > 0.002**2 for counts in fewer)


def test_no_recipe_suffices_for_an_impossible_request():
    assert cheapest(CONTACT.variance, 1e-6) is None


def test_the_variance_of_the_turn_falls_with_its_frames_alone():
    measured = Measured(4, 4, variance=4.0, of_turn=1.0)
    assert measured.after(4, 8) == pytest.approx(3.5)
    assert measured.after(7, 4) == pytest.approx(1 + 3 / 2**1.5)
