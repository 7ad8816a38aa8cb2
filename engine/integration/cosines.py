"""How a device goes about cosine transforms of any length: the tables that ``rectangle.cl`` reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Whole = NDArray[np.int32]

MOST_RADIX = 31
"""The largest prime factor that is a step of its own."""

HALF = 8
"""Pairs of modes that go together."""

_CHIRP_COST = 4.5  # of a transform by convolution, in those of a smooth length


@dataclass(frozen=True, slots=True)
class Plan:
    """Tables for the transforms of lines of one length, in the order in which the kernels take them.

    Attributes
    ----------
    length : int
        Points of a line.
    size : int
        Points of the Fourier transform that does it: as many, or those of a convolution.
    steps : ndarray, (S, 3), int32
        Of each step its radix, the distance of the points that it adds, and where its factors begin.
    factors : ndarray, (N,), float64
        Of all steps: an odd radix' roots of 1, and the factors between the steps; real and imaginary parts.
    place : ndarray, (modes, 2), int32
        Where modes k and length - k come out.
    turns : ndarray, (modes, 2), float64
        Cosine and sine of k's quarter turns, pi k / (2 length).
    chirp : ndarray, (length, 2), float64
        What points and modes are multiplied by for a convolution; empty where there is none.
    other : ndarray, (size, 2), float64
        Fourier transform of the other factor of the convolution, in the order of the modes; or empty.
    """

    length: int
    size: int
    steps: Whole
    factors: Doubles
    place: Whole
    turns: Doubles
    chirp: Doubles
    other: Doubles


def make_plan(length: int) -> Plan:
    """Return the tables for lines of so many points."""
    radices = find_radices(length)
    size = length if radices else _size_of_convolution(length)
    radices = radices or find_radices(size)
    steps, factors = _steps(radices)
    order = _order(radices)
    mode = np.arange(-(-(length // 2 + 1) // HALF) * HALF)
    pairs = np.stack([mode % length, -mode % length], axis=1)
    turn = np.exp(0.5j * np.pi * mode / length)
    chirp, other = (np.empty(0, complex),) * 2
    if size != length:
        chirp = np.exp(-1j * np.pi * (np.arange(length) ** 2 % (2 * length)) / length)
        other = np.empty(size, complex)
        other[order] = _transform_of_chirp(chirp, size)
    else:
        pairs = order[pairs]
    return Plan(length, size, steps, factors, pairs.astype(np.int32), *map(_parts, (turn, chirp, other)))


def work_of(length: int) -> float:
    """Return about how much work a transform is for each of its points; to choose between two lengths."""
    radices = find_radices(length)
    if not radices:
        return _CHIRP_COST * work_of(_size_of_convolution(length)) if length > 1 else 0.0
    return sum({2: 1.5, 4: 2.0}.get(radix, 1.0 + radix / 2) for radix in radices)


def find_radices(length: int) -> list[int]:
    """Return the steps of a Fourier transform; none where a prime factor is too large, or for one point."""
    rest, odd = length, []
    for radix in range(3, MOST_RADIX + 1, 2):
        while rest % radix == 0:
            odd.append(radix)
            rest //= radix
    twos = rest.bit_length() - 1
    if rest != 1 << twos:
        return []
    fours = [4] * (twos // 2)
    return fours[:1] + odd[::-1] + [2] * (twos % 2) + fours[1:]


def _size_of_convolution(length: int) -> int:
    """Return the cheapest length that two factors of that length, one of them with both signs, fit in."""
    least = 2 * length - 1
    sizes = [odd << max(0, (-(-least // odd) - 1).bit_length()) for odd in (1, 3, 5, 9, 15)]
    return min(sizes, key=lambda size: size * work_of(size)) if length > 1 else 1


def _steps(radices: list[int]) -> tuple[Whole, Doubles]:
    """Return the steps, (S, 3), and the factors that they use."""
    size = int(np.prod(radices, dtype=np.int64))
    steps, factors, begin = [], [np.empty(0)], 0
    for radix in radices:
        apart = size // radix
        point, mode = np.ogrid[:apart, 1:radix]
        roots = np.exp(-2j * np.pi * np.arange(radix if radix > 5 else 0) / radix)
        turns = np.exp(-2j * np.pi * point * mode / size)
        parts = _parts(np.concatenate([roots, turns.ravel()])).ravel()
        steps.append((radix, apart, begin))
        factors.append(parts)
        begin += parts.size
        size = apart
    return np.asarray(steps, np.int32).reshape(-1, 3), np.concatenate(factors)


def _order(radices: list[int]) -> NDArray[np.intp]:
    """Return where each mode is when all steps are done: its digits, the other way round."""
    place = np.zeros(1, np.intp)
    for radix in reversed(radices):
        place = (place[:, np.newaxis] + place.size * np.arange(radix)).ravel()
    return place


def _transform_of_chirp(chirp: NDArray[np.complex128], size: int) -> NDArray[np.complex128]:
    """Return the Fourier transform of the conjugate chirp to both sides, divided by the size."""
    both = np.zeros(size, complex)
    both[: len(chirp)] = chirp.conj()
    both[size - len(chirp) + 1 :] = chirp[:0:-1].conj()
    return np.asarray(np.fft.fft(both) / size)


def _parts(values: NDArray[np.complex128]) -> Doubles:
    """Return real and imaginary parts side by side, (N, 2)."""
    return np.stack([values.real, values.imag], axis=-1)
