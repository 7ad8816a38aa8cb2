"""Normal force and pressure: closed forms of known shapes, and the twin's presses with its own scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from contact_theory import paraboloid, sphere

from mirrorskin import engine, io
from mirrorskin.engine.force import find_force
from mirrorskin.twin import Body, Camera, Sphere, Twin, Vertical

MODULUS, PIXEL = 0.12, 0.05
GEL = io.Gel(
    threshold=np.arctan2(17.5, 40) / 2, compliance=0.0, curvature=1 / 17.5, sigma={"threshold": 0.002}
)


def distances(count=80):
    x = PIXEL * (np.arange(count) - (count - 1) / 2)
    return np.hypot(x, x[:, np.newaxis])


@pytest.mark.parametrize(
    ("theory", "profile"),
    [
        (paraboloid(3.0, 1.2, MODULUS), lambda r: r**2 / 6),
        (sphere(3.0, 1.2, MODULUS), lambda r: 3 - np.sqrt(np.maximum(9 - r**2, 0))),
    ],
    ids=["paraboloid", "ball"],
)
def test_a_known_shape_presses_as_the_closed_forms_have_it(theory, profile):
    r = distances()
    force = find_force(-profile(r), theory.depth, PIXEL, MODULUS)
    assert force.force == pytest.approx(theory.force, rel=0.003)
    assert force.pressure.sum() * PIXEL**2 == pytest.approx(force.force, rel=1e-5)
    inside = r < 0.9 * theory.radius
    np.testing.assert_allclose(force.pressure[inside], theory.pressure(r[inside]), rtol=0.03)
    assert not force.pressure[r > 1.1 * theory.radius].any()


def test_the_compliance_of_the_stage_lowers_the_force():
    theory, r = paraboloid(3.0, 1.2, MODULUS), distances()
    given_way = 0.05 * theory.force / MODULUS
    force = find_force(-(r**2) / 6, theory.depth + given_way, PIXEL, MODULUS, compliance=0.05)
    assert force.force == pytest.approx(theory.force, rel=0.004)


def test_errors_of_travel_and_modulus_are_propagated():
    ball = -(distances() ** 2) / 6
    whole = [find_force(ball, 0.5 + step, PIXEL, MODULUS).force for step in (-0.002, 0.002)]
    force = find_force(ball, 0.5, PIXEL, MODULUS, travel_sigma=0.002)
    assert force.force_sigma == pytest.approx((whole[1] - whole[0]) / 2, rel=0.02)
    force = find_force(ball, 0.5, PIXEL, MODULUS, modulus_sigma=0.1 * MODULUS)
    assert force.force_sigma == pytest.approx(0.1 * force.force)


def test_independent_errors_of_heights_give_the_scatter_that_is_expected():
    generator, ball = np.random.default_rng(4), -(distances(48) ** 2) / 6
    expected = find_force(ball, 0.4, PIXEL, MODULUS, sigma=0.0003).force_sigma
    drawn = [
        find_force(ball + generator.normal(0, 0.0003, ball.shape), 0.4, PIXEL, MODULUS).force
        for _ in range(60)
    ]
    assert np.std(drawn) == pytest.approx(expected, rel=0.3)  # 9 % is the error of 60 draws


@pytest.mark.parametrize("length", [0.2, np.inf])
def test_errors_that_heights_of_a_result_share_are_larger(length):
    """Errors of fused heights are correlated over a length, those of integrated slopes everywhere."""
    generator, ball, x = np.random.default_rng(4), -(distances(48) ** 2) / 6, PIXEL * np.arange(48)
    fitted = io.Fitted(integration="direct") if np.isinf(length) else io.Fitted(height_correlation=length)
    places = np.exp(-0.5 * ((x - x[:, np.newaxis]) / length) ** 2) + 1e-9 * np.eye(48)
    factor, drawn = np.linalg.cholesky(places), []
    for _ in range(40):
        noise = 0.003 * factor @ generator.normal(size=(48, 48)) @ factor.T
        maps = {"height": ball + noise, "height_sigma": np.full((48, 48), 0.003), "x": x, "y": -x}
        drawn.append(find_force(maps | {"fitted": fitted}, 0.4, modulus=MODULUS))
    expected = np.mean([force.force_sigma for force in drawn])
    assert np.std([force.force for force in drawn]) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize("noise", [0.002, 0.005, 0.01, 0.02])
def test_errors_of_heights_do_not_raise_the_force(noise):
    generator, ball = np.random.default_rng(4), -(distances(64) ** 2) / 6
    expected = find_force(ball, 0.4, PIXEL, MODULUS).force
    drawn = []
    for _ in range(12):
        force = find_force(ball + generator.normal(0, noise, ball.shape), 0.4, PIXEL, MODULUS, sigma=noise)
        drawn.append((force.force - expected) / force.force_sigma)
    assert np.mean(np.square(drawn)) < 2


@pytest.mark.parametrize("kind", ["declared", "mapping", "dataset", "metres", "upwards", "file"])
def test_heights_come_from_wherever_they_are(kind, tmp_path):
    ball, x = -(distances(40) ** 2) / 6, PIXEL * (np.arange(40) - 19.5)
    ball[:, 30:] = ball[2, 2] - 0.1  # so that left and right differ
    ball[:9] -= 0.05
    sigma = np.full(ball.shape, 0.002)
    fitted = io.Fitted(travel=0.3)
    sigma[18:22, 18:22] = np.nan  # filled: their standard deviation is that of the nearest pixel
    expected = find_force(ball, 0.3, PIXEL, MODULUS, sigma=0.002)
    declared = io.Result(
        {"depth": ball, "depth_sigma": sigma},
        x=x,
        y=-x,
        fitted=fitted,
        declarations={"depth": io.Map("depth", "mm", "float64", quantity="height")},
    )
    io.save_result(declared, tmp_path / "worn.h5")
    dataset = io.Result(height=ball, height_sigma=sigma, x=x, y=-x, fitted=fitted).to_xarray()
    metres = dataset / 1000
    metres.attrs = dataset.attrs
    for name in ("height", "height_sigma"):
        metres[name].attrs["units"] = "m"
    maps = {
        "declared": declared,
        "mapping": {"height": ball.tolist(), "height_sigma": sigma, "x": x, "y": -x, "travel": 0.3},
        "dataset": dataset,
        "metres": metres,
        "upwards": dataset.isel(y=slice(None, None, -1)).transpose("x", "y"),
        "file": tmp_path / "worn.h5",
    }[kind]
    force = find_force(maps, modulus=MODULUS)
    assert force.force == pytest.approx(expected.force, rel=1e-9)
    assert force.force_sigma == pytest.approx(expected.force_sigma, rel=1e-9)
    np.testing.assert_allclose(force.pressure, expected.pressure, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(force.x, x)
    assert force.process == {"travel": 0.3, "modulus": MODULUS}


def test_a_result_brings_the_modulus_of_its_calibration():
    ball, x = -(distances(40) ** 2) / 6, PIXEL * (np.arange(40) - 19.5)
    stiffness = io.Stiffness(MODULUS, (0.0, 0.0, 0.0), np.diag([0.01**2, 0, 0, 0]), 0.0, GEL.threshold)
    result = io.Result(height=ball, x=x, y=-x, calibration=calibration(stiffness=stiffness))
    force, expected = find_force(result, 0.3), find_force(ball, 0.3, PIXEL, MODULUS, modulus_sigma=0.01)
    assert force.force == pytest.approx(expected.force)
    assert force.force_sigma == pytest.approx(expected.force_sigma)


def test_what_is_lifted_presses_with_nothing():
    force = find_force(-(distances() ** 2) / 6, -0.1, PIXEL, MODULUS, travel_sigma=0.01)
    assert (force.force, force.force_sigma, bool(force.contact.any())) == (0.0, 0.0, False)


IN_PIXELS = engine.integrate(normals=np.broadcast_to([0.0, 0.0, 1.0], (8, 9, 3)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"modulus": None}, "modulus is missing"),
        ({"travel": None}, "travel is missing"),
        ({"height": IN_PIXELS, "pixel_size": None}, "heights are in pixels"),
        ({"pixel_size": None}, "height has no pixel size"),
        ({"height": {"status": np.zeros((4, 4))}}, "height has no map of that name"),
        ({"modulus": 0.0}, "modulus of 0 MPa"),
        ({"modulus": float("nan")}, "modulus of nan MPa"),
        ({"height": np.zeros(4)}, r"height has shape \(4,\): a map"),
        ({"height": np.zeros((3, 4, 4))}, "one map"),
        ({"travel": float("inf")}, "travel inf"),
        ({"compliance": -1.0}, "compliance -1"),
        ({"sigma": np.zeros((2, 2))}, "sigma has shape"),
    ],
)
def test_impossible_input_is_one_line(changes, message):
    options = {"height": np.zeros((4, 4)), "travel": 0.1, "pixel_size": 0.1, "modulus": 0.1}
    with pytest.raises(io.InputError, match=message):
        find_force(**options | changes)


@pytest.fixture(scope="module")
def ball():
    """The twin's press of a ball, and the force that it knows."""
    twin = Twin(
        object=Sphere(6.0),
        shape=(64, 64),
        pixel_size=0.12,
        movement=Vertical(np.arange(0.03, 0.9, 0.03)),
        contact="elastic",
        camera=Camera(noise=1.0, seed=3),
        body=Body(modulus=MODULUS),
        optics="cylinder",
    )
    return twin, float(twin.truth.force[-1, 2])


