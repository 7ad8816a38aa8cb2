"""What the camera sees in the mirror: the lit wall."""

from mirrorskin.hw.twin.optics.ideal import Ideal, design_range
from mirrorskin.hw.twin.optics.pattern import (
    PATTERN_NAMES,
    Linear,
    Pattern,
    Picture,
    Uniform,
    linear_pattern,
    make_pattern,
)
from mirrorskin.hw.twin.optics.visible import visible_zenith
from mirrorskin.hw.twin.optics.wall import Wall

__all__ = [
    "PATTERN_NAMES",
    "Ideal",
    "Linear",
    "Pattern",
    "Picture",
    "Uniform",
    "Wall",
    "design_range",
    "linear_pattern",
    "make_pattern",
    "visible_zenith",
]
