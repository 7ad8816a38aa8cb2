"""Application in the browser: a recording, its options and its result, to click.

It needs Panel: ``pip install 'mirrorskin[app]'``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
