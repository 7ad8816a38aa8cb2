"""Heights from slopes, by weighted least squares on the graph of the pixels."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