def calibration(**parts):
    return io.Calibration(io.CameraId("", (64, 64), np.dtype(np.uint8)), gel=GEL, **parts)


@pytest.fixture(scope="module")
def pressed_ball(ball):
    return engine.reconstruct(ball[0], calibration(), modulus=MODULUS, fill=False)


def test_a_press_has_the_twin_s_force(ball, pressed_ball):
    (_, force), result = ball, pressed_ball
    assert result.force == pytest.approx(force, rel=0.03)
    assert abs(result.force - force) < 3 * result.force_sigma
    assert 0 < result.force_sigma < 0.05 * force
    assert result.pressure.sum() * 0.12**2 == pytest.approx(result.force, rel=0.02)
    assert result.process["modulus"] == "0.12 MPa, given"


def test_the_calibration_s_modulus_and_scatter_are_used(ball, pressed_ball):
    twin, _ = ball
    covariance = np.diag([(0.12 * 2 * MODULUS) ** 2, 0, 0, 0])
    stiffness = io.Stiffness(2 * MODULUS, (0.0, 0.0, 0.0), covariance, 0.05, GEL.threshold)
    result = engine.reconstruct(twin, calibration(stiffness=stiffness), fill=False)
    assert result.force == pytest.approx(2 * pressed_ball.force)
    assert result.force_sigma == pytest.approx(0.13 * result.force, rel=0.01)
    shifted = engine.reconstruct(
        twin, calibration(stiffness=replace(stiffness, gel_shift=(1.0, 0, 0))), fill=False
    )
    assert 0.001 < abs(shifted.force / result.force - 1) < 0.05
    assert shifted.pressure.sum() / result.pressure.sum() == pytest.approx(shifted.force / result.force)
    other = replace(stiffness, gel_threshold=0.1)
    lacking = engine.reconstruct(twin, calibration(stiffness=other), fill=False)
    assert lacking.force is None
    assert "calibrate force again" in lacking.process["force"]


