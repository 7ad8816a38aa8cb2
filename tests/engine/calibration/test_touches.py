"""Calibration from touches of unknown objects, against the twin."""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.calibration import from_touches
from mirrorskin.evaluation.calibration import one_touch
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.twin import Axial, Camera, Cone, Plane, Step, Twin, Vertical

TILT = math.radians(2.5)
FRAMES = 12
PHASE = np.arange(FRAMES) * 2 * np.pi / FRAMES
PRESS = 1.6
PIVOT = (0.0, 0.0, 1.0)
SMALL = 40, 40  # pixels, for movements that are searched


@dataclass(frozen=True)
class Waves:
    """Random waves, of 0.35 mm and longer, on a blunt cone."""

    seed: int = 0
    name: str = "waves"
    radius: float = 5.0

    def _waves(self):
        random = np.random.default_rng(self.seed)
        number = 2 * np.pi / random.uniform(0.35, 1.05, 14)
        azimuth, phase = random.uniform(0, 2 * np.pi, (2, 14))
        size = 0.12 * np.sqrt(2 / 14) / number
        return zip(number * np.cos(azimuth), number * np.sin(azimuth), phase, size, strict=True)

    def height(self, x, y):
        waves = sum(size * np.sin(kx * x + ky * y + phase) for kx, ky, phase, size in self._waves())
        distance = np.hypot(x, y)
        return np.where(distance < self.radius, waves - 0.35 - 0.5 * np.hypot(distance, 0.3), np.nan)

    def slope(self, x, y):
        fall = -0.5 / np.sqrt(x**2 + y**2 + 0.09)
        slope_x, slope_y = fall * x, fall * y
        for kx, ky, phase, size in self._waves():
            slope = size * np.cos(kx * x + ky * y + phase)
            slope_x, slope_y = slope_x + kx * slope, slope_y + ky * slope
        inside = np.hypot(x, y) < self.radius
        return np.where(inside, slope_x, np.nan), np.where(inside, slope_y, np.nan)


def a_press(thing, seed=0, shape=(56, 56)):
    """Return a press with steps of 30 um."""
    travel = np.arange(0.03, PRESS, 0.03)
    return Twin(
        object=thing,
        shape=shape,
        pixel_size=0.03,
        object_shift=(0.6, 0.3),
        movement=Vertical(travel),
        camera=Camera(seed=2 * seed + 1),
    )


def a_turn(thing, seed=0, shape=(56, 56), tilt=TILT, pivot=PIVOT):
    """Return a turn."""
    return Twin(
        object=thing,
        shape=shape,
        pixel_size=0.03,
        object_shift=(0.6, 0.3),
        movement=Axial(PHASE, tilt=tilt, press=PRESS, pivot=pivot),
        pattern="linear",
        camera=Camera(seed=2 * seed + 2),
    )


def stating(turn, phase=None, gain=1.0, offset=0.0, **properties):
    """Return a turn whose recording states other properties of the sensor than those that it has."""
    header = turn.header
    names = "pixel_size", "tilt", "press", "pivot", "dark", "bright", "camera"
    stated = {name: getattr(header, name) for name in names}
    stated |= {"zenith_gain": gain * header.zenith_gain, "zenith_offset": header.zenith_offset + offset}
    frames = turn.read(np.empty(turn.shape, turn.dtype)).frames.copy()
    turn.rewind()
    return ArrayRecording(frames, {"phase": PHASE if phase is None else phase}, stated | properties)


def touches_of(count, first=0, stated=None, **turn):
    """Return presses and turns of waves."""
    return [
        (a_press(Waves(seed), seed), stating(a_turn(Waves(seed), seed, **turn), **stated or {}))
        for seed in range(first, first + count)
    ]


@functools.cache
def fit_of(count, first=0, **stated):
    """Return the fit of presses and turns of waves, which several tests look at."""
    return from_touches(touches_of(count, first, stated))


