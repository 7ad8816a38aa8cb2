"""A calibrated response for the pixels of a picture, and normals from it."""

from dataclasses import replace

import numpy as np
import pytest
import walls
from calibrations import a_precession
from stacks import MadeUp
from walls import PHASE, TILT

from mirrorskin.engine import estimate_normals
from mirrorskin.engine.rotation.response import make_response, shade, wall_response_of
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.io import Calibrated, Calibration, CameraId, Header, InputError

SHAPE = (8, 31)
AXES = np.linspace(-6, 6, 31), np.linspace(3, -3, 8)


def make(wall=None, dark=10.0, bright=240.0, heights=0.5, **other):
    return make_response(wall or walls.response(SHAPE), dark, bright, AXES, heights, **other)


def frames_of(response, zenith, azimuth, noise=1.0, seed=0):
    """Counts of mirrors that all face one way."""
    x, y, z = response.planes[2:].reshape(3, -1)
    normal = walls.facing(np.array(zenith), np.array(azimuth))
    curve = response.wall.curve
    light = [walls.light_of(curve, x, y, z, normal, phase, follows=False) for phase in PHASE]
    offset, per_count = response.planes[:2].reshape(2, -1)
    counts = np.array(light) / per_count + offset
    counts += noise * np.random.default_rng(seed).normal(size=counts.shape)
    return counts.reshape(-1, *SHAPE).astype(np.float32), normal


def test_each_pixel_has_its_counts_its_place_and_its_shading():
    dark, bright = np.full(SHAPE, 12.0), np.full(SHAPE, 200.0)
    heights = np.random.default_rng(0).uniform(0, 1, SHAPE)
    response = make(dark=dark, bright=bright, heights=heights, pivot=(1.0, 2.0, 3.0))
    offset, per_count, x, y, z = response.planes
    np.testing.assert_array_equal(offset, dark)
    np.testing.assert_array_equal(z, heights.astype(np.float32))
    assert x[0, 0] == pytest.approx(-6 - walls.AXIS[0])
    assert y[0, 0] == pytest.approx(3 - walls.AXIS[1])
    u, v = x / walls.RADIUS, y / walls.RADIUS
    a, b, c, d, e = walls.SHADE
    np.testing.assert_allclose(
        1 / per_count, 188 * (1 + a * u + b * v + c * u * u + d * u * v + e * v * v), 1e-6
    )
    assert response.wall.pivot == pytest.approx((1 - walls.AXIS[0], 2 - walls.AXIS[1], 3))
    assert response.wall.sense == 1
    np.testing.assert_allclose(shade(replace(walls.response(SHAPE), shade=np.zeros(5)), x, y), 1)


def test_a_defect_and_what_is_next_to_the_body_have_no_answer():
    dark = np.full(SHAPE, 10.0)
    dark[3, 4] = np.nan
    bright = np.full(SHAPE, 240.0)
    bright[5, 6] = 0.0
    wide = np.linspace(-6, 30, 31), AXES[1]
    response = make_response(walls.response(SHAPE), dark, bright, wide, 0.5)
    per_count = response.planes[1]
    beyond = np.hypot(response.planes[2], response.planes[3]) >= walls.RADIUS
    assert 0 < beyond.sum() < beyond.size
    expected = ~beyond
    expected[3, 4] = expected[5, 6] = False
    np.testing.assert_array_equal(np.isfinite(per_count), expected)
    with np.errstate(invalid="ignore"):
        frames = np.random.default_rng(0).integers(90, 110, (8, *SHAPE)).astype(np.uint8)
    normals = rotations.estimate(frames, PHASE, tilt=TILT, response=response, noise=1.0)
    assert np.isnan(normals.normals_sigma[~expected]).all()
    assert np.isfinite(normals.normals_sigma[expected]).any()


def test_mirrors_that_face_one_way_are_found_to_do_so_all_over_the_picture(device):
    response = make(pivot=walls.PIVOT)
    frames, normal = frames_of(response, 0.5, 2.0)
    result = rotations.estimate(frames, PHASE, tilt=TILT, response=response, noise=1.0, device=device)
    error = np.linalg.norm(result.normals - normal, axis=-1) / result.normals_sigma
    assert np.mean(error**2) == pytest.approx(1, abs=0.25)
    assert result.contact.mean() > 0.98


def test_dark_pixels_are_marked_too_level():
    response = make()
    light = np.full(SHAPE, 0.5)
    light[2, 3:9] = 0.01
    mean = (response.planes[0] + light / response.planes[1]).astype(np.float32)
    mean[0, 0] = np.nan
    np.testing.assert_array_equal(response.too_level(mean), light < 0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wall": walls.response(SHAPE, pattern="uniform")}, "uniform pattern"),
        ({"wall": walls.response(SHAPE, curve=np.ones(13))}, "13 coefficients"),
        ({"wall": walls.response(SHAPE, curve=np.ones(1))}, "1 coefficients"),
        ({"dark": None}, "references"),
        ({"dark": 240.0, "bright": 10.0}, "swapped"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(change, message):
    with pytest.raises(InputError, match=message) as error:
        make(**change)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"method": "paper"}, "exact"), ({"tilt": "estimate"}, "tilt cannot be estimated")],
)
def test_what_a_response_cannot_do_is_refused(change, message):
    frames = np.full((8, *SHAPE), 100, np.uint8)
    options = {"phase": PHASE, "tilt": TILT, "noise": 1.0, "response": make()}
    with pytest.raises(InputError, match=message):
        estimate_normals(frames, **(options | change))


def leaning_response(**parts):
    """Return the response for a source whose calibration has a wall and other parts."""
    camera = CameraId("", SHAPE, np.dtype(np.float32))
    source = MadeUp(np.zeros((8, *SHAPE), np.float32), Header("axial"), phase=PHASE)
    return wall_response_of(Calibrated(source, Calibration(camera, zenith=walls.response(SHAPE), **parts)))


def test_an_ellipse_taken_for_a_circle_raises_the_error_of_azimuths():
    """Waves of inclined surfaces, seen linearly: by how much the azimuth of their first harmonic is off."""
    oval, phase = 0.02, np.arange(64) * np.pi / 32
    precession = a_precession(tilt=0.04, ellipticity=oval, centre=(0.0, 0.0))
    towards = np.arange(36) * np.pi / 18
    wave = -precession.lean(phase) @ np.stack([np.cos(towards), np.sin(towards)])
    turned = precession.phase(phase)
    design = np.stack([np.ones_like(turned), np.cos(turned), np.sin(turned)], axis=1)
    _, cosine, sine = np.linalg.lstsq(design, wave, rcond=None)[0]
    off = np.angle(-(cosine + 1j * sine) * np.exp(-1j * towards))
    assert np.max(np.abs(off)) == pytest.approx(oval / 2, rel=0.05)

    plain, elliptic = leaning_response(), leaning_response(precession=precession)
    middle = np.pi / 4 - np.arctan(np.mean(plain.reach))
    added = np.sqrt(elliptic.azimuth_sigma.astype(float) ** 2 - plain.azimuth_sigma.astype(float) ** 2)
    np.testing.assert_allclose(added, np.sqrt(np.mean(off**2)) * np.sin(middle), rtol=0.05)
    np.testing.assert_array_equal(elliptic.zenith_sigma, plain.zenith_sigma)
    circle = leaning_response(precession=a_precession(ellipticity=0.0))
    np.testing.assert_array_equal(circle.azimuth_sigma, plain.azimuth_sigma)
