from .estimate import from_touches
from .priors import Stated
from .result import Estimate, TouchFit

__all__ = ["Estimate", "Stated", "TouchFit", "from_touches"]
