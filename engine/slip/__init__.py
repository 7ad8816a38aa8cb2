"""Displacement of the skin in a slide or a twist, and where and when it slips on the object."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
