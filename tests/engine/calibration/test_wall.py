"""The zenith's calibration: from presses under the twin's wall to the light of normals outside the fit."""

import dataclasses
import math

import numpy as np
import pytest
from wall_presses import BODY, DISTANCE, SHAPE, light_of_response, wall_presses

from mirrorskin import io
from mirrorskin.engine.calibration.wall import fit_zenith
from mirrorskin.engine.calibration.wall_fit import pivot_of, read_press
from mirrorskin.evaluation.calibration.scenes import Frames
from mirrorskin.io import pixel_axes
from mirrorskin.kernels.device import open_device
from mirrorskin.twin.optics import Wall
from mirrorskin.twin.pattern import make_pattern
from mirrorskin.twin.skin import Sheet
from mirrorskin.twin.view import View

SIDE, Z = 5, 0.6
ZENITH = np.radians(np.arange(15, 44.1, 1.0))
AZIMUTH = np.radians([10.0, 100.0, 190.0, 280.0])


@pytest.fixture(scope="module")
def presses():
    return wall_presses()


@pytest.fixture(scope="module")
def response(presses):
    return fit_zenith(presses, 2.0, body=(16.6, 42.0))  # told 5 % off


def twin_light(zenith, azimuth):
    """Trace the light of facets all over the field, and return the lines of sight."""
    view = View((SIDE, SIDE), (2.4, 2.4), BODY, DISTANCE)
    wall = Wall(BODY, make_pattern("linear", BODY), view, open_device(None))
    ones = np.ones((SIDE, SIDE))
    light = [
        wall.light(Sheet(Z * ones, -np.tan(t) * np.cos(a) * ones, -np.tan(t) * np.sin(a) * ones, ones > 0))
        for t in zenith
        for a in azimuth
    ]
    return view, np.reshape(light, (len(zenith), len(azimuth), SIDE * SIDE))


def modelled_light(response, view, zenith, azimuth):
    t, a = (grid.reshape(-1, 1, 1) for grid in np.meshgrid(zenith, azimuth, indexing="ij"))
    normals = np.concatenate([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)], axis=2)
    light, within = light_of_response(response, np.stack([view.x.ravel(), view.y.ravel()]), Z, normals)
    return (grid.reshape(len(zenith), len(azimuth), -1) for grid in (light, within))


def bias(response):
    """Return by how many degrees the zenith of noiseless facets would be off, NaN out of range."""
    view, light = twin_light(ZENITH, AZIMUTH)
    modelled, within = modelled_light(response, view, ZENITH, AZIMUTH)
    off = np.degrees((modelled - light) / np.gradient(light, ZENITH, axis=0))
    return np.where(within, off, np.nan)


def test_the_light_of_normals_all_over_the_field_is_known(response):
    off = bias(response)
    assert np.isfinite(off).mean() > 0.85
    by_place = np.sqrt(np.nanmean(off**2, axis=1))
    assert np.nanquantile(by_place, 0.9) < 0.1


def test_errors_are_as_large_as_stated(response):
    off = bias(response)
    middle = np.sqrt(np.nanmean(off[10:22] ** 2))
    stated = np.degrees(np.sqrt(np.mean(response.zenith_sigma**2)))
    assert 0.3 < middle / stated < 2.5
    assert response.zenith_sigma.shape == SHAPE
    assert response.azimuth_sigma.shape == SHAPE
    assert (response.zenith_sigma > 0).all()
    assert (response.azimuth_sigma > 0).all()
    assert 0.002 < math.degrees(response.error) < 0.1  # never 0: noise hides that much


def test_wall_lamps_and_sight_are_found(response):
    sigma = dict(zip(response.parameters, np.sqrt(np.diag(response.covariance)), strict=True))
    assert response.radius == pytest.approx(BODY.radius, rel=0.02)
    assert response.scatter == pytest.approx(1.05 * BODY.scatter, rel=0.03)
    assert response.axis == pytest.approx((0, 0), abs=0.08)
    assert response.lamps == pytest.approx((0.05 * math.cos(1), 0.05 * math.sin(1)), abs=3e-3)
    assert 0 < sigma["radius"] < 0.2
    assert response.pattern == "graded"
    assert len(response.curve) <= 12
    assert 0 < response.reach[0] < 0.05 < 0.55 < response.reach[1] < 0.66