def deviations(fit, tilt=TILT, phase_offset=0.0, pivot=PIVOT, first=0):
    """Return the deviation of each estimate from the truth, in standard errors."""
    header = a_turn(Waves(first), first).header
    truth = {
        "gamma": 1.0,
        "zenith_gain": float(np.median(header.zenith_gain)),
        "zenith_offset": float(np.median(header.zenith_offset)),
        "tilt": tilt,
        "phase_offset": phase_offset,
        "pivot_z": pivot[2],
    }
    return {each.name: (each.value - truth.get(each.name, 0.0)) / each.sigma for each in fit.estimates}


def named(fit):
    """Return the estimates by name."""
    return {each.name: each for each in fit.estimates}


def test_touches_that_contradict_each_other_have_larger_errors_and_a_note():
    sound, (press, turn) = touches_of(2)
    frames = turn.read(np.empty(turn.shape, turn.dtype)).frames.copy()
    frames[6:] = np.roll(frames, -1, axis=0)[6:]  # the seventh was lost
    header = {name: getattr(turn.header, name) for name in ("pixel_size", "tilt", "press", "pivot")}
    header |= {
        name: getattr(turn.header, name) for name in ("dark", "bright", "zenith_gain", "zenith_offset")
    }
    lost = ArrayRecording(frames, {"phase": PHASE}, header)
    fit = from_touches([sound, (press, lost)])
    assert "contradict each other" in " ".join(fit.notes)
    assert named(fit)["phase_offset"].sigma > 2 * named(fit_of(2))["phase_offset"].sigma


def test_wrong_gain_and_offset_are_corrected():
    fit = fit_of(2, gain=1.05, offset=2.0)
    away = deviations(fit)
    assert max(abs(away[name]) for name in ("gamma", "zenith_gain", "zenith_offset", "tilt")) < 3


def test_gain_is_known_to_half_a_percent_from_two_touches():
    gain = named(fit_of(2))["zenith_gain"]
    assert gain.sigma / gain.value < 0.005


WRONG = {"gain": 1.03, "offset": 3.0, "tilt": 0.96 * TILT, "pivot": (0.0, 0.0, 1.15)}


def turns_of(count, first=0, stated=None):
    """Return turns of waves, without presses."""
    return [
        (None, stating(a_turn(Waves(seed), seed), **stated or {})) for seed in range(first, first + count)
    ]


@pytest.fixture(scope="module")
def turns_alone():
    """The fit of two turns without presses, whose recordings state wrong numbers."""
    return from_touches(turns_of(2, stated=WRONG))


def test_turns_alone_correct_wrong_numbers(turns_alone):
    away = deviations(turns_alone)
    assert max(abs(away[name]) for name in ("gamma", "zenith_gain", "zenith_offset", "tilt")) < 3, away


def test_turns_alone_of_something_rough_determine_the_gain_to_two_percent(turns_alone):
    gain = named(turns_alone)["zenith_gain"]
    assert gain.of_touches / gain.value < 0.02


def test_turns_alone_determine_no_pivot_and_the_remedy_is_a_press(turns_alone):
    assert any("pivot z (±" in note and "add a press" in note for note in turns_alone.notes)
    assert named(turns_alone)["pivot_z"].sigma > 0.9


def test_turns_alone_add_to_a_press_and_a_turn():
    pair = touches_of(1, stated=WRONG)
    first = from_touches(pair)
    both = from_touches(touches_of(1, stated=WRONG) + turns_of(1, first=1, stated=WRONG))
    added = from_touches(turns_of(1, first=1, stated=WRONG), calibration=calibration_of(first))
    gains = [named(fit)["zenith_gain"] for fit in (both, added)]
    assert max(gain.sigma for gain in gains) < 0.97 * named(first)["zenith_gain"].sigma
    assert abs(gains[0].value - gains[1].value) < gains[0].sigma


def test_smooth_object_without_a_press_is_named_with_its_errors():
    fit = from_touches([(None, a_touch("sphere")[1])])
    assert any("zenith gain (±" in note and "add a press" in note for note in fit.notes)
    assert named(fit)["zenith_gain"].of_touches / named(fit)["zenith_gain"].value > 0.05


