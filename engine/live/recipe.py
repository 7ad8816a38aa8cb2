"""Recipes of a touch: how many press steps and turn frames a requested standard deviation needs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

PRESS_STEPS = 2, 30
"""Least and greatest number of press steps of a recipe."""
TURN_FRAMES = 4, 24
"""Least and greatest number of frames of a turn."""

_CERTAIN = 1.81  # integral of phi^2 / (Phi (1 - Phi)): information of one boundary, in 1 / blur
_HIGHEST = 8.0  # greatest eigenvalue of the Laplacian of a grid of unit spacing
# Of the boundaries, in the variance of the common height. Where the object is aligned with the pixels, each
# boundary counts once: 1. Where it crosses them, errors along a boundary average out: more.
_COMMON_POWER = 1.5
_AT_BORDER = 2.0  # variance at a straight border, relative to the inside: the mirror image of the errors

VarianceOf = Callable[[int, int], float]
"""Variance of a height, mm², from the numbers of press steps and turn frames."""


@dataclass(frozen=True)
class Recipe:
    """Frames of a touch, and what is expected of them.

    Attributes
    ----------
    press_steps, turn_frames : int
        Steps of the press from the last frame without contact, and frames of the turn.
    sigma : float
        Expected standard deviation of heights, mm.
    seconds : float
        Expected duration.
    """

    press_steps: int
    turn_frames: int
    sigma: float
    seconds: float = math.nan

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.press_steps + self.turn_frames

    def __str__(self) -> str:
        return (
            f"{self.press_steps} press steps and {self.turn_frames} turn frames, {self.seconds:.1f} s,"
            f" {1e3 * self.sigma:.2g} µm"
        )


@dataclass(frozen=True)
class Contact:
    """What determines the standard deviation of a touch before its turn.

    Attributes
    ----------
    pixel_size : float
        mm.
    noise : float
        Standard deviation of a sample, counts.
    gain : float
        Counts per radian of zenith.
    tilt : float
        Half-angle of the turn, radians.
    zenith : float
        Typical zenith of the pixels in contact, radians.
    depth : float
        Travel from the first contact to the deepest place, mm.

    Examples
    --------
    >>> contact = Contact(0.05, noise=1.5, gain=360.0, tilt=0.044, zenith=0.4, depth=0.6)
    >>> few, many = contact.variance(4, 4), contact.variance(16, 16)
    >>> few > many
    True
    >>> recipe = cheapest(contact.variance, 0.005)
    >>> recipe.press_steps, recipe.turn_frames, recipe.sigma < 0.005
    (3, 4, True)
    """

    pixel_size: float
    noise: float
    gain: float
    tilt: float
    zenith: float
    depth: float

    @property
    def rise(self) -> float:
        """Standard deviation of the surface within a pixel, mm."""
        return self.pixel_size * math.tan(self.zenith) / math.sqrt(12)

    def variance_of_turn(self, press_steps: int, turn_frames: int) -> float:
        """Return the variance by the noise of the slopes, at a border, mm²."""
        root = math.sqrt(turn_frames)
        along = self.noise / (self.gain * root * math.cos(self.zenith) ** 2)
        across = math.tan(self.zenith) * self.noise * math.sqrt(2) / (self.gain * self.tilt * root)
        step = self.pixel_size**2 * along * across
        known = _CERTAIN * _boundaries(press_steps) / (self.depth * max(self.rise, 1e-9))
        return _AT_BORDER * step / (4 * math.pi) * math.log1p(_HIGHEST / (known * step))

    def variance(self, press_steps: int, turn_frames: int) -> float:
        """Return the variance of a height, mm², from a number of press steps and turn frames."""
        return self.variance_of_turn(press_steps, turn_frames) + self.rise**2 * _common(press_steps)


@dataclass(frozen=True)
class Measured:
    """Variance of the heights of a touch, from which that of more frames is predicted.

    Attributes
    ----------
    press_steps, turn_frames : int
        Numbers of frames so far.
    variance : float
        That of the requested share of the pixels, mm².
    of_turn : float
        Part of it that turn frames reduce; press steps reduce the rest.
    """

    press_steps: int
    turn_frames: int
    variance: float
    of_turn: float

    def after(self, press_steps: int, turn_frames: int) -> float:
        """Return the variance that is expected of more frames."""
        of_turn = min(self.of_turn, self.variance)
        rest = (self.variance - of_turn) * _common(press_steps) / _common(self.press_steps)
        return of_turn * self.turn_frames / turn_frames + rest


def cheapest(variance: VarianceOf, sigma: float, least: tuple[int, int] = (0, 0)) -> Recipe | None:
    """Return the recipe with the fewest frames that is expected to suffice; None if there is none.

    Parameters
    ----------
    variance : callable
        Of the numbers of press steps and turn frames, mm².
    sigma : float
        Requested standard deviation, mm.
    least : (int, int)
        Press steps and turn frames that were taken already.
    """
    recipes = [
        Recipe(press, turn, math.sqrt(variance(press, turn)))
        for press in range(max(PRESS_STEPS[0], least[0]), max(PRESS_STEPS[1], least[0]) + 1)
        for turn in range(max(TURN_FRAMES[0], least[1]), max(TURN_FRAMES[1], least[1]) + 1)
    ]
    enough = [recipe for recipe in recipes if recipe.sigma <= sigma]
    return min(enough, key=lambda recipe: (recipe.frames, recipe.sigma), default=None)


def _boundaries(press_steps: int) -> int:
    """Return the number of boundaries between the terraces of a press: its last frame shows none."""
    return max(1, press_steps - 1)


def _common(press_steps: int) -> float:
    """Return the variance of the common height, relative to that of one boundary."""
    return float(_boundaries(press_steps) ** -_COMMON_POWER)
