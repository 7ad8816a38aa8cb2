"""Calibration of a lit wall from touches of unknown objects."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.calibration import from_touches
from mirrorskin.engine.calibration.check import compare_brightness
from mirrorskin.evaluation.base.sources import Frames
from mirrorskin.evaluation.calibration import scorer
from mirrorskin.evaluation.calibration.scenes import press_for
from mirrorskin.evaluation.calibration.touches import (
    FURTHER,
    LAB,
    REACH,
    by_balls,
    camera_of,
    height_error,
    references_of,
    touch,
)

BODY = LAB.body.radius, LAB.body.height
TRUTH = {"pivot_z": LAB.pivot[2], "radius": BODY[0], "rim": BODY[1], "tilt": LAB.tilt, "phase_offset": 0.0}


@pytest.fixture(scope="module")
def taken():
    """References of the sensor."""
    return references_of(LAB)


@pytest.fixture(scope="module")
def touches(taken):
    """Touches of waves."""
    things = [scorer.waves(0.22, 2.4, 0.35, REACH), scorer.waves(0.18, 3.1, 1.1, REACH)]
    return [touch(LAB, thing, press_for(thing), 30 + number, taken) for number, thing in enumerate(things)]


def rewound(touches):
    """Return touches from the start."""
    for press, turn in touches:
        press.rewind()
        turn.rewind()
    return touches


def stating(turn, **properties):
    """Return a turn whose recording states other properties."""
    return Frames(turn.frames, replace(turn.header, **properties), turn.name, **turn.series)


@pytest.fixture(scope="module")
def fit(touches):
    """What two touches tell."""
    return from_touches(rewound(touches), body=(16.9, 41.0))


def calibration_of(fit, taken):
    """Return the calibration with what touches tell."""
    return io.Calibration(camera_of(LAB), taken, zenith=fit.response, precession=fit.precession)


@pytest.mark.parametrize("name", TRUTH)
def test_errors_are_as_large_as_their_standard_errors(fit, name):
    estimate = next(each for each in fit.estimates if each.name == name)
    assert abs(estimate.value - TRUTH[name]) < 4 * estimate.sigma


def test_radius_is_better_known_than_before(fit):
    estimate = next(each for each in fit.estimates if each.name == "radius")
    assert estimate.sigma < 0.04 * BODY[0]


def test_heights_are_those_of_a_calibrated_sensor(fit, taken):
    further = LAB.turned(FURTHER, press_for(FURTHER), 20)
    assert height_error(LAB, further, calibration_of(fit, taken)) < 12.0  # µm; 84 without a calibration


@pytest.mark.slow
def test_wrong_half_angle_and_pivot_in_the_recording_are_corrected(touches):
    wrong = []
    for press, turn in rewound(touches):
        x, y, z = turn.header.pivot
        wrong.append((press, stating(turn, tilt=1.04 * LAB.tilt, pivot=(x, y, z + 0.1))))
    estimates = {each.name: each for each in from_touches(wrong, body=BODY).estimates}
    assert abs(estimates["tilt"].value - LAB.tilt) < 4 * estimates["tilt"].sigma < 0.1 * LAB.tilt


def lit(turn, taken, share, seed):
    """Return a turn in the light of a lamp that has aged, with the same noise."""
    noise = LAB.noise * np.random.default_rng(seed).standard_normal(turn.frames.shape)
    dark = np.nan_to_num(taken.dark)  # unknown of defects
    samples = dark + share * (turn.frames - dark) + math.sqrt(1 - share**2) * noise
    return Frames(np.clip(np.rint(samples), 0, 255).astype(np.uint8), turn.header, turn.name, **turn.series)


@pytest.fixture(scope="module")
def later():
    """A turn on another object after the calibration."""
    return LAB.turned(FURTHER, press_for(FURTHER), 70)


@pytest.mark.parametrize("seed", range(3))
def test_lamp_that_has_faded_is_reported(fit, taken, later, seed):
    found = compare_brightness(lit(later, taken, 0.95, seed), calibration_of(fit, taken))
    assert "brightness has fallen by" in found.text
    assert found.warning


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_reported_of_the_same_lamp(fit, taken, seed):
    later = LAB.turned(FURTHER, press_for(FURTHER), 80 + seed)
    assert compare_brightness(later, calibration_of(fit, taken)) is None


def test_each_result_reports_a_lamp_that_has_faded(fit, taken, later):
    with pytest.warns(io.MirrorskinWarning, match="brightness has fallen by"):
        engine.reconstruct(lit(later, taken, 0.95, 5), calibration=calibration_of(fit, taken))


def test_touches_are_added_to_a_calibration(fit, taken, touches):
    more = from_touches(rewound(touches)[:1], calibration=calibration_of(fit, taken))
    assert more.response.touches == 3


@pytest.mark.slow
def test_touches_are_added_to_a_calibration_with_balls(taken, touches):
    balls = by_balls(LAB, taken)
    more = from_touches(rewound(touches)[:1], calibration=balls)
    errors, before = more.response.standard_errors(), balls.zenith.standard_errors()
    assert errors["radius"] <= 1.1 * before["radius"]
    assert abs(more.response.radius - BODY[0]) < 0.5


def test_response_survives_a_file(fit, taken, tmp_path):
    io.save_calibration(calibration_of(fit, taken), tmp_path / "cal.h5")
    found = io.open_calibration(tmp_path / "cal.h5").zenith
    np.testing.assert_array_equal(found.information, fit.response.information)


@pytest.mark.parametrize(
    ("thing", "reason"),
    [
        (scorer.facets(math.radians(29), 1.3, 2.1, 0.8, REACH), "next to edges or ridges"),
        (scorer.facets(math.radians(9), 3.0, 2.1, 0.5, REACH), "hardly any light in contact"),
    ],
)
def test_touch_that_is_not_used_is_named_with_the_reason(touches, taken, thing, reason):
    others = rewound(touches)[:1]
    fit = from_touches([*others, touch(LAB, thing, press_for(thing), 40, taken)], body=BODY)
    assert any(note.startswith(f"{thing.name} is not used: ") and reason in note for note in fit.notes)


def test_body_must_have_a_size(touches):
    with pytest.raises(io.InputError, match="must be above 0"):
        from_touches(touches, body=(0.0, 40.0))


def test_wall_has_no_zenith_offset_of_its_own(touches):
    with pytest.raises(io.InputError, match="zenith offset cannot be given"):
        from_touches(rewound(touches), body=BODY, zenith_offset=-60.0)


def test_added_touches_of_a_wall_have_no_zenith_gain(fit, taken, touches):
    with pytest.raises(io.InputError, match="zenith gain cannot be given"):
        from_touches(rewound(touches), calibration=calibration_of(fit, taken), zenith_gain=360.0)


def test_wall_needs_references(touches):
    press, turn = rewound(touches)[0]
    with pytest.raises(io.InputError, match="there are no dark and bright references"):
        from_touches([(press, stating(turn, dark=None, bright=None))], body=BODY)


def test_wall_needs_a_press_before_each_turn(touches):
    _, turn = rewound(touches)[0]
    with pytest.raises(io.InputError, match="follows no press"):
        from_touches([(None, turn)], body=BODY)


def test_wall_needs_the_depth(touches):
    press, turn = rewound(touches)[0]
    with pytest.raises(io.InputError, match="has no press"):
        from_touches([(press, stating(turn, press=None))], body=BODY)


def test_stated_scatter_is_used_and_only_a_ball_would_show_it(touches):
    stated = math.radians(2.0), math.radians(0.5)
    fit = from_touches(rewound(touches)[:1], body=BODY, stated={"scatter": stated})
    scatter = next(each for each in fit.estimates if each.name == "scatter")
    assert abs(scatter.value - stated[0]) < 0.5 * stated[1]
    assert abs(scatter.sigma / stated[1] - 1) < 0.05
    assert any("scatter (±" in note and "with a ball" in note for note in fit.notes)


@pytest.mark.slow
def test_stated_half_angle_that_touches_contradict_is_reported(touches):
    fit = from_touches(rewound(touches), body=BODY, stated={"tilt": (1.3 * LAB.tilt, math.radians(0.02))})
    assert any(note.startswith("tilt: the touches say") for note in fit.notes)
