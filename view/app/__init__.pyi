from .page import App
from .session import Opening

__all__ = ["App", "Opening"]