def test_sense_of_rotation_is_found_without_a_press():
    fit = from_touches([(None, stating(a_turn(Waves(), shape=SMALL), phase=1.0 - PHASE))])
    assert fit.precession.direction == -1
    assert abs(fit.precession.phase_offset - 1.0) < 0.02


def test_wrong_half_angle_of_a_data_sheet_is_reported_by_turns_alone():
    tilt = math.radians(3.0)
    turns = [(None, stating(a_turn(Waves(seed), seed, tilt=tilt), tilt=TILT)) for seed in range(2)]
    fit = from_touches(turns, stated={"tilt": (TILT, math.radians(0.05))})
    assert any(note.startswith("tilt: the touches say") for note in fit.notes)


def test_pivot_cannot_be_stated_without_the_depth_of_the_press():
    with pytest.raises(io.InputError, match="pivot_z cannot be stated: without the depth"):
        from_touches(touches_of(1, stated={"press": None}), stated={"pivot_z": (1.0, 0.1)})


@pytest.mark.slow
def test_errors_of_turns_alone_are_not_larger_than_their_standard_errors():
    away = []
    for seed in range(200, 216):
        random = np.random.default_rng(seed)
        stated = {"gain": 1 + 0.03 * random.normal(), "offset": 3 * random.normal()}
        stated |= {
            "tilt": TILT * (1 + 0.04 * random.normal()),
            "pivot": (0.0, 0.0, 1 + 0.15 * random.normal()),
        }
        away.append(deviations(from_touches(turns_of(1, first=seed, stated=stated))))
    names = "gamma", "zenith_gain", "zenith_offset", "tilt", "phase_offset"
    chi2 = {name: np.mean([each[name] ** 2 for each in away]) for name in names}
    assert all(value < 1.7 for value in chi2.values()), chi2  # 2 standard deviations of chi-square


def test_one_gain_is_shared_out_among_pixels_as_references_say():
    camera = Camera(seed=3, gain_deviation=0.05)
    movement = Axial(PHASE, tilt=TILT, press=PRESS, pivot=PIVOT)
    field = {"object": Waves(0), "shape": (56, 56), "pixel_size": 0.03, "object_shift": (0.6, 0.3)}
    turn = Twin(movement=movement, pattern="linear", camera=camera, **field)
    true = turn.header
    one = {name: np.median(getattr(true, name)) for name in ("zenith_gain", "zenith_offset")}
    fit = from_touches(
        [(a_press(Waves(0)), stating(turn, **one | {"zenith_offset": one["zenith_offset"] + 3}))]
    )
    error = fit.response.gain / true.zenith_gain
    assert np.nanstd(error) < 0.005  # 0.05 without references
    away = fit.response.offset - true.zenith_offset
    assert np.nanstd(away) < 0.6  # counts; 4 without


def test_pixels_whose_references_show_no_light_are_left_out():
    turn = Twin(
        movement=Axial(PHASE, tilt=TILT, press=PRESS, pivot=PIVOT),
        pattern="linear",
        object=Waves(0),
        shape=(56, 56),
        pixel_size=0.03,
        object_shift=(0.6, 0.3),
    )
    one = {name: np.median(getattr(turn.header, name)) for name in ("zenith_gain", "zenith_offset")}
    bright = np.broadcast_to(turn.header.bright, (56, 56)).copy()
    dark = np.broadcast_to(turn.header.dark, (56, 56))
    bright[20, 20], bright[30:33, 10] = dark[20, 20], dark[30:33, 10] - 2
    fit = from_touches([(a_press(Waves(0)), stating(turn, **one | {"bright": bright, "dark": dark}))])
    error = fit.response.gain / turn.header.zenith_gain
    assert np.isnan(error[20, 20])
    assert np.isnan(error[30:33, 10]).all()
    assert np.nanmax(np.abs(error - 1)) < 0.03


