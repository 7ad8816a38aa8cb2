"""Depths from the normals seen by a pinhole camera, compared with spheres and planes in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import engine, io

SHAPE = 61, 96
FOCAL, POINT = (50.0, 40.0), (51.0, 27.5)  # the corners are seen at 47 to 54 degrees from the axis
CAMERA = engine.integration.Camera(FOCAL, POINT)


def rays(shape=SHAPE, focal=FOCAL, point=POINT):
    """Return the point at depth 1 that each pixel shows."""
    row, column = np.indices(shape)
    return np.stack([(column - point[0]) / focal[0], (point[1] - row) / focal[1], -np.ones(shape)], axis=-1)


def plane(normal, distance, **camera):
    """Return depth and normals, of any length, of a plane."""
    sight = rays(**camera)
    return -distance / (sight @ np.array(normal)), np.broadcast_to(normal, sight.shape)


def sphere(centre, radius, scale=1):
    """Return depth, normals and where they are of a sphere, of a camera with that many times the pixels."""
    focal, point = np.multiply(FOCAL, scale), scale * (np.array(POINT) + 0.5) - 0.5
    sight = rays((SHAPE[0] * scale, SHAPE[1] * scale), focal, point)
    along, square = sight @ np.array(centre), np.sum(sight**2, axis=-1)
    root = along**2 - square * (np.dot(centre, centre) - radius**2)
    depth = (along - np.sqrt(np.where(root > 0, root, np.nan))) / square
    normals = (sight * depth[..., np.newaxis] - centre) / radius
    slant = -np.sum(normals * sight, axis=-1) / np.sqrt(square)
    return depth, normals, slant > 0.3, engine.integration.Camera(tuple(focal), tuple(point))


def apart(surface, depth, mask):
    """Return the largest error of the depth as a share of it, where the scale is free."""
    error = np.log(surface / depth)[mask]
    return np.abs(error - error.mean()).max()


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (3.0, 1.0, 6.0), (-0.2, 0.5, 0.8)])
def test_planes_are_exact_at_oblique_rays(device, normal):
    shape, focal = (244, 384), (200.0, 160.0)
    depth, normals = plane(normal, 300.0, shape=shape, focal=focal, point=(204.0, 110.0))
    camera = engine.integration.Camera(focal, (204.0, 110.0))
    surface = engine.integrate(normals=normals, camera=camera, device=device)
    assert apart(surface.height, depth, np.ones(shape, bool)) < 2e-6
    assert np.mean(np.log(surface.height)) == pytest.approx(0, abs=1e-6)
    assert surface.offset_unknown.tolist() == [1]


def test_a_sphere_seen_from_near_converges_with_the_second_order():
    errors = []
    for scale in (1, 2, 4):
        depth, normals, mask, camera = sphere((6.0, -3.0, -55.0), 25.0, scale)
        surface = engine.integrate(normals=normals, camera=camera, mask=mask, sigma=False)
        errors.append(apart(surface.height, depth, mask))
    assert errors[0] < 2e-3
    assert (np.divide(errors[:-1], errors[1:]) > 4).all(), errors


@pytest.mark.parametrize("robust", [False, True])
def test_known_depths_determine_the_scale_of_the_surface(device, robust):
    depth, normals, mask, camera = sphere((6.0, -3.0, -55.0), 25.0, 2)
    upper, middle = mask.copy(), mask.shape[0] // 2
    upper[middle:] = False
    mask[middle : middle + 2] = False
    heights = np.where(upper, depth, np.nan)
    asked = {"normals": normals, "camera": camera, "mask": mask, "device": device, "robust": robust}
    surface = engine.integrate(**asked, known_heights=heights, known_height_weights=np.where(upper, 9.0, 0.0))
    np.testing.assert_allclose(surface.height[upper], depth[upper], rtol=2e-4)
    assert surface.offset_unknown.tolist() == [0, 1]
    lower = mask & ~upper
    assert apart(surface.height, depth, lower) < 1e-3
    assert np.mean(np.log(surface.height[lower])) == pytest.approx(0, abs=1e-5)


def test_sigma_is_that_of_the_depth(device):
    depth, normals, mask, camera = sphere((0.0, 0.0, -40.0), 15.0)
    heights = np.where(mask, depth, np.nan)
    noisy = [np.random.default_rng(seed).normal(heights, 0.5) for seed in range(30)]
    asked = {"normals": normals, "camera": camera, "mask": mask, "device": device, "slope_weights": 1e6}
    surfaces = [engine.integrate(**asked, known_heights=values, known_height_weights=4.0) for values in noisy]
    spread = np.std([values.height[mask] for values in surfaces], axis=0)
    np.testing.assert_allclose(np.sqrt(np.mean(spread**2)), np.nanmean(surfaces[0].height_sigma), rtol=0.3)


def chi2_of_noisy_plane(normal, noise, camera, put, **options):
    """Return the mean square of errors over standard deviations of a plane, over 8 draws of the noise."""
    shape, focal, point = (64, 64), (200.0, 160.0), (40.0, 20.0)
    vector = np.array(normal) / np.linalg.norm(normal)
    truth, normals = plane(vector, 300.0, shape=shape, focal=focal, point=point)
    row, column = np.indices(shape)
    seen_by = {"camera": engine.integration.Camera(focal, point)}
    if not camera:
        truth, seen_by = (vector[1] * row - vector[0] * column) / vector[2], {"pixel_size": 1.0}
    chi2 = []
    for seed in range(8):
        noisy = normals + noise * np.random.default_rng(seed).standard_normal(normals.shape)
        surface = engine.integrate(normals=put(noisy), slope_weights=noise**-2, **seen_by, **options)
        relative = surface.height_sigma / surface.height if camera else surface.height_sigma
        error = np.log(surface.height / truth) if camera else surface.height - truth
        chi2.append(np.mean(((error - error.mean()) / relative) ** 2))
    return np.mean(chi2)


@pytest.mark.parametrize("noise", [0.01, 0.05])
@pytest.mark.parametrize("camera", [False, True])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.6, 1.7, 1.0)])
def test_sigma_is_that_of_slopes_from_noisy_normals(device, normal, camera, noise):
    if camera and normal[1] > 1:
        normal = (0.6, 1.2, 1.0)  # not edge-on at the border
    chi2 = chi2_of_noisy_plane(normal, noise, camera, np.asarray, device=device)
    assert 0.8 < chi2 < 1.3
    if not camera:
        put = lambda normals: device.from_host("normals", normals)  # noqa: E731
        assert chi2_of_noisy_plane(normal, noise, camera, put) == pytest.approx(chi2, rel=1e-3)
        assert 0.3 < chi2_of_noisy_plane(normal, noise, camera, np.asarray, robust=True, device=device) < 2


def test_weights_of_normals_that_are_no_inverse_variances_leave_slopes_as_they_are(device):
    _, normals = plane((0.5, 0.0, 1.0), 300.0)
    asked = {"normals": normals, "pixel_size": 1.0, "device": device}
    surfaces = [engine.integrate(**asked, slope_weights=weight) for weight in (1.0, 1e12)]
    np.testing.assert_allclose(surfaces[0].height, surfaces[1].height, atol=1e-4)


@pytest.mark.filterwarnings("error")
def test_without_a_camera_lines_of_sight_are_parallel(device):
    x, y = np.random.default_rng(4).normal(0, 0.4, (2, *SHAPE)).astype(np.float32)
    normals = 3 * np.stack([-x, -y, np.ones(SHAPE)], axis=-1)
    normals[:9] *= -1  # faces away
    normals[20, 20], normals[21, 20], normals[22, 20, 1] = 0, np.nan, np.inf  # there is none
    normals[23, 20] = 1, 0, 0.009  # is seen edge-on
    x[:9] = x[20:24, 20] = np.nan
    surface = engine.integrate(normals=normals, pixel_size=(0.3, 0.5), device=device)
    weights = 1 / (1 + np.nan_to_num(x**2 + y**2))  # n_z^2: normals are as noisy, not slopes
    expected = engine.integrate(x, y, (0.3, 0.5), slope_weights=weights, device=device)
    np.testing.assert_allclose(surface.height, expected.height, atol=1e-5)
    shares = surface.height_sigma / expected.height_sigma
    np.testing.assert_allclose(shares[np.isfinite(x)], np.nanmedian(shares), rtol=1e-3)
    assert (
        surface.process["integration_invalid"] == expected.process["integration_invalid"] == 9 * SHAPE[1] + 4
    )


NORMALS, FLAT = np.broadcast_to([0.0, 0, 1], (4, 5, 3)), np.zeros((4, 5))
BAD = {
    "there are no slopes": {},
    "there are no slopes: give dz_dx": {"dz_dx": FLAT},
    "both slopes and normals": {"dz_dx": FLAT, "dz_dy": FLAT, "normals": NORMALS},
    "a camera needs normals": {"dz_dx": FLAT, "dz_dy": FLAT, "camera": CAMERA},
    "normals: shape (4, 5)": {"normals": FLAT, "camera": CAMERA},
    "normals: shape (0, 5, 3)": {"normals": NORMALS[:0], "camera": CAMERA},
    "pixel_size 0.1: a camera determines it": {"normals": NORMALS, "camera": CAMERA, "pixel_size": 0.1},
    "nothing to integrate": {"normals": -NORMALS, "camera": CAMERA},
    "known_heights: some are not above 0": {"normals": NORMALS, "camera": CAMERA, "known_heights": FLAT},
    "initial_heights: some are not": {"normals": NORMALS, "camera": CAMERA, "initial_heights": FLAT},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_refused_in_one_line(message):
    with pytest.raises(io.InputError) as error:
        engine.integrate(**BAD[message])
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("numbers", [(0,), (np.nan,), ((1, 2, 3),), (5, (1,)), (5, (1, np.inf))])
def test_numbers_that_are_no_camera_s_are_refused(numbers):
    with pytest.raises(io.InputError, match=r"focal length|principal point"):
        engine.integration.Camera(*numbers)
