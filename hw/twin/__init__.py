"""The digital twin of the sensor: object, sheet, light and camera, as a source of frames."""

from mirrorskin.hw.twin.camera import FRAME_RATE
from mirrorskin.hw.twin.objects.coin import Coin
from mirrorskin.hw.twin.objects.heightmap import HeightMap, load_height_map
from mirrorskin.hw.twin.objects.shapes import OBJECT_NAMES, Cone, Plane, Sphere, make_object
from mirrorskin.hw.twin.objects.surface import Object
from mirrorskin.hw.twin.twin import Twin

__all__ = [
    "FRAME_RATE",
    "OBJECT_NAMES",
    "Coin",
    "Cone",
    "HeightMap",
    "Object",
    "Plane",
    "Sphere",
    "Twin",
    "load_height_map",
    "make_object",
]
