from .camera import Camera
from .integration import Integrator, integrate
from .laplacian import invert_laplacian
from .surface import Surface

__all__ = [
    "Camera",
    "Integrator",
    "Surface",
    "integrate",
    "invert_laplacian",
]
