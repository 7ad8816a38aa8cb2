"""The modulus from presses of known force: true errors, and checked input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mirrorskin import io
from mirrorskin.engine.calibration.force import KnownPress, fit_stiffness, known_press
from mirrorskin.twin import Axial, Body, Camera, Sphere, Twin, Vertical

GEL = io.Gel(threshold=np.arctan2(17.5, 40) / 2, compliance=0.0, curvature=1 / 17.5)
KNOWN = io.Calibration(io.CameraId("", (48, 48), np.dtype(np.uint8)), gel=GEL)
MODULUS, NO_GEL = 0.12, np.zeros(3)


def presses(count, scatter, generator, reading=0.002):
    """Loads whose forces scatter in proportion, and a scale that reads them."""
    load = generator.uniform(0.5, 5.0, count)
    force = MODULUS * load * (1 + scatter * generator.normal(size=count))
    read = force + reading * generator.normal(size=count)
    return [
        KnownPress(applied, 0.0, NO_GEL, measured, reading)
        for applied, measured in zip(load, read, strict=True)
    ]


def test_the_standard_error_of_the_modulus_is_true():
    generator = np.random.default_rng(2)
    fits = [fit_stiffness(presses(12, 0.02, generator), GEL).stiffness for _ in range(400)]
    wrong = np.array([(fit.modulus - MODULUS) / fit.modulus_sigma for fit in fits])
    assert np.mean(wrong**2) == pytest.approx(1.15, abs=0.2)  # Student's t of 11 degrees of freedom: 11 / 9
    assert np.median([fit.scatter for fit in fits]) == pytest.approx(0.02, rel=0.15)


def test_a_scatter_that_noise_explains_is_that_of_the_model():
    fit = fit_stiffness(presses(8, 0.0, np.random.default_rng(3), reading=0.01), GEL)
    assert fit.stiffness.scatter == pytest.approx(0.003)


def test_each_force_is_held_out_once():
    four = presses(4, 0.05, np.random.default_rng(5))
    fit = fit_stiffness(four, GEL)
    first = fit_stiffness(four[1:], GEL).stiffness.modulus * four[0].load - four[0].force
    assert fit.held_out[0] == pytest.approx(first, rel=0.1)
    assert (np.abs(fit.held_out) >= np.abs(fit.residual)).all()
    assert fit.stiffness.error == pytest.approx(
        np.sqrt(np.mean((fit.held_out / [press.force for press in four]) ** 2))
    )


def test_forces_correct_what_the_gel_is_wrong_by():
    """Loads that are wrong by two standard errors of the compliance, which counts more for deep presses."""
    generator = np.random.default_rng(6)
    true = generator.uniform(0.5, 5.0, 20)
    by_gel = np.stack([0.005 * true, -0.004 * true**2, 0.002 * true], axis=1)
    load, reading = true - 2 * by_gel[:, 1], 1e-4
    force = MODULUS * true + reading * generator.normal(size=20)
    rows = [KnownPress(*row, reading) for row in zip(load, 0 * load, by_gel, force, strict=True)]
    fit = fit_stiffness(rows[:10], GEL)
    assert fit.stiffness.gel_shift[1] == pytest.approx(2, abs=0.5)
    fits = [
        fit.stiffness.modulus * (row.load + np.dot(row.by_gel, fit.stiffness.gel_shift)) for row in rows[10:]
    ]
    np.testing.assert_allclose(fits, force[10:], rtol=0.005)
    assert abs(fit_stiffness(rows[:10], GEL).stiffness.error) < 0.005


def test_the_modulus_of_one_press_has_the_error_of_the_gel():
    fit = fit_stiffness([KnownPress(2.0, 0.0, np.array([0.1, 0.0, 0.0]), 0.25, 0.0)], GEL)
    assert fit.stiffness.modulus == pytest.approx(0.125, rel=0.001)
    assert fit.stiffness.modulus_sigma == pytest.approx(6 * 0.05 * 0.125, rel=0.1)
    assert np.isnan(fit.stiffness.error)
    assert np.isnan(fit.held_out).all()


def pressed(movement, **options):
    return Twin(
        object=Sphere(6.0),
        shape=(48, 48),
        pixel_size=0.16,
        movement=movement,
        contact="elastic",
        optics="cylinder",
        camera=Camera(noise=1.0, seed=3),
        body=Body(modulus=MODULUS),
        **options,
    )


def test_loads_are_those_of_the_twin():
    fits = []
    for deepest in (0.5, 0.8):
        twin = pressed(Vertical(np.arange(0.04, deepest, 0.04)))
        fits.append(known_press(twin, KNOWN, float(twin.truth.force[-1, 2]), 0.001))
    fit = fit_stiffness(fits, GEL)
    assert fit.stiffness.modulus == pytest.approx(MODULUS, rel=0.03)
    assert fit.stiffness.error < 0.03


@pytest.mark.filterwarnings("ignore::mirrorskin.io.MirrorskinWarning")
def test_what_shows_no_force_is_one_line():
    press = pressed(Vertical(np.arange(0.04, 0.5, 0.04)))
    for force in (0.0, -1.0, float("nan")):
        with pytest.raises(io.InputError, match="give newtons above 0"):
            known_press(press, KNOWN, force)
    with pytest.raises(io.InputError, match="calibrate elastic first"):
        known_press(press, replace(KNOWN, gel=None), 1.0)
    turn = pressed(Axial(np.arange(8) * np.pi / 4, 0.04, 0.5))
    with pytest.raises(io.InputError, match="axial motion"):
        known_press(turn, KNOWN, 1.0)
    with pytest.raises(io.InputError, match="shows no force"):
        known_press(pressed(Vertical([0.0, 0.005, 0.01])), KNOWN, 1.0)
    with pytest.raises(io.InputError, match="at least one"):
        fit_stiffness([], GEL)
