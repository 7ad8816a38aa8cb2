"""The slopes' kernels equal their reference, and that equals offline slopes from normals."""

import math

import numpy as np
import pytest

from mirrorskin.engine.integration.normals_to_height import SlopeKernels, find_slopes
from mirrorskin.kernels.integration import slopes

SHAPES = [(1, 1), (1, 9), (9, 1), (7, 5), (23, 37), (40, 300), (33, 520), (19, 128)]
TILT = 0.04
MAPS = "dz_dx", "dz_dy", "weight_x", "weight_y"


def normals(shape):
    random = np.random.default_rng(shape[0])
    vectors = random.normal(size=(*shape, 3)) * (0.7, 0.7, 1)
    vectors[..., 2] = np.where(random.random(shape) < 0.9, np.abs(vectors[..., 2]), vectors[..., 2])
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors[random.random(shape) < 0.05] = (0, 0, 1)
    sigma = random.uniform(0.001, 0.1, shape)
    sigma[random.random(shape) < 0.05] = np.nan
    contact = random.random(shape) < 0.9
    vectors[0, 0], sigma[0, 0], contact[0, 0] = (0.6, 0.0, 0.8), 0.01, True
    return vectors.astype(np.float32), sigma.astype(np.float32), contact.astype(np.uint8)


def on_device(device, vectors, sigma, contact, part=None):
    rows, columns = part = part or (slice(0, contact.shape[0]), slice(0, contact.shape[1]))
    maps = SlopeKernels(device, part, contact.shape[1])
    options = {"vectors": (vectors, np.float32), "sigma": (sigma, np.float32), "contact": (contact, np.uint8)}
    shape = rows.stop - rows.start, columns.stop - columns.start
    to = {name: device.from_host(name, np.zeros(shape)) for name in MAPS}
    maps.find(TILT, {name: device.from_host(name, *array) for name, array in options.items()}, to)
    return maps, {name: to[name].read() for name in MAPS}


@pytest.mark.parametrize("shape", SHAPES)
def test_kernels_do_what_the_reference_does(device, shape):
    maps_of_normals = normals(shape)
    maps, typical = on_device(device, *maps_of_normals)
    first = slopes.slopes_find(math.sin(TILT) ** 2, *maps_of_normals)
    dz_dx, _, *squares = first
    bounds = 1e-4 * maps.typical, 1e3 * maps.typical
    weights = slopes.slopes_weigh(math.sin(TILT) ** 2, *bounds, maps_of_normals[1], dz_dx, *squares)
    for name, exact in zip(MAPS, (*first[:2], *weights), strict=True):
        np.testing.assert_allclose(typical[name], exact, rtol=2e-5, atol=1e-6, err_msg=name)


def test_the_typical_weight_is_determined_once_and_bounds_the_others(device):
    maps_of_normals = normals((30, 40))
    maps_of_normals[1][3, 4] = 1e-9
    maps, typical = on_device(device, *maps_of_normals)
    weights = find_slopes(*maps_of_normals, TILT).weights
    assert maps.typical == pytest.approx(float(np.median(weights[weights > 0])), rel=0.05)
    assert typical["weight_x"].max() <= 1e3 * maps.typical * 1.0001


def test_slopes_of_a_part_are_those_of_the_picture(device):
    vectors, sigma, contact = normals((40, 61))
    part = slice(11, 31), slice(5, 37)
    outside = np.ones(contact.shape, bool)
    outside[part] = False
    contact[outside] = 0
    _, whole = on_device(device, vectors, sigma, contact)
    _, cut = on_device(device, vectors, sigma, contact, part)
    for name in MAPS:
        np.testing.assert_array_equal(cut[name], whole[name][part], err_msg=name)
