"""Hardware: stages, cameras, and rigs of both.

``__init__.pyi`` lists the public names; each is imported from its module on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
