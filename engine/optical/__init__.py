"""Optical methods for a body that rests: focus, fringes, and light from several directions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