@pytest.mark.parametrize("has_press", [True, False])
def test_references_are_not_needed(has_press):
    """Gain and offset of the response contain what the dark level and full light would say."""
    stated = {"gain": 1.03, "offset": 3.0, "dark": None, "bright": None}
    press, turn = touches_of(1, stated=stated)[0]
    press.header = replace(press.header, dark=None, bright=None)
    fit = from_touches([(press if has_press else None, turn)])
    away = deviations(fit)
    assert max(abs(away[name]) for name in ("gamma", "zenith_gain", "zenith_offset", "tilt")) < 3, away
    assert any(note.startswith("no dark and bright references: the darkest and bright") for note in fit.notes)


def test_periodic_texture_pressed_in_few_steps_is_honest():
    thing = {"object": "texture", "shape": (120, 160), "pixel_size": 0.04}
    press = Twin(movement=Vertical(np.linspace(-0.3, 1.0, 17)), camera=Camera(seed=2), **thing)
    movement = Axial(np.arange(8) * np.pi / 4, tilt=TILT, press=1.0)
    turn = Twin(movement=movement, pattern="linear", camera=Camera(seed=102), **thing)
    found, header = named(from_touches([(press, turn)])), turn.header
    truth = {"gamma": 1.0, "tilt": TILT}
    truth |= {name: float(np.median(getattr(header, name))) for name in ("zenith_gain", "zenith_offset")}
    away = {name: (found[name].value - value) / found[name].sigma for name, value in truth.items()}
    assert max(map(abs, away.values())) < 3, away


@pytest.mark.slow
def test_errors_are_as_large_as_their_standard_errors():
    seeds = 50
    fits = [
        from_touches(touches_of(1, first=seed, stated={"gain": 1.02})) for seed in range(100, 100 + seeds)
    ]
    away = [deviations(fit) for fit in fits]
    names = "gamma", "zenith_gain", "zenith_offset", "tilt", "phase_offset"
    chi2 = {name: np.mean([each[name] ** 2 for each in away]) for name in names}
    # Registration smooths the noise of samples, by which the phase is better than its standard error.
    assert all(0.5 < value < 1.5 for value in chi2.values()), chi2


def test_wrong_half_angle_of_a_data_sheet_is_reported():
    pairs = touches_of(1, tilt=math.radians(3.0), stated={"tilt": TILT})
    fit = from_touches(pairs, stated={"tilt": (TILT, math.radians(0.1))})
    assert abs(math.degrees(fit.precession.tilt) - 3.0) < 0.1
    assert any(note.startswith("tilt: the touches say") and "2.5 ± 0.1 deg is" in note for note in fit.notes)


def test_right_half_angle_of_a_data_sheet_is_used():
    fit = from_touches(touches_of(1), stated={"tilt": (TILT, math.radians(0.001))})
    assert not any("is stated" in note for note in fit.notes)
    assert fit.precession.sigma["tilt"] < math.radians(0.0011)


def test_cone_does_not_determine_the_gain():
    cone = Cone(math.radians(25.0), 5.0)
    fit = from_touches([(a_press(cone), stating(a_turn(cone)))])
    gain = named(fit)["zenith_gain"]
    assert not gain.determined
    assert gain.of_touches / gain.value > 0.01
    assert any("zenith gain" in note and "something rough" in note for note in fit.notes)


def a_touch(thing, press=0.6):
    """Return a press and a turn of an object in a larger field."""
    field = {"object": thing, "shape": (96, 96), "pixel_size": 0.05}
    travel = np.arange(0.02, press + 0.2, 0.02)
    movement = Axial(PHASE, tilt=TILT, press=press, pivot=PIVOT)
    turn = Twin(movement=movement, pattern="linear", camera=Camera(seed=2), **field)
    return Twin(movement=Vertical(travel), camera=Camera(seed=1), **field), stating(turn)


@pytest.mark.parametrize("thing", ["texture", "sphere", "coin", "cone"])
def test_smooth_objects_do_not_bias_the_estimates(thing):
    away = deviations(from_touches([a_touch(thing)]))
    assert max(map(abs, away.values())) < 3


@pytest.mark.parametrize(("thing", "press"), [(Plane(), 1.6), (Step(), 0.6)])
def test_plate_and_edge_are_refused(thing, press):
    with pytest.raises(io.InputError, match="slopes are all alike"):
        from_touches([a_touch(thing, press)])