def test_without_a_gel_or_a_modulus_there_is_no_force(ball):
    twin, _ = ball
    with pytest.raises(io.InputError, match="calibrate elastic first"):
        engine.reconstruct(twin, modulus=MODULUS)
    with pytest.raises(io.InputError, match=r"modulus -1(\.0)?: a number in MPa above 0 is needed"):
        engine.reconstruct(twin, calibration(), modulus=-1.0)
    result = engine.reconstruct(twin, calibration(), fill=False)
    assert (result.force, result.pressure) == (None, None)
    assert "force" not in result.process


def test_a_load_beyond_the_picture_is_not_a_force():
    twin = Twin(
        object=Sphere(10.0),
        shape=(64, 40),
        pixel_size=0.05,
        movement=Vertical(np.arange(0.03, 0.8, 0.03)),
        contact="elastic",
        camera=Camera(noise=1.0, seed=3),
        optics="cylinder",
    )
    smaller = replace(calibration(), camera=io.CameraId("", (64, 40), np.dtype(np.uint8)))
    result = engine.reconstruct(twin, smaller, modulus=MODULUS, fill=False)
    assert result.force is None
    assert "none: " in result.process["force"]


def test_a_force_comes_back_from_a_file(tmp_path):
    result = io.Result(pressure=np.ones((2, 3), np.float32), force=0.5, force_sigma=0.01)
    io.save_result(result, tmp_path / "a.h5")
    reopened = io.open_result(tmp_path / "a.h5")
    assert (reopened.force, reopened.force_sigma) == (0.5, 0.01)
    np.testing.assert_array_equal(reopened.pressure, 1)
    assert "force                         0.5 N" in repr(reopened)
    assert float(reopened.to_xarray().force) == 0.5
    assert reopened.to_xarray().force_sigma.units == "N"
