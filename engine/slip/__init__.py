"""The texture of the skin on the move: how far it has gone, and where it slips on the object."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
