"""A value with its uncertainty and unit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from mirrorskin.io.base.types import PIXEL

_IN_PIXELS = {  # units and factors of values whose lengths are pixels
    "mm": (PIXEL, 1.0),
    "mm2": (f"{PIXEL}2", 1.0),
    "mm3": (f"{PIXEL}3", 1.0),
    "µm": (PIXEL, 1e-3),
    "ml/m2": (f"{PIXEL}3/{PIXEL}2", 1e-3),  # 1 ml/m2 is 1 µm
}
_ROUNDING = 1e-12  # relative uncertainty that is explained by rounding


@dataclass(frozen=True, slots=True)
class Quantity:
    """A measured value.

    Attributes
    ----------
    value : float
        NaN if undefined.
    sigma : float
        Standard uncertainty (k = 1), in the same unit; NaN if unknown.
    unit : str
        As in ``mm``, ``mm2``, ``deg``.

    Examples
    --------
    >>> print(Quantity(4.99923, 0.0312, "mm"))
    4.999 ± 0.031 mm
    """

    value: float
    sigma: float
    unit: str

    def in_pixels(self) -> Quantity:
        """Return a quantity whose lengths were taken for mm although they are in pixels, with its unit."""
        unit, factor = _IN_PIXELS.get(self.unit, (self.unit, 1.0))
        return Quantity(factor * self.value, factor * self.sigma, unit)

    def expanded(self, coverage: float) -> Quantity:
        """Return the quantity with its uncertainty multiplied by a coverage factor."""
        return replace(self, sigma=coverage * self.sigma)

    def __str__(self) -> str:
        return f"{self._number()} {self.unit}".strip()

    def _number(self) -> str:
        """Round to two digits of the uncertainty; without one, to five digits of the value."""
        if not math.isfinite(self.value):
            return "unknown"
        if not (math.isfinite(self.sigma) and self.sigma > _ROUNDING * abs(self.value)):
            return f"{self.value:.5g}"
        # The power of ten is read after rounding: 0.0996 has the two digits 0.10.
        places = 1 - int(f"{self.sigma:.1e}".partition("e")[2])
        shown = max(places, 0)
        # Adding zero takes the sign from a rounded -0.
        return f"{round(self.value, places) + 0.0:.{shown}f} ± {round(self.sigma, places):.{shown}f}"


def micrometres(value: float, sigma: float) -> Quantity:
    """Return a quantity in micrometres from millimetres."""
    return Quantity(1e3 * value, 1e3 * sigma, "µm")


def degrees(value: float, sigma: float) -> Quantity:
    """Return a quantity in degrees from radians."""
    return Quantity(math.degrees(value), math.degrees(sigma), "deg")
