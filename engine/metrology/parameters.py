"""Texture parameters of ISO 25178-2 and ISO 21920-2: what they are, and how noise and scale change them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

AREAL, PROFILE = "ISO 25178-2", "ISO 21920-2"

Noise = Literal["amplitude", "extreme", "shape", "ratio", "plain"]
"""How noise changes a parameter.

"amplitude": its square is linear in the variance of the noise, as that of Sq. "extreme": the same, but it is
determined by few heights. "shape": it is divided by a power of Sq (Ssk, Sku). "ratio": it depends on the form
of the distribution of heights. "plain": it is linear in the variance, if the noise is small.
"""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A texture parameter.

    Attributes
    ----------
    group : str
        Heading under which it is listed.
    unit : str
    meaning : str
    standard : str
    noise : {"amplitude", "extreme", "shape", "ratio", "plain"}
        See `Noise`.
    pixel_power : int
        Power of the pixel size that it is proportional to.
    """

    group: str
    unit: str
    meaning: str
    standard: str = AREAL
    noise: Noise = "amplitude"
    pixel_power: int = 0


_HEIGHT, _SPATIAL, _HYBRID = "texture: height", "texture: spatial", "texture: hybrid"
FUNCTIONAL, VOLUME, _LINE = "texture: material ratio", "texture: volume", "profile"

PARAMETERS: dict[str, Parameter] = {
    "Sa": Parameter(_HEIGHT, "µm", "arithmetical mean height"),
    "Sq": Parameter(_HEIGHT, "µm", "root mean square height"),
    "Sz": Parameter(_HEIGHT, "µm", "maximum height", noise="extreme"),
    "Sp": Parameter(_HEIGHT, "µm", "maximum peak height", noise="extreme"),
    "Sv": Parameter(_HEIGHT, "µm", "maximum pit depth", noise="extreme"),
    "Ssk": Parameter(_HEIGHT, "", "skewness", noise="shape"),
    "Sku": Parameter(_HEIGHT, "", "kurtosis", noise="shape"),
    "Sal": Parameter(_SPATIAL, "mm", "autocorrelation length", noise="plain", pixel_power=1),
    "Str": Parameter(_SPATIAL, "", "texture aspect ratio", noise="plain"),
    "Std": Parameter(_SPATIAL, "deg", "texture direction", noise="plain"),
    "Sdq": Parameter(_HYBRID, "", "root mean square gradient", pixel_power=-1),
    "Sdr": Parameter(_HYBRID, "%", "developed interfacial area ratio", noise="plain", pixel_power=-2),
    "Sk": Parameter(FUNCTIONAL, "µm", "core height"),
    "Spk": Parameter(FUNCTIONAL, "µm", "reduced peak height", noise="extreme"),
    "Svk": Parameter(FUNCTIONAL, "µm", "reduced dale height", noise="extreme"),
    "Smr1": Parameter(FUNCTIONAL, "%", "material ratio of the hills", noise="ratio"),
    "Smr2": Parameter(FUNCTIONAL, "%", "material ratio above the dales", noise="ratio"),
    "Vmp": Parameter(VOLUME, "ml/m2", "peak material volume", noise="extreme"),
    "Vmc": Parameter(VOLUME, "ml/m2", "core material volume"),
    "Vvc": Parameter(VOLUME, "ml/m2", "core void volume"),
    "Vvv": Parameter(VOLUME, "ml/m2", "dale void volume", noise="extreme"),
}
"""Areal parameters by name."""

_PROFILE = {
    "a": Parameter(_LINE, "µm", "arithmetic mean height", PROFILE),
    "q": Parameter(_LINE, "µm", "root mean square height", PROFILE),
    "z": Parameter(_LINE, "µm", "maximum height, mean of the section lengths", PROFILE, "extreme"),
    "t": Parameter(_LINE, "µm", "total height", PROFILE, "extreme"),
    "sk": Parameter(_LINE, "", "skewness", PROFILE, "shape"),
    "ku": Parameter(_LINE, "", "kurtosis", PROFILE, "shape"),
    "Sm": Parameter(_LINE, "mm", "mean spacing of profile elements", PROFILE, "plain", 1),
}

PARAMETERS |= {f"{kind}{name}": parameter for kind in "RP" for name, parameter in _PROFILE.items()}
"""R of the roughness profile, with an L-filter; P of the primary profile, without."""
