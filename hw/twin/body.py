"""What the sensor's body is made of, and what stands round it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mirrorskin.io.types import InputError

_SCATTER_MAX = math.radians(20.0)


@dataclass(frozen=True, slots=True)
class Body:
    """A cylinder of transparent silicone with a mirror sheet at its end, and a lit wall round it (paper 2.2).

    The wall is a Lambert sheet under a patterned one, lit by two circular lamps behind; it reaches from the
    sheet's rest plane to the body's top.

    Attributes
    ----------
    diameter, height : float
        Millimetres; the paper's body is 35 across and 40 high.
    index : float
        Refractive index of the silicone.
    sheet : float
        Thickness of what lies between the mirror and the object, mm.
    modulus : float
        Young's modulus, N/mm^2; the silicone does not change its volume (Poisson ratio 0.5).
    friction : float
        Coulomb's coefficient between sheet and object.
    scatter : float
        Largest angle by which the sheet's flakes turn a reflected ray, radians.
    air_gap : float
        Between body and wall, mm; 0 is optical contact.
    asymmetry, asymmetry_azimuth : float
        By how much the lamps light one side more than the other, as a share of the mean, and which, radians.

    Raises
    ------
    InputError
        A value cannot be.
    """

    diameter: float = 35.0
    height: float = 40.0
    index: float = 1.41
    sheet: float = 0.05
    modulus: float = 1.0
    friction: float = 0.8
    scatter: float = math.radians(3.0)
    air_gap: float = 0.0
    asymmetry: float = 0.0
    asymmetry_azimuth: float = 0.0

    def __post_init__(self) -> None:
        rules = {
            "diameter": (self.diameter > 0, "mm, more than 0"),
            "height": (self.height > 0, "mm, more than 0"),
            "index": (self.index >= 1, "a refractive index, 1 or more"),
            "sheet": (self.sheet >= 0, "mm, 0 or more"),
            "modulus": (self.modulus > 0, "N/mm^2, more than 0"),
            "friction": (self.friction >= 0, "a coefficient, 0 or more"),
            "scatter": (0 <= self.scatter <= _SCATTER_MAX, "radians, 0 to those of 20 degrees"),
            "air_gap": (self.air_gap >= 0, "mm, 0 or more"),
            "asymmetry": (0 <= self.asymmetry <= 1, "a share, 0 to 1"),
            "asymmetry_azimuth": (True, "radians"),
        }
        for name, (holds, range_) in rules.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and holds):
                raise InputError(
                    f"{name.replace('_', ' ')} {value} of the sensor's body cannot be: give {range_}"
                )

    @property
    def radius(self) -> float:
        """Half the diameter, mm."""
        return self.diameter / 2
