"""Where and how an object moved from one result to the next, and one surface of several results."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