def test_plate_next_to_other_touches_is_named():
    fit = from_touches([a_touch("sphere"), a_touch(Plane(), 1.6)])
    assert any("is not used: its slopes are all alike" in note for note in fit.notes)


def test_texture_of_which_little_is_used_is_not_said_to_have_one_slope():
    """Half-angle and pivot are far off, so few pixels, of one side of its grooves, remain."""
    _, turn, true = one_touch.touch("texture", 0)
    tilt, pivot = 1.134 * one_touch.TILT, (0.0, 0.0, one_touch.PIVOT + 0.59)
    turn.header = replace(turn.header, tilt=tilt, pivot=pivot, zenith_gain=0.98 * true["zenith_gain"])
    with pytest.raises(io.InputError, match="no touch can be used: its contact is narrow"):
        from_touches([(None, turn)])


def shown(turn, share=1.0, frames=slice(None)):
    """Return a turn with a share of its light above the dark level, and the samples of some frames only."""
    dark = np.median(np.asarray(turn.header.dark))
    samples = turn.read(np.empty(turn.shape, turn.dtype)).frames.astype(np.float64)
    samples = np.rint(dark + share * (samples - dark)).astype(turn.dtype)
    repeated = np.repeat(samples[frames], FRAMES // len(samples[frames]), axis=0)
    names = "pixel_size", "tilt", "press", "pivot", "dark", "bright", "zenith_gain", "zenith_offset"
    stated = {name: getattr(turn.header, name) for name in names}
    return ArrayRecording(repeated, {"phase": PHASE}, stated, name="this turn")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"share": 0.01}, "it shows hardly any light in contact"),
        ({"frames": slice(1)}, "the brightness does not follow the turn"),
    ],
)
def test_turn_that_is_not_used_is_named_with_the_reason(change, reason):
    press, turn = a_touch("sphere")
    fit = from_touches([a_touch("sphere"), (press, shown(turn, **change))])
    assert any(note.startswith(f"this turn is not used: {reason}") for note in fit.notes), fit.notes


def a_staircase(seed):
    """Return a touch of treads that are level and inclined in turn, under light that begins at zenith 0."""
    gain, offset, shape, size = 265.0, 30.0, (48, 56), 0.1
    x = np.broadcast_to((np.arange(shape[1]) - shape[1] / 2 + 0.5) * size, shape)
    tread = np.floor(x / 0.8)
    rise = math.tan(math.radians(5)) * (tread % 2)
    height = 0.15 * tread + rise * (x - (tread + 0.5) * 0.8) - 0.8
    phase = PHASE[:, np.newaxis, np.newaxis]
    axis = -math.sin(TILT) * np.cos(phase), math.cos(TILT)
    angle = np.arccos((axis[1] - rise * axis[0]) / np.sqrt(1 + rise**2))
    travel = np.arange(0.0, 1.7, 0.02)
    pressed = np.where(travel[:, np.newaxis, np.newaxis] > -height, 200.0, 16.0)
    noise, stated = np.random.default_rng(seed), {"pixel_size": (size, size), "dark": np.zeros(shape)}
    press, turn = (
        np.clip(np.rint(light + noise.standard_normal(light.shape)), 0, 255).astype(np.uint8)
        for light in (pressed, offset + gain * angle)
    )
    stated["bright"] = np.full(shape, 235.0)
    sensor = {"tilt": TILT, "zenith_gain": gain, "zenith_offset": offset}
    return ArrayRecording(press, {"travel": travel}, stated), ArrayRecording(
        turn, {"phase": PHASE}, stated | sensor
    )


@pytest.fixture(scope="module")
def staircase():
    """The fit of a staircase."""
    return from_touches([a_staircase(3)])


def test_staircase_has_honest_standard_errors(staircase):
    truth = {"gamma": 1.0, "zenith_gain": 265.0, "zenith_offset": 30.0, "tilt": TILT}
    away = [(each.value - truth.get(each.name, 0.0)) / each.sigma for each in staircase.estimates]
    assert max(map(abs, away)) < 3
    assert named(staircase)["zenith_gain"].of_touches / 265.0 > 0.013  # the Cramer-Rao bound


