"""The twin's optics, compared with the tests' own rays, traced one by one in float64."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import poses
import pytest
import rays
from geometry import pixel_centres
from numpy.typing import NDArray

from mirrorskin.kernels.device import Device
from mirrorskin.kernels.layout import CPU_LAYOUT
from mirrorskin.twin import Axial, Camera, Horizontal, Movement, Plane, Twin, Twist
from mirrorskin.twin.body import Body
from mirrorskin.twin.optics import Ideal, Wall
from mirrorskin.twin.pattern import Linear, Pattern, Picture, Uniform
from mirrorskin.twin.skin import Sheet
from mirrorskin.twin.view import View

Map = NDArray[np.float64]

# Of full light: everywhere, and as a rule.
WORST, TYPICAL = 0.01, 0.005
# Zeniths between which the linear wall goes from dark to light.
LOWER, UPPER = np.radians(13.0), np.radians(42.0)
# Zenith of a mirror at the centre that shows the wall's rim.
RIM = np.arctan2(17.5, 40) / 2
# Edges are sharp without scatter: nothing is compared where a mirror leaning this little more differs.
HAIR = 2e-4

IMAGE = np.random.default_rng(11).uniform(size=(3, 5))
PATTERNS: dict[str, tuple[rays.Pattern, Pattern]] = {
    "uniform": (rays.uniform, Uniform()),
    "linear": (rays.linear_in_zenith(17.5, LOWER, UPPER), Linear(LOWER, UPPER)),
    "picture": (rays.picture(IMAGE, 40.0), Picture(IMAGE)),
}
CHAMBERS = {
    "in contact": rays.Chamber(),
    "behind air": rays.Chamber(air_gap=1.5),
    "lit unevenly": rays.Chamber(asymmetry=0.3, asymmetry_azimuth=2.0),
}
# A few dozen places, so far apart that some are outside the body.
SHAPE, PIXEL_SIZE = (6, 8), (4.5, 5.1)


def body_of(chamber: rays.Chamber) -> Body:
    names = ("height", "index", "scatter", "air_gap", "asymmetry", "asymmetry_azimuth")
    return Body(diameter=2 * chamber.radius, **{name: getattr(chamber, name) for name in names})


def leaning_sheet(zenith: Map, azimuth: Map, height: Map) -> Sheet:
    slope = np.tan(zenith)
    return Sheet(height, -slope * np.cos(azimuth), -slope * np.sin(azimuth), height > 0)


def any_sheet() -> Sheet:
    rng = np.random.default_rng(1)
    zenith = np.radians(rng.uniform(0.0, 50.0, SHAPE))
    return leaning_sheet(zenith, rng.uniform(-np.pi, np.pi, SHAPE), rng.uniform(0.0, 3.0, SHAPE))


@cache
def expected(chamber: rays.Chamber, pattern: str, distance: float) -> tuple[Map, NDArray[np.bool_]]:
    """Return the book's light, and which pixels are further than a hair from an edge."""
    truth, sheet = PATTERNS[pattern][0], any_sheet()
    x, _ = pixel_centres(SHAPE, PIXEL_SIZE[0])
    _, y = pixel_centres(SHAPE, PIXEL_SIZE[1])
    view = (np.zeros(SHAPE), np.zeros(SHAPE)) if np.isinf(distance) else rays.sight_line(x, y, distance)
    normal = poses.normals(sheet.dz_dx, sheet.dz_dy)
    light, clear = np.zeros(SHAPE), np.ones(SHAPE, dtype=bool)
    for pixel in np.ndindex(*SHAPE):
        height, line = sheet.height[pixel], (view[0][pixel], view[1][pixel])
        point = (x[pixel] + height * line[0], y[pixel] + height * line[1], height)
        light[pixel] = rays.wall_light(chamber, truth, point, normal[pixel], line)
        if chamber.scatter == 0:
            beside = [
                rays.wall_light(chamber, truth, point, normal[pixel] + HAIR * np.array([*across, 0]), line)
                for across in ((1, 0), (-1, 0), (0, 1), (0, -1))
            ]
            clear[pixel] = np.ptp([light[pixel], *beside]) < TYPICAL
    return light, clear


