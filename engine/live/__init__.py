"""Operations and methods that run while the body moves, with a limited delay."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
