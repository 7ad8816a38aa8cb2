"""Quadrature correlation of the brightness of each pixel with the movement."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