@pytest.mark.parametrize("name", ["zenith gain", "zenith offset", "tilt", "gamma"])
def test_what_a_staircase_does_not_determine_is_named_with_a_remedy(staircase, name):
    assert any(f"{name} (±" in note and "Remedy: " in note for note in staircase.notes)


def test_sense_of_rotation_and_phase_zero_are_found():
    turn = stating(a_turn(Waves(), shape=SMALL), phase=1.0 - PHASE)
    fit = from_touches([(a_press(Waves(), shape=SMALL), turn)])
    assert fit.precession.direction == -1
    assert abs(fit.precession.phase_offset - 1.0) < 0.02


def test_wrong_pivot_is_found():
    fit = from_touches(touches_of(1, pivot=(0.0, 0.0, -3.0), stated={"pivot": (0.0, 0.0, -2.8)}))
    assert abs(fit.precession.pivot[2] + 3.0) < 0.1


def test_flicker_is_a_gain_of_each_frame():
    press, turn = touches_of(1)[0]
    flicker = 1 + 0.03 * np.sin(np.arange(FRAMES) ** 2)
    frames = turn.read(np.empty(turn.shape, turn.dtype)).frames.astype(np.float64)
    dark = turn.header.dark
    lit = np.clip(np.rint(dark + flicker[:, None, None] * (frames - dark)), 0, 255).astype(np.uint8)
    header = {name: getattr(turn.header, name) for name in ("pixel_size", "tilt", "press", "pivot", "dark")}
    header |= {name: getattr(turn.header, name) for name in ("bright", "zenith_gain", "zenith_offset")}
    fit = from_touches([(press, ArrayRecording(lit, {"phase": PHASE}, header, name="flickering"))])
    np.testing.assert_allclose(fit.frame_gains["flickering"], flicker / flicker.mean(), atol=0.005)


def test_pixel_size_is_nearly_degenerate_with_the_gain():
    fit = from_touches(touches_of(1), stated={"pixel_size": (0.03, 0.001)})
    assert any("pixel size and zenith gain are nearly degenerate" in note for note in fit.notes)


def calibration_of(fit, before=None):
    """Return the calibration of a fit."""
    camera = io.CameraId("twin", (56, 56), np.dtype(np.uint8))
    return replace(before or io.Calibration(camera), response=fit.response, precession=fit.precession)


@functools.cache
def added():
    """Return the fit of a touch, and that of another which is added to its calibration."""
    first = fit_of(1, gain=1.03)
    later = touches_of(1, first=1, stated={"gain": 1.03})
    return first, from_touches(later, calibration=calibration_of(first))


def test_touches_add_to_a_calibration():
    first, both = added()
    assert both.response.touches == 2
    assert both.response.sigma["gain"] < 0.9 * first.response.sigma["gain"]
    assert abs(deviations(both)["zenith_gain"]) < 3


def test_two_steps_are_as_good_as_one():
    gains = [named(fit)["zenith_gain"] for fit in (added()[1], fit_of(2, gain=1.03))]
    assert abs(gains[0].value - gains[1].value) < gains[1].sigma
    assert gains[0].sigma == pytest.approx(gains[1].sigma, rel=0.2)


def test_what_a_calibration_states_of_the_movement_counts_when_touches_are_added():
    usual = calibration_of(fit_of(1, gain=1.03))
    known = replace(usual.precession, tilt=TILT, sigma={"tilt": 1e-4 * TILT})
    pairs = touches_of(1, stated={"gain": 1.03})
    first = from_touches(pairs, calibration=replace(usual, response=None, precession=known))
    later = touches_of(1, first=1, stated={"gain": 1.03})
    both = from_touches(later, calibration=calibration_of(first))
    assert named(both)["tilt"].sigma < 1.01e-4 * TILT


