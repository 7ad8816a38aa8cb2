"""A value with its uncertainty and unit."""

from __future__ import annotations

import math
from dataclasses import dataclass

_ROUNDING = 1e-12  # of a value: an uncertainty below it is that of the arithmetic


@dataclass(frozen=True, slots=True)
class Quantity:
    """What was measured.

    Attributes
    ----------
    value : float
        NaN where there is no answer.
    sigma : float
        Standard uncertainty (k = 1), in the same unit; NaN where it is not known.
    unit : str
        As in ``mm``, ``mm2``, ``deg``.
    """

    value: float
    sigma: float
    unit: str

    def __str__(self) -> str:
        return f"{self._number()} {self.unit}".strip()

    def _number(self) -> str:
        """Round to two digits of the uncertainty, or where there is none to five of the value."""
        if not math.isfinite(self.value):
            return "unknown"
        if not (math.isfinite(self.sigma) and self.sigma > _ROUNDING * abs(self.value)):
            return f"{self.value:.5g}"
        # The power of ten is read after rounding: 0.0996 has the two digits 0.10.
        places = 1 - int(f"{self.sigma:.1e}".partition("e")[2])
        shown = max(places, 0)
        # Adding zero takes the sign from a rounded -0.
        return f"{round(self.value, places) + 0.0:.{shown}f} ± {round(self.sigma, places):.{shown}f}"