def compare(chamber: rays.Chamber, pattern: str, distance: float, device: Device) -> None:
    light, clear = expected(chamber, pattern, distance)
    assert clear.mean() > 0.8
    assert np.ptp(light[clear]) > 0.5
    assert 0.1 < np.mean(light > 0) < 0.9
    body = body_of(chamber)
    wall = Wall(body, PATTERNS[pattern][1], View(SHAPE, PIXEL_SIZE, body, distance), device)
    error = np.abs(wall.light(any_sheet()) - light)[clear]
    assert error.max() <= WORST
    assert np.mean(error <= TYPICAL) > 0.9


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("chamber", CHAMBERS)
def test_a_mirror_shows_the_wall_where_its_ray_ends(chamber: str, pattern: str, device: Device) -> None:
    # Each shape of work sees half of all combinations, because a kernel is compiled for each.
    number = [*CHAMBERS].index(chamber) + [*PATTERNS].index(pattern) + (device.layout is CPU_LAYOUT)
    compare(CHAMBERS[chamber], pattern, [np.inf, 120.0][number % 2], device)


@pytest.mark.parametrize(
    ("chamber", "pattern", "distance"),
    [
        ("in contact", "uniform", np.inf),
        ("in contact", "linear", 120.0),
        ("in contact", "picture", np.inf),
        ("behind air", "uniform", 120.0),
        ("behind air", "picture", np.inf),
        ("lit unevenly", "linear", np.inf),
        ("lit unevenly", "picture", 60.0),
    ],
)
def test_a_scattering_mirror_shows_the_mean_of_many_rays(
    chamber: str, pattern: str, distance: float, device: Device
) -> None:
    compare(dataclasses.replace(CHAMBERS[chamber], scatter=np.radians(3.0)), pattern, distance, device)


def test_under_a_linear_wall_brightness_is_linear_in_zenith_and_saturates_beyond() -> None:
    zenith = np.radians(np.linspace(0, 44, 441))[np.newaxis]
    body = body_of(rays.Chamber(scatter=np.radians(3.0)))
    light = Ideal(body, Linear(LOWER, UPPER)).light(level_sheet(zenith))
    half = np.radians(1.5)
    design = (zenith >= LOWER + half) & (zenith <= UPPER - half)
    line = (zenith - LOWER) / (UPPER - LOWER)
    assert design.sum() > 200
    assert np.abs(light - line)[design].max() <= 0.01
    assert not light[zenith < LOWER - half].any()
    assert np.all(light[zenith > UPPER + half] == 1)
    assert np.all(np.diff(light) >= 0)


@pytest.mark.parametrize(("pattern", "scatter"), [("uniform", np.radians(3.0)), ("linear", 0.0)])
def test_an_ideal_mirror_is_a_traced_one_at_the_centre(pattern: str, scatter: float, device: Device) -> None:
    truth, pattern_of_twin = PATTERNS[pattern]
    body = body_of(rays.Chamber(scatter=scatter))
    zenith = np.radians(np.linspace(2, 43, 83))[np.newaxis]
    clear = (np.abs(zenith - RIM) > 1e-3) | (scatter > 0)
    sheet = level_sheet(zenith, azimuth=0.6)
    shape, pixel_size = zenith.shape, (1e-6, 1e-6)  # all of it at the centre
    wall = Wall(body, pattern_of_twin, View(shape, pixel_size, body, np.inf), device)
    ideal = Ideal(body, pattern_of_twin).light(sheet)
    assert np.ptp(ideal) > 0.9
    error = np.abs(wall.light(sheet) - ideal)[clear]
    # The ideal mirror scatters in the plane of incidence, a real one by the angle a to all sides. Aside, the
    # rim, a circle 2 t off the axis, bends away by a^2/4 cot 2t on average: 1.5 % of a ramp 2 a wide.
    bend = scatter / 8 / np.tan(2 * RIM) if pattern == "uniform" else 0.0
    assert error.max() <= max(WORST, 1.1 * bend)
    assert np.mean(error <= WORST) > 0.95
    normal = poses.normals(sheet.dz_dx, sheet.dz_dy)[0]
    traced = [rays.wall_light(rays.Chamber(scatter=scatter), truth, (0, 0, 0), each) for each in normal]
    np.testing.assert_allclose(wall.light(sheet)[0][clear[0]], np.array(traced)[clear[0]], atol=TYPICAL)


