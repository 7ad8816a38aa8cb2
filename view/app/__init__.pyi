from .page import App
from .session import Opening
from .trace import trace_of

__all__ = ["App", "Opening", "trace_of"]
