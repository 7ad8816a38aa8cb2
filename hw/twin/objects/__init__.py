"""What the twin can press on."""

from mirrorskin.hw.twin.objects.catalogue import OBJECT_NAMES, check_fits, make_object
from mirrorskin.hw.twin.objects.coin import Coin
from mirrorskin.hw.twin.objects.heightmap import HeightMap, load_height_map
from mirrorskin.hw.twin.objects.mesh import load_mesh
from mirrorskin.hw.twin.objects.plates import Plane, Step, Texture
from mirrorskin.hw.twin.objects.shapes import Cone, Cylinder, Sphere
from mirrorskin.hw.twin.objects.surface import Object, difference_slope, zenith_azimuth

__all__ = [
    "OBJECT_NAMES",
    "Coin",
    "Cone",
    "Cylinder",
    "HeightMap",
    "Object",
    "Plane",
    "Sphere",
    "Step",
    "Texture",
    "check_fits",
    "difference_slope",
    "load_height_map",
    "load_mesh",
    "make_object",
    "zenith_azimuth",
]
