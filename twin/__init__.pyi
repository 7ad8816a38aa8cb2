from .body import Body
from .camera import Camera
from .catalogue import OBJECT_NAMES, check_fits, make_object
from .coin import Coin
from .emulator.rig import EmulatedRig
from .emulator.simulated_clock import SimulatedClock
from .live import Live
from .movement import (
    Axial,
    Horizontal,
    Leaning,
    Movement,
    Twist,
    Vertical,
    oscillating_travel,
)
from .object_files import HeightMap, load_height_map, load_mesh
from .objects import Cone, Cylinder, Object, Plane, Sphere, Step, Texture
from .optics import design_range, visible_zenith
from .skin import Sheet
from .texture import SheetTexture, TextureName
from .twin import ContactName, OpticsName, Twin

__all__ = [
    "OBJECT_NAMES",
    "Axial",
    "Body",
    "Camera",
    "Coin",
    "Cone",
    "ContactName",
    "Cylinder",
    "EmulatedRig",
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
    "SimulatedClock",
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
