"""The named objects of the twin, and objects from files."""

from __future__ import annotations

import math
from pathlib import Path

from mirrorskin.io.base.types import InputError
from mirrorskin.twin.body import Body
from mirrorskin.twin.coin import Coin
from mirrorskin.twin.object_files import (
    DEFAULT_SCALE,
    HEIGHT_MAP_SUFFIXES,
    MESH_SUFFIXES,
    load_height_map,
    load_mesh,
)
from mirrorskin.twin.objects import PLATE_RADIUS, Cone, Cylinder, Object, Plane, Sphere, Step, Texture

OBJECT_NAMES = ("sphere", "coin", "plane", "cone", "cylinder", "step", "texture")

_MADE_ALREADY: dict[str, Object] = {
    thing.name: thing for thing in (Sphere(), Coin(), Cone(), Cylinder(), Step(), Texture())
}


def make_object(
    name: str | Path, shape: tuple[int, int], pixel_size: tuple[float, float], *, scale: float = DEFAULT_SCALE
) -> Object:
    """Return an object by its name or file, placed in a field of view.

    Parameters
    ----------
    name : str or Path
        "sphere" (10 mm), "coin" (5 yen), "plane" (20 degrees steep, its upper edge through the field's
        highest corner), "cone" (30 degrees steep), "cylinder" (a rod of 10 x 20 mm on its side), "step"
        (0.5 mm, a ramp of 40 degrees), "texture" (sinusoidal, 2 mm from ridge to ridge); or the path of a
        height map (.npy, .png, .tif, .tiff) or of a mesh in millimetres (.stl, .ply, .obj).
    shape : (int, int)
        Rows and columns of the field.
    pixel_size : (float, float)
        Millimetres along x and y; those of a height map too.
    scale : float
        mm per count of a 16-bit height map.

    Returns
    -------
    Object
        Its highest point touches the sheet at travel 0.

    Raises
    ------
    InputError
        The name is none of these, or the file cannot be used.
    """
    if str(name) == "plane":
        return _plane_in_field(shape, pixel_size)
    if str(name) in _MADE_ALREADY:
        return _MADE_ALREADY[str(name)]
    suffix = Path(name).suffix.lower()
    if suffix in HEIGHT_MAP_SUFFIXES:
        return load_height_map(name, pixel_size, scale=scale)
    if suffix in MESH_SUFFIXES:
        return load_mesh(name, shape, pixel_size)
    raise InputError(
        f"object {str(name)!r} is unknown: take {', '.join(OBJECT_NAMES)}, or the path of"
        f" a height map ({', '.join(HEIGHT_MAP_SUFFIXES)}) or of a mesh ({', '.join(MESH_SUFFIXES)})"
    )


def check_fits(thing: Object, body_radius: float) -> None:
    """Raise InputError if a body of this radius, mm, is too small for an object."""
    if thing.radius > body_radius:
        raise InputError(
            f"{thing.name} is larger than the sensor: it needs a circle of {2 * thing.radius:.4g} mm,"
            f" the sensor is {2 * body_radius:.4g} mm across;"
            " take a smaller object, or one nearer to the middle"
        )


def _plane_in_field(shape: tuple[int, int], pixel_size: tuple[float, float]) -> Plane:
    half_width, half_height = shape[1] * pixel_size[0] / 2, shape[0] * pixel_size[1] / 2
    azimuth = Plane().azimuth
    return Plane(
        reach=half_width * abs(math.cos(azimuth)) + half_height * abs(math.sin(azimuth)),
        radius=min(max(PLATE_RADIUS, math.hypot(half_width, half_height)), Body().radius),
    )
