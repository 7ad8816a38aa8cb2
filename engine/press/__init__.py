"""Heights from a press or a release: the travel at which each pixel turns light or dark."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
