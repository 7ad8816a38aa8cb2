"""The digital twin of the sensor: object, body, sheet, light and camera, as a source of frames."""

from mirrorskin.hw.twin.body import Body
from mirrorskin.hw.twin.camera import Camera
from mirrorskin.hw.twin.catalogue import OBJECT_NAMES, check_fits, make_object
from mirrorskin.hw.twin.coin import Coin
from mirrorskin.hw.twin.live import Live
from mirrorskin.hw.twin.movement import (
    Axial,
    Horizontal,
    Leaning,
    Movement,
    Twist,
    Vertical,
    oscillating_travel,
)
from mirrorskin.hw.twin.object_files import HeightMap, load_height_map, load_mesh
from mirrorskin.hw.twin.objects import Cone, Cylinder, Object, Plane, Sphere, Step, Texture
from mirrorskin.hw.twin.optics import design_range, visible_zenith
from mirrorskin.hw.twin.skin import Sheet
from mirrorskin.hw.twin.texture import SheetTexture, TextureName
from mirrorskin.hw.twin.twin import ContactName, OpticsName, Twin

__all__ = [
    "OBJECT_NAMES",
    "Axial",
    "Body",
    "Camera",
    "Coin",
    "Cone",
    "ContactName",
    "Cylinder",
    "HeightMap",
    "Horizontal",
    "Leaning",
    "Live",
    "Movement",
    "Object",
    "OpticsName",
    "Plane",
    "Sheet",
    "SheetTexture",
    "Sphere",
    "Step",
    "Texture",
    "TextureName",
    "Twin",
    "Twist",
    "Vertical",
    "check_fits",
    "design_range",
    "load_height_map",
    "load_mesh",
    "make_object",
    "oscillating_travel",
    "visible_zenith",
]
