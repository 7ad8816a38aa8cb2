"""Calibration from touches with an elastic body, whose gel is calibrated, against the twin."""

from dataclasses import replace

import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.engine.calibration import from_touches
from mirrorskin.evaluation.calibration.elastic_touches import (
    COMPLIANCE,
    PIXEL,
    SHAPE,
    TILT,
    calibration,
    touch,
    touches,
)
from mirrorskin.twin import Twin, Vertical

TRAVEL = np.arange(-0.1, 0.9, 0.02)
BOTH = "sphere", "cone"
STATED = {"tilt": (TILT, 0.01 * TILT)}


@pytest.fixture(scope="module")
def softer():
    """Return the fit of two touches with a gel whose compliance is too small by one and a half sigma."""
    pairs, _ = touches(BOTH, 0)
    return from_touches(pairs, calibration=calibration(0.02, 0.02), stated=STATED)


def compliance(fit):
    return next(estimate for estimate in fit.estimates if estimate.name == "compliance")


def test_compliance_is_estimated_as_far_as_it_shows(softer):
    found = compliance(softer)
    assert found.sigma < 0.75 * 0.02
    assert abs(found.value - COMPLIANCE) < 2.5 * found.sigma


def test_gel_has_the_compliance_that_was_estimated(softer):
    found = compliance(softer)
    assert (softer.gel.compliance, softer.gel.sigma["compliance"]) == (found.value, found.sigma)


def test_gain_is_within_its_standard_error_although_the_gel_yields_otherwise(softer):
    _, true = touches(BOTH, 0)
    gain = next(estimate for estimate in softer.estimates if estimate.name == "zenith_gain")
    assert abs(gain.value - true["zenith_gain"]) < 2.5 * gain.sigma


def test_gel_of_a_modulus_stays():
    known = calibration(0.05)
    stiffness = io.Stiffness(
        modulus=0.2, gel_shift=(0.0, 0.0, 0.0), covariance=[[0.0] * 4] * 4, scatter=0.01, gel_threshold=0.2
    )
    pairs, _ = touches(("cone",), 0)
    assert from_touches(pairs, calibration=replace(known, stiffness=stiffness), stated=STATED).gel is None


def test_compliance_is_not_stated_without_a_gel():
    pairs, _ = touches(("cone",), 0)
    with pytest.raises(io.InputError, match=r"without a calibrated gel.*Calibrate elastic first"):
        from_touches(pairs, stated={"compliance": (0.05, 0.01)})


def test_press_that_cannot_be_corrected_is_refused():
    _, turn = touch("sphere", 0)
    beyond = {"object_shift": (4.0, 3.0), "contact": "elastic"}  # the middle of the contact
    press = Twin(object="sphere", shape=SHAPE, pixel_size=PIXEL, movement=Vertical(TRAVEL), **beyond)
    with pytest.raises(io.InputError, match=r"cannot be corrected for the gel: .*\. Leave it out"):
        from_touches([(press, turn)], calibration=calibration(0.05))
