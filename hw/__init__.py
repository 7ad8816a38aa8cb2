"""What moves and what sees: stage, camera, both as a rig, and the digital twin of it all.

The public names stand in ``__init__.pyi``; each is imported from its module when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
