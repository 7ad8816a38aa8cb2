"""Calibration of a sensor from touches of unknown objects.

The public names are listed in ``__init__.pyi``; each is imported from its module when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
