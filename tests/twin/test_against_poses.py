"""The twin's sheet in every pose, compared with the tests' own geometry in float64."""

from __future__ import annotations

import numpy as np
import poses
import pytest
import rays
from geometry import pixel_centres

from mirrorskin.twin import Axial, Camera, Twin, Vertical
from mirrorskin.twin.movement import Movement
from mirrorskin.twin.objects import Cone, Object, Plane, Sphere
from mirrorskin.twin.skin import Sheet

SHAPE, PIXEL_SIZE = (53, 71), 0.6
# Radians: the twin's target, before its camera model.
TARGET = 1e-5
# Millimetres from where contact ends, where nothing is compared. At the object's own edges a line of sight
# that leans can pass through less of the object than a pixel, which the twin may miss.
HAIR, EDGE = 0.01, PIXEL_SIZE
# Of the sheet: there is none beyond.
RADIUS = 17.5
# Uneven, out of order, and more than a turn.
PHASES = np.array([0.0, 2.1, 2.3, 8.0, -1.2])
TILTS = np.radians([2.5, 20.0])

SOLIDS: dict[str, tuple[poses.Solid, Object]] = {
    "sphere": (poses.Ball(), Sphere()),
    "cone": (poses.Cone(), Cone()),
    "plane": (poses.Plate(), Plane()),
}
PIVOTS = {
    "centre": (1.5, (0.0, 0.0, 0.0)),
    "apex": (1.5, (0.0, 0.0, 1.5)),
    "40 mm up": (1.0, (0.0, 0.0, 40.0)),
    "off the axis": (1.5, (3.0, -2.0, 10.0)),
}


def make_twin(name: str, movement: Movement, camera: Camera | None = None) -> Twin:
    camera = Camera() if camera is None else camera
    return Twin(object=SOLIDS[name][1], shape=SHAPE, pixel_size=PIXEL_SIZE, movement=movement, camera=camera)


def compare(name: str, pose: poses.Pose, sheet: Sheet, distance: float | None = None) -> int:
    solid = SOLIDS[name][0]
    x, y = pixel_centres(SHAPE, PIXEL_SIZE)
    view = (0.0, 0.0) if distance is None else rays.sight_line(x, y, distance)
    sight = poses.see(solid, pose, x, y, view)
    clear = poses.clear(solid, pose, x, y, view, hair=HAIR, edge=EDGE)
    away = np.stack([np.hypot(x + h * view[0], y + h * view[1]) for h in (0.0, sight.height)])
    assert not sheet.contact[away.min(axis=0) > RADIUS + HAIR].any()
    clear &= away.max(axis=0) < RADIUS - HAIR
    assert clear.sum() > 0.8 * np.sum(away.max(axis=0) < RADIUS)
    np.testing.assert_array_equal(sheet.contact[clear], sight.contact[clear])

    touching = clear & sight.contact
    normal = poses.normals(sheet.dz_dx, sheet.dz_dy)
    assert poses.between(normal, sight.normal)[touching].max(initial=0) <= TARGET
    zenith, _ = poses.angles(normal)
    assert np.abs(zenith - sight.zenith)[touching].max(initial=0) <= TARGET
    assert np.abs(sheet.height - sight.height)[touching].max(initial=0) <= 1e-6

    free = clear & ~sight.contact
    assert not sheet.height[free].any()
    assert not sheet.dz_dx[free].any()
    assert not sheet.dz_dy[free].any()
    assert {part.dtype.name for part in (sheet.height, sheet.dz_dx, sheet.dz_dy)} == {"float64"}
    return int(touching.sum())


@pytest.mark.parametrize("pivot", PIVOTS)
@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("name", SOLIDS)
def test_a_leaning_body_sees_the_object_where_and_as_it_is(name: str, tilt: float, pivot: str) -> None:
    press, place = PIVOTS[pivot]
    twin = make_twin(name, Axial(PHASES, tilt, press, place))
    touching = [
        compare(name, poses.leaning(phase, tilt, press, place), twin.sheet(frame))
        for frame, phase in enumerate(PHASES)
    ]
    assert sum(touching) > 100


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("name", SOLIDS)
def test_a_pinhole_camera_sees_it_along_refracted_lines(name: str, tilt: float) -> None:
    press, place = 1.5, (0.0, 0.0, 1.5)
    twin = make_twin(name, Axial(PHASES, tilt, press, place), Camera(distance=120.0))
    touching = [
        compare(name, poses.leaning(phase, tilt, press, place), twin.sheet(frame), 120.0)
        for frame, phase in enumerate(PHASES)
    ]
    assert sum(touching) > 100


@pytest.mark.parametrize("distance", [None, 90.0])
@pytest.mark.parametrize("name", SOLIDS)
def test_a_lowered_body_sees_the_object_rise(name: str, distance: float | None) -> None:
    travel = np.array([0.02, 0.5, 1.4, 2.0])
    camera = None if distance is None else Camera(distance=distance)
    twin = make_twin(name, Vertical(travel), camera)
    touching = [
        compare(name, poses.lowered(press), twin.sheet(frame), distance) for frame, press in enumerate(travel)
    ]
    assert touching == sorted(touching)
    assert touching[-1] > 20


@pytest.mark.parametrize("tilt", TILTS)
def test_the_zenith_of_an_object_point_follows_equation_10(tilt: float) -> None:
    # All of a cone has a zenith of 30 degrees, and the azimuth of its place.
    press = 1.5
    twin = make_twin("cone", Axial(PHASES, tilt, press, (0.0, 0.0, press)))
    x, y = pixel_centres(SHAPE, PIXEL_SIZE)
    for frame, phase in enumerate(PHASES):
        pose = poses.leaning(phase, tilt, press, (0.0, 0.0, press))
        sheet = twin.sheet(frame)
        chosen = sheet.contact & poses.clear(SOLIDS["cone"][0], pose, x, y, hair=HAIR, edge=EDGE)
        assert chosen.sum() > 20
        point = pose.to_world(np.stack([x, y, sheet.height], axis=-1))
        modulation = np.cos(np.arctan2(point[..., 1], point[..., 0]) - phase)
        expected = np.cos(np.pi / 6) * np.cos(tilt) - np.sin(np.pi / 6) * np.sin(tilt) * modulation
        zenith, _ = poses.angles(poses.normals(sheet.dz_dx, sheet.dz_dy))
        assert np.abs(zenith - np.arccos(expected))[chosen].max() <= TARGET
