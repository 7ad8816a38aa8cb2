"""Areal parameters against closed forms and against surfalize, and with holes."""

from functools import cache

import numpy as np
import pytest
from height_maps import places
from scipy import ndimage

from mirrorskin.engine.metrology import PARAMETERS, roughness

SHAPE, SIZE = (240, 300), (0.01, 0.01)
AREAL = [name for name, parameter in PARAMETERS.items() if parameter.standard == "ISO 25178-2"]


def values(height, size=SIZE, **options):
    return {name: entry.value for name, entry in roughness(height, size, **options).parameters.items()}


def random(spread, seed=1, shape=SHAPE):
    """Return a normally distributed surface with Sq = 1 um, whose autocorrelation is normal, too."""
    white = np.random.default_rng(seed).standard_normal(shape)
    smooth = ndimage.gaussian_filter(white, spread, mode="wrap")
    smooth -= smooth.mean()
    return 0.001 * smooth / smooth.std()


SURFACES = {
    "isotropic": random(4),
    "with a lay": random((3, 9)),
    "hills": 0.001 * np.exp(800 * random(4)),
    "pits": -0.001 * np.exp(800 * random(4)),
    "waves": 0.002
    * np.sin(2 * np.pi * (0.9 * places(SHAPE, SIZE)[0] + 0.43 * places(SHAPE, SIZE)[1]) / 0.27),
}


CURVE = {"Sk", "Spk", "Svk", "Smr1", "Smr2", "Vmp", "Vmc", "Vvc", "Vvv"}
CASES = [(kind, name) for kind in SURFACES for name in AREAL if name not in ("Str", "Std")]


@cache
def of_surface(kind):
    """Return the parameters of a surface, and what surfalize makes its own from."""
    import surfalize  # half a second, of which other workers need nothing

    surface = surfalize.Surface(1e3 * SURFACES[kind], 1e3 * SIZE[0], 1e3 * SIZE[1])
    return values(SURFACES[kind]), surface, surface.get_abbott_firestone_curve()


# The curve of waves has its least slope at both ends, so its core is either.
@pytest.mark.parametrize(("kind", "name"), [(k, n) for k, n in CASES if k != "waves" or n not in CURVE])
def test_parameters_are_those_of_surfalize(kind, name):
    parameters, surface, curve = of_surface(kind)
    other = getattr(curve, name.lower())() if name.startswith("V") else getattr(surface, name)()
    other = 1e-3 * other if name == "Sal" else other
    tolerance = {"Ssk": 1e-9, "Smr1": 0.05, "Smr2": 0.05, "Spk": 0.01, "Svk": 0.01}.get(name, 0.0)
    assert parameters[name] == pytest.approx(other, rel=3e-3, abs=tolerance)


@pytest.mark.parametrize("kind", ["isotropic", "with a lay", "hills"])
def test_the_aspect_ratio_is_that_of_surfalize(kind):
    parameters, surface, _ = of_surface(kind)
    assert parameters["Str"] == pytest.approx(surface.Str(), rel=0.01)


def test_the_autocorrelation_length_is_that_of_the_surface_before_it_was_drawn():
    # A normal filter of spread s has the autocorrelation exp(-r^2 / 4 s^2), which is 0.2 at 2 s sqrt(ln 5).
    parameters = values(random(4, seed=5, shape=(600, 700)))
    assert parameters["Sal"] == pytest.approx(0.01 * 8 * np.sqrt(np.log(5)), rel=0.05)


@pytest.mark.parametrize("angle", [0, 30, 90, 120])
def test_the_direction_is_that_of_the_waves(angle):
    x, y = places(SHAPE, SIZE)
    wave = np.cos(2 * np.pi * (x * np.cos(np.radians(angle)) + y * np.sin(np.radians(angle))) / 0.13)
    direction = values(0.001 * wave)["Std"]
    assert abs((direction - angle + 90) % 180 - 90) < 1.5


def test_a_normal_surface_has_the_material_ratio_of_a_normal_distribution():
    parameters = values(random(2, seed=3, shape=(600, 700)))
    assert (parameters["Ssk"], parameters["Sku"]) == pytest.approx((0, 3), abs=0.05)
    # Volumes are integrals of its quantiles: with z = 1.2816 at 10 %, Vmp = phi(z) - 0.1 z, and so on.
    for name, value in {"Vmp": 0.0473, "Vmc": 0.9059, "Vvc": 1.2173, "Vvv": 0.1116}.items():
        assert parameters[name] == pytest.approx(value, rel=0.05), name


def test_a_sine_has_the_gradient_and_area_of_its_closed_form():
    x, _ = places((50, 4000), (0.001, 0.01))
    parameters = values(0.02 * np.sin(2 * np.pi * x / 0.5), (0.001, 0.01))
    gradient = 0.02 * 2 * np.pi / 0.5 / np.sqrt(2)
    assert parameters["Sdq"] == pytest.approx(gradient, rel=1e-3)
    slope = 0.02 * 2 * np.pi / 0.5 * np.cos(np.linspace(0, 2 * np.pi, 100_001)[:-1])
    assert parameters["Sdr"] == pytest.approx(100 * (np.mean(np.sqrt(1 + slope**2)) - 1), rel=2e-3)


def test_holes_are_left_out_of_all_parameters():
    surface = random(3, shape=(400, 500))
    x, y = places(surface.shape, SIZE)
    with_holes = np.where((np.hypot(x, y) < 1.9) & (np.hypot(x - 0.5, y) > 0.3), surface, np.nan)
    whole, part = values(surface), values(with_holes)
    for name in ("Sa", "Sq", "Sal", "Sdq", "Sdr", "Sk", "Vmc", "Vvc"):
        assert part[name] == pytest.approx(whole[name], rel=0.04), name


def test_an_s_filter_removes_short_waves():
    x, _ = places(SHAPE, SIZE)
    long, short = 0.002 * np.sin(2 * np.pi * x / 1.5), 0.001 * np.sin(2 * np.pi * x / 0.05)
    assert values(long + short, s_filter=0.25)["Sz"] == pytest.approx(4, rel=0.05)


def test_all_parameters_are_there():
    assert [name for name in values(SURFACES["isotropic"]) if name in PARAMETERS] == AREAL


def test_a_surface_of_equal_heights_has_no_shape():
    parameters = values(np.ones((20, 30)))
    assert parameters["Sq"] == 0
    assert np.isnan([parameters[name] for name in ("Ssk", "Sku", "Sal", "Str")]).all()
