from .camera import Camera
from .integration import Integrator, integrate
from .laplacian import invert_laplacian

__all__ = [
    "Camera",
    "Integrator",
    "integrate",
    "invert_laplacian",
]
