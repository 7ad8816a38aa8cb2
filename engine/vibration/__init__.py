"""Frames of a body that vibrates: correlation at a frequency, and the growth of the contact."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