def timed(pairs, start_time):
    """Return touches whose turns start at a time."""
    changed = []
    for press, turn in pairs:
        turn.header = replace(turn.header, start_time=start_time)
        changed.append((press, turn))
    return changed


@functools.cache
def forgotten():
    """Return the fit of a touch to which another one is added ten time constants later."""
    stated = {"gain": 1.03}
    first = from_touches(timed(touches_of(1, stated=stated), "2026-01-01T00:00:00"))
    later = timed(touches_of(1, first=1, stated=stated), "2026-01-11T00:00:00")
    return from_touches(later, calibration=calibration_of(first), forget=86400.0)


def test_what_old_touches_told_of_the_response_is_forgotten():
    alone = fit_of(1, first=1, gain=1.03)
    sigma = [named(fit)["gamma"].sigma for fit in (added()[1], forgotten(), alone)]
    assert sigma[0] < 0.8 * sigma[1]
    assert sigma[1] == pytest.approx(sigma[2], rel=0.15)


def test_what_old_touches_told_of_the_movement_is_kept():
    sigma = [named(fit)["tilt"].sigma for fit in (added()[1], forgotten())]
    assert sigma[1] == pytest.approx(sigma[0], rel=0.1)


@pytest.mark.slow
def test_gain_that_falls_is_followed():
    lights = [touches_of(1, first=seed)[0] for seed in range(4)]
    calibration, errors = None, []
    for hour in range(24):
        press, turn = lights[hour % 4]
        gain = 1 - 0.0005 * hour
        frames = turn.read(np.empty(turn.shape, turn.dtype)).frames.astype(np.float64)
        turn.rewind()
        noise = np.random.default_rng(hour).uniform(-0.5, 0.5, frames.shape)
        dark = np.median(turn.header.dark)
        dimmed = np.clip(np.rint(dark + gain * (frames - dark) + noise), 0, 255).astype(np.uint8)
        header = replace(turn.header, start_time=f"2026-01-{1 + hour // 24:02}T{hour % 24:02}:00:00")
        stated = {
            name: getattr(header, name) for name in ("tilt", "press", "pivot", "zenith_gain", "zenith_offset")
        }
        stated |= {name: getattr(header, name) for name in ("pixel_size", "dark", "bright", "start_time")}
        recording = ArrayRecording(dimmed, {"phase": PHASE}, stated)
        fit = from_touches([(press, recording)], calibration=calibration, forget=2 * 3600.0)
        calibration = calibration_of(fit, calibration)
        errors.append(np.median(fit.response.gain) / (gain * np.median(header.zenith_gain)) - 1)
        press.rewind()
    assert np.max(np.abs(errors[8:])) < 0.005


def test_forgetting_needs_start_times():
    with pytest.raises(io.InputError, match="start time"):
        from_touches(touches_of(1), forget=86400.0)


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_reconstruct_uses_the_response():
    fit = fit_of(2, gain=1.05, offset=2.0)
    turn = a_turn(Waves(7), 7)
    errors = []
    for calibration in (None, calibration_of(fit)):
        result = engine.reconstruct(stating(turn, gain=1.05, offset=2.0), calibration)
        error = result.zenith - turn.truth.zenith
        errors.append(float(np.sqrt(np.nanmedian(error[result.contact > 0] ** 2))))
    assert errors[1] < errors[0] / 2


def test_response_survives_a_file(tmp_path):
    fit = fit_of(2)
    io.save_calibration(calibration_of(fit), tmp_path / "cal.h5")
    response = io.open_calibration(tmp_path / "cal.h5").response
    np.testing.assert_array_equal(response.information, fit.response.information)
    assert response.names == fit.response.names


def test_no_touches_are_refused():
    with pytest.raises(io.InputError, match="no touches"):
        from_touches([])


def test_unknown_number_is_refused():
    with pytest.raises(io.InputError, match="weight cannot be stated"):
        from_touches(touches_of(1), stated={"weight": (1.0, 0.1)})


def test_two_presses_of_a_touch_are_refused():
    press = a_press(Waves(0))
    with pytest.raises(io.InputError, match="vertical motion"):
        from_touches([(press, press)])
