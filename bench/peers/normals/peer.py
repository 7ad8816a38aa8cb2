"""What a peer can be asked about a turn of axial rotation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.rotation.design_matrix import fit_matrix
from mirrorskin.kernels.normals import Limits, contact_limits

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

LOOKS = 2  # Gauss-Newton steps
ODD = np.uint8(
    2
)  # in a contact map for now: a sample is clipped or missing, and needs more than the usual steps
REACH = 0.25  # longest step, radians
NO_ANSWER = np.float32(1)  # standard error in radians from which on nothing is known
LEAST = np.float32(1e-12)  # least square of a sine that is divided by
LEVEL = np.float32(1e-20)  # square of a sine below which a normal has no azimuth
ARCSINE = tuple(
    np.float32(term) for term in (15 / 336, 3 / 40, 1 / 6)
)  # of the seventh power, fifth and third


class Normals(NamedTuple):
    """The answers of one turn: (H, W), and (H, W, 3) of the vectors."""

    vectors: Floats
    sigma: Floats
    contact: NDArray[np.uint8]
    mean: Floats

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> Normals:
        """Return room for the maps of a picture."""
        sigma, mean = np.empty((2, *shape), np.float32)
        return cls(np.empty((*shape, 3), np.float32), sigma, np.empty(shape, np.uint8), mean)

    def flat(self) -> Normals:
        """Return the same maps with pixels in one row."""
        plain = self.sigma.reshape(-1), self.contact.reshape(-1), self.mean.reshape(-1)
        return Normals(self.vectors.reshape(-1, 3), *plain)

    def of(self, pixels: slice) -> Normals:
        """Return those of some pixels, of maps with pixels in one row."""
        return Normals(self.vectors[pixels], self.sigma[pixels], self.contact[pixels], self.mean[pixels])


@dataclass(frozen=True)
class Turn:
    """What is known of a turn before its frames are looked at.

    Attributes
    ----------
    phase : ndarray, (N,), float64
        Radians.
    tilt : float
        Radians.
    offset, gain, noise : float
        Counts at zenith 0, counts per radian, standard deviation of a sample in counts.
    low, high : float
        Counts up to which and from which on samples are clipped.
    """

    phase: Doubles
    tilt: float
    offset: float
    gain: float
    noise: float
    low: float = -np.inf
    high: float = np.inf

    @cached_property
    def fit(self) -> Doubles:
        """What makes mean, cosine and sine of samples, (3, N)."""
        return fit_matrix(self.phase)

    @cached_property
    def axes(self) -> Doubles:
        """The body's axis in each frame, (N, 3)."""
        return self._axes(self.tilt)

    @cached_property
    def slants(self) -> Doubles:
        """What the axes lose as the tilt grows, (N, 3): their derivative, with its sign turned."""
        return self._axes(self.tilt - np.pi / 2)

    def _axes(self, tilt: float) -> Doubles:
        lean, upright = np.sin(tilt), np.cos(tilt)
        alpha = self.phase
        return np.stack([-lean * np.cos(alpha), -lean * np.sin(alpha), np.full_like(alpha, upright)], axis=1)

    @property
    def error(self) -> float:
        """Standard deviation of a sample in radians."""
        return self.noise / abs(self.gain)

    @cached_property
    def limits(self) -> Limits:
        """Up to where residuals are those of a lasting contact."""
        return contact_limits(len(self.phase) - 3, self.tilt)

    @property
    def most(self) -> float:
        """The largest sum of squared residuals in contact, square radians."""
        return self.limits.noise * self.error**2 + self.limits.model

    @property
    def still(self) -> float:
        """The least tilt that shows in contact, radians."""
        return self.limits.still

    @property
    def wild(self) -> float:
        """The largest tilt that shows in contact, radians."""
        return self.limits.most

    @property
    def rest(self) -> float:
        """The least mean of the zeniths in contact, radians."""
        return self.limits.rest

    def zenith(self, counts: NDArray[Any]) -> Doubles:
        """Return the angles that counts tell."""
        return (np.asarray(counts, np.float64) - self.offset) / self.gain


def tables(turn: Turn, dtype: np.dtype[Any]) -> tuple[Floats, Floats] | None:
    """Return cosine and sine of the angle that each possible count tells; None of floats."""
    if dtype.kind == "f":
        return None
    zenith = turn.zenith(np.arange(np.iinfo(dtype).max + 1))
    return np.cos(zenith).astype(np.float32), np.sin(zenith).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Peer:
    """One way to compute normals.

    Attributes
    ----------
    name : str
    normals : callable
        ``(frames, turn)`` to the maps.
    """

    name: str
    normals: Callable[[NDArray[Any], Turn], Normals]