MOVEMENTS: dict[str, tuple[Movement, list[poses.Pose]]] = {
    "axial": (
        Axial([0.3, 2.0], 0.15, 1.5, (2.0, -1.0, 8.0)),
        [poses.leaning(phase, 0.15, 1.5, (2.0, -1.0, 8.0)) for phase in (0.3, 2.0)],
    ),
    "horizontal": (
        Horizontal([[0.0, 0.0], [4.0, -2.5]], 1.5),
        [poses.moved_aside(aside, 1.5) for aside in ((0.0, 0.0), (4.0, -2.5))],
    ),
    "twist": (Twist([0.0, 0.9], 1.5), [poses.twisted(angle, 1.5) for angle in (0.0, 0.9)]),
}


@pytest.mark.parametrize(
    ("name", "solid", "movement", "distance"),
    [
        ("sphere", poses.Ball(), "axial", np.inf),
        ("sphere", poses.Ball(), "horizontal", 150.0),
        ("plane", poses.Plate(), "axial", 150.0),
        ("plane", poses.Plate(), "twist", np.inf),
    ],
)
def test_a_frame_of_the_twin_is_what_single_rays_make_of_the_object_in_its_pose(
    name: str, solid: poses.Solid, movement: str, distance: float
) -> None:
    moves, places = MOVEMENTS[movement]
    shape, pixel_size = (11, 15), 1.1
    camera = Camera(np.dtype(np.float32), 0.0, distance=distance)
    thing = Plane() if name == "plane" else name
    twin = Twin(
        object=thing,
        shape=shape,
        pixel_size=pixel_size,
        movement=moves,
        optics="cylinder",
        pattern="linear",
        camera=camera,
    )
    frames = np.empty((len(places), *shape), np.float32)
    with twin:
        assert twin.read(frames) is not None

    chamber = rays.Chamber(scatter=np.radians(3.0))
    pattern = rays.linear_in_zenith(17.5, RIM, np.radians(45))
    x, y = pixel_centres(shape, pixel_size)
    level = np.zeros(shape)
    view = (level, level) if np.isinf(distance) else rays.sight_line(x, y, distance)
    for frame, pose in zip(frames, places, strict=True):
        sight = poses.see(solid, pose, x, y, view)
        clear = poses.clear(solid, pose, x, y, view, hair=0.01, edge=pixel_size)
        clear &= np.hypot(x, y) < 17.0
        chosen = np.argwhere(clear & sight.contact)[::3]
        chosen = np.concatenate([chosen, np.argwhere(clear & ~sight.contact)[::40]])
        assert len(chosen) > 8
        for row, column in chosen:
            height, line = sight.height[row, column], (view[0][row, column], view[1][row, column])
            point = (x[row, column] + height * line[0], y[row, column] + height * line[1], height)
            light = rays.wall_light(chamber, pattern, point, sight.normal[row, column], line)
            assert (frame[row, column] - 16) / 208 == pytest.approx(light, abs=WORST)


def level_sheet(zenith: Map, azimuth: float = 0.0) -> Sheet:
    """Return a sheet at rest, its mirrors leaning by some zeniths."""
    return leaning_sheet(zenith, np.full(zenith.shape, azimuth), np.zeros(zenith.shape))
