"""An axial rotation: normals, contact and edges from a pixel's wave."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