def test_references_of_a_calibration_go_before_those_of_the_recordings(presses):
    header = presses[0].header
    expected = read_press(presses[0], 2.0, None, None, 500)
    sigma = np.zeros(SHAPE, np.float32)
    references = io.References(header.dark, header.bright, sigma, sigma, np.zeros(SHAPE, np.uint8))
    blind = replaced(presses[0], dark=None, bright=np.ones(SHAPE, np.float32))
    np.testing.assert_array_equal(read_press(blind, 2.0, references, None, 500).light, expected.light)
    small = io.References(*([np.zeros((3, 4), np.float32)] * 4), np.zeros((3, 4), np.uint8))
    with pytest.raises(io.InputError, match="do not fit references"):
        read_press(blind, 2.0, small, None, 500)


def test_samples_at_the_ends_of_the_camera_and_of_defects_are_left_out(presses):
    frames = presses[0].frames.copy()
    frames[:, 24, 20:28] = 255
    dark = presses[0].header.dark.copy()
    dark[22] = np.nan
    spoilt = Frames(frames, dataclasses.replace(presses[0].header, dark=dark), "place-1", **presses[0].series)
    read = read_press(spoilt, 2.0, None, None, 10**6)
    y = pixel_axes(SHAPE, presses[0].header.pixel_size)[1]
    assert np.isfinite(read.light).all()
    assert read.light.max() < 1.1
    assert not np.isin(read.place[1], y[22]).any()
    assert np.isin(read.place[1], y[24]).any()


def test_a_calibrated_rotation_returns_leans_and_how_well_its_pivot_is_known(presses):
    sigma = {"pivot_x": 0.1, "pivot_y": 0.2, "pivot_z": 0.3, "phase_offset": 0.004}
    precession = io.Precession(
        tilt=0.045,
        phase_offset=0.0,
        direction=1,
        ellipticity=0.005 / 0.045,
        major_axis=np.pi / 2,
        centre=(0.0, 0.0),
        pivot=(1.0, 2.0, 3.0),
        sigma=sigma,
    )
    pivot = pivot_of(presses[0], precession)
    assert pivot.place == (1.0, 2.0, 3.0)
    assert pivot.sigma == pytest.approx((0.1, 0.2, 0.3), rel=0.2)
    assert pivot.phase_sigma == pytest.approx(0.004, rel=0.05)
    undetermined = pivot_of(presses[0], dataclasses.replace(precession, pivot=(math.nan,) * 3, sigma={}))
    expected = pivot_of(presses[0], None)
    assert (undetermined.place, undetermined.sigma) == (expected.place, expected.sigma)
    assert undetermined.phase_sigma < 0.1 < expected.phase_sigma  # of a recording, any phase may be meant
    assert undetermined.place == (0.0, 0.0, 0.0)
    read = read_press(presses[0], 2.0, None, precession, 500)
    np.testing.assert_allclose(read.lean, precession.lean(presses[0].series["phase"]), atol=1e-12)
    assert np.ptp(np.hypot(*read.lean.T)) > 5e-3


def replaced(press, **fields):
    header = dataclasses.replace(press.header, **fields)
    return Frames(press.frames, header, press.name, **press.series)


def test_a_press_without_a_ball_is_named(presses):
    empty = Frames(np.full_like(presses[1].frames, 16), presses[1].header, "place-2", **presses[1].series)
    with pytest.raises(io.InputError, match="place-2: a ball of 4 mm is seen in 0 of 8 frames"):
        fit_zenith([presses[0], empty, *presses[2:]], 2.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ball": 0.0}, "diameter is 0 mm: give a length above 0"),
        ({"pattern": "striped"}, "take graded or uniform"),
        ({"body": (0.0, 40.0)}, "0.0 mm radius and 40.0 mm height: both must be above 0"),
    ],
)
def test_impossible_input_is_refused(presses, options, message):
    with pytest.raises(io.InputError, match=message):
        fit_zenith(presses, **{"ball": 2.0, **options})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pixel_size": None}, "differ in pixels or their size"),
        ({"tilt": None}, "place-2 has no tilt: give it"),
        ({"dark": None}, "place-2: there are no dark and bright references"),
    ],
)
def test_what_a_recording_lacks_is_reported(presses, fields, message):
    with pytest.raises(io.InputError, match=message):
        fit_zenith([presses[0], replaced(presses[1], **fields), *presses[2:]], 2.0)
