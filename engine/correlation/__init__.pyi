from .correlation import Correlate, correlate

__all__ = [
    "Correlate",
    "correlate",
]
