"""The sensor's body and the wall around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mirrorskin.io.base.types import InputError

_SCATTER_MAX = math.radians(20.0)


@dataclass(frozen=True, slots=True)
class Body:
    """A cylinder of transparent silicone with a mirror sheet at its end, inside a lit wall (paper 2.2).

    The wall is a Lambert sheet behind a patterned one, lit from behind by two ring lamps; it extends from the
    sheet's rest plane to the body's top.

    Attributes
    ----------
    diameter, height : float
        Millimetres; the paper's body is 35 across and 40 high.
    index : float
        Refractive index of the silicone.
    sheet : float
        Thickness of the material between mirror and object, mm.
    modulus : float
        Young's modulus, N/mm^2; the silicone is incompressible (Poisson ratio 0.5).
    friction : float
        Coulomb's coefficient between sheet and object.
    scatter : float
        Largest deviation of a reflected ray by the sheet's flakes, radians.
    air_gap : float
        Between body and wall, mm; 0 is optical contact.
    asymmetry, asymmetry_azimuth : float
        Relative difference of the lamps between the two sides, and azimuth of the brighter side, radians.

    Raises
    ------
    InputError
        A value is invalid.
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
            "diameter": (0 < self.diameter < math.inf, "mm, more than 0"),
            "height": (0 < self.height < math.inf, "mm, more than 0"),
            "index": (1 <= self.index < math.inf, "a refractive index, 1 or more"),
            "sheet": (0 <= self.sheet < math.inf, "mm, 0 or more"),
            "modulus": (0 < self.modulus < math.inf, "N/mm^2, more than 0"),
            "friction": (0 <= self.friction < math.inf, "a coefficient, 0 or more"),
            "scatter": (0 <= self.scatter <= _SCATTER_MAX, "radians, at most 20 degrees"),
            "air_gap": (0 <= self.air_gap < math.inf, "mm, 0 or more"),
            "asymmetry": (0 <= self.asymmetry <= 1, "a share, 0 to 1"),
            "asymmetry_azimuth": (math.isfinite(self.asymmetry_azimuth), "radians"),
        }
        check_values(self, "sensor's body", rules)

    @property
    def radius(self) -> float:
        """Half the diameter, mm."""
        return self.diameter / 2


def check_values(owner: object, what: str, rules: dict[str, tuple[bool, str]]) -> None:
    """Raise InputError for the first invalid attribute; rules contain whether it is valid, and what is."""
    for name, (holds, remedy) in rules.items():
        if not holds:
            value = getattr(owner, name)
            raise InputError(f"{name.replace('_', ' ')} {value} of the {what} is not possible: give {remedy}")
