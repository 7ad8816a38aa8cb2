"""Heights of a full rectangle by a direct solver: cosine modes along lines, elimination across them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.height_variance import find_rectangle_variance
from mirrorskin.engine.integration.validation import Floats
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]
Whole = NDArray[np.int32]

MOST_RADIX = 31
"""The largest prime factor that is a step of its own."""

HALF = 8
"""Pairs of modes that go together."""

SLOTS = 2 * HALF
"""Modes of a strip of the spectrum; see ``rectangle.cl``."""

_LANES = 8  # lines side by side in a vector, where an item is a core's loop
_MOST_ROOM = 4096  # complex numbers in an item's own memory; where a transform has more, none are
_CONSTANT = 2.0**-26  # relative change of a rate, below which it is taken for constant
_ASTRIDE = 18.0  # work, as `work_of` counts it, of going over the picture against the order in memory
_CHIRP_COST = 4.5  # of a transform by convolution, in those of a smooth length


@dataclass(frozen=True, slots=True)
class Plan:
    """Tables for the transforms of lines of one length, in the order in which the kernels take them."""

    length: int  # points of a line
    size: int  # points of the Fourier transform that does it: as many, or those of a convolution
    # (S, 3), int32: of each step its radix, the distance of the points that it adds, and where its factors
    # begin.
    steps: Whole
    # (N,), float64: of all steps: an odd radix' roots of 1, and the factors between the steps; real and
    # imaginary parts.
    factors: Doubles
    place: Whole  # (modes, 2), int32: where modes k and length - k come out
    turns: Doubles  # (modes, 2), float64: cosine and sine of k's quarter turns, pi k / (2 length)
    # (length, 2), float64: what points and modes are multiplied by for a convolution; empty where there is
    # none.
    chirp: Doubles
    # (size, 2), float64: fourier transform of the other factor of the convolution, in the order of the modes;
    # or empty.
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
        distance = size // radix
        point, mode = np.ogrid[:distance, 1:radix]
        roots = np.exp(-2j * np.pi * np.arange(radix if radix > 5 else 0) / radix)
        turns = np.exp(-2j * np.pi * point * mode / size)
        parts = _parts(np.concatenate([roots, turns.ravel()])).ravel()
        steps.append((radix, distance, begin))
        factors.append(parts)
        begin += parts.size
        size = distance
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


class Rectangle:
    """Solver of A u = b for heights u, where all pixels of a picture are there and all links alike.

    A is the Laplacian of the pixels' graph: (A u)_i is the sum of w (u_i - u_j) over the neighbours j, with
    one weight w along x and one along y; a screening may be added on its diagonal. Cosine modes along rows or
    columns, whichever are the easier, leave a tridiagonal system for each mode across them (Hockney, J. ACM
    12, 1965), which is solved by elimination. It is exact but for rounding, and takes any shape.

    Links along x have the weight scale / width^2, those along y scale / height^2, of pixels of a width and
    height. It needs two or four maps of the picture's size, and one thread at a time.
    """

    def __init__(
        self, shape: tuple[int, int], pixel_size: tuple[float, float], device: Device, scale: float = 1.0
    ) -> None:
        self._device = device
        self._lanes = _LANES if device.layout.tile > 1 else 1
        self._is_along = are_rows_easier(shape, side_by_side=self._lanes == 1)
        self._lines, length = shape if self._is_along else shape[::-1]
        weights = scale / pixel_size[0] ** 2, scale / pixel_size[1] ** 2
        self._along, self._across = weights if self._is_along else weights[::-1]
        self._plan = plan = make_plan(length)
        self._items = -(-self._lines // (2 * self._lanes))
        self._padded = 2 * self._lanes * self._items
        self._spectrum = self._make("spectrum", (len(plan.place) // HALF, self._padded, SLOTS))
        self._height = self._make("height", shape)
        self._scratch: dict[str, Any] = {}
        if self._lanes == 1 or plan.size > _MOST_ROOM:
            self._scratch["scratch"] = self._make("scratch", (2, self._items, plan.size, self._lanes))
        self._place = device.given("place", plan.place, np.int32)
        self._turns = device.given("turns", plan.turns)
        self._back = device.given("turns", plan.turns / (2 * length * self._across))
        steps, factors = device.given("steps", plan.steps, np.int32), device.given("factors", plan.factors)
        self._steps: dict[str, Any] = {"plan": steps, "factors": factors}
        chirps = {"chirp": plan.chirp, "other": plan.other}
        self._chirp: dict[str, Any] = {
            name: device.given("chirp", part) for name, part in chirps.items() if part.size
        }
        self._screening: float | None = None
        self._shape, self._held = shape, 0.0
        self._deviation: Floats | None = None

    def deviation(self, screening: float = 0.0) -> Floats:
        """Return the standard deviation of heights, (H, W), where weights are inverse variances; kept."""
        if screening != self._held or self._deviation is None:
            weights = (self._along, self._across) if self._is_along else (self._across, self._along)
            self._held = screening
            self._deviation = np.sqrt(find_rectangle_variance(self._shape, weights, screening))
        return self._deviation

    def solve(self, source: Array, screening: float = 0.0) -> Array:
        """Return heights, (H, W), for a right side b and a screening, in an array that the next call reuses.

        Without screening b must sum to 0 (a rest is taken from all pixels alike), and the mean of the heights
        is 0.
        """
        if screening != self._screening:
            weights = self._along, self._across, screening
            reach, fading, ends = find_rates(self._plan.length, self._lines, *weights)
            given = self._device.given
            rates = {"fading": given("fading", fading), "ends": given("ends", ends)}
            self._rates: dict[str, Any] = {"reach": given("reach", reach, np.int32), **rates}
            self._screening = screening
        moved = source.host.nbytes + self._spectrum.host.nbytes
        spectrum: dict[str, Any] = {"spectrum": self._spectrum}
        self._transform("rectangle_modes", moved, source=source, turns=self._turns, **spectrum)
        slots = self._spectrum.host.size // self._padded
        self._device.kernel("rectangle", "rectangle_columns", LANES=self._lanes)(
            slots if self._lanes == 1 else slots // SLOTS,
            lines=self._lines,
            padded=self._padded,
            slots=slots,
            level=screening == 0,
            **self._rates,
            **spectrum,
            moved=2 * self._spectrum.host.nbytes,
        )
        self._transform("rectangle_heights", moved, turns=self._back, height=self._height, **spectrum)
        return self._height

    def _transform(self, name: str, moved: int, **arguments: Any) -> None:
        """Run one of the two kernels that go between points and modes."""
        room = 0 if self._scratch else _MOST_ROOM
        macros = {"LANES": self._lanes, "ROOM": room, "CHIRP": int(bool(self._chirp))}
        sizes = {"along": self._is_along, "lines": self._lines, "padded": self._padded}
        self._device.kernel("rectangle", name, **macros)(
            self._items,
            **sizes,
            length=self._plan.length,
            size=self._plan.size,
            place=self._place,
            steps=len(self._plan.steps),
            **self._steps,
            **self._chirp,
            **self._scratch,
            **arguments,
            moved=moved,
        )

    def _make(self, name: str, shape: tuple[int, ...]) -> Array:
        array = self._device.array(name, shape, np.float32)
        array.upload()
        return array


def are_rows_easier(shape: tuple[int, int], *, side_by_side: bool) -> bool:
    """Tell whether cosine modes are to be taken along rows; lanes side by side read columns together."""
    rows, columns = (work_of(length) for length in shape)
    return columns + _ASTRIDE <= rows if side_by_side else columns <= rows + _ASTRIDE


def find_rates(
    length: int, lines: int, along: float, across: float, screening: float
) -> tuple[NDArray[np.int32], Doubles, Doubles]:
    """Return the elimination of all modes' tridiagonal systems as ``rectangle_columns`` takes it.

    Of each strip of modes where its rates begin and how many there are, the rates, and those of the last
    line; for lines of a length, with weights of the links along and across them.
    """
    low = np.arange(-(-(length // 2 + 1) // HALF) * HALF).reshape(-1, HALF)
    mode = np.clip(np.concatenate([low, length - low], axis=1), 0, length)
    weights = 4 * along * np.sin(np.pi * mode / (2 * length)) ** 2 + screening
    bend = 2 * np.arcsinh(np.sqrt(weights / across) / 2)
    with np.errstate(divide="ignore"):
        lines_to_constant = -np.log(_CONSTANT) / (2 * bend.min(axis=1))
    depth = np.ceil(np.clip(lines_to_constant, 1, lines)).astype(int)
    fading = [
        _fading(strip, np.arange(count)[:, np.newaxis]) for strip, count in zip(bend, depth, strict=True)
    ]
    last = _fading(bend, lines - 1)
    ends = np.divide(1 - last, last, out=np.zeros_like(last), where=last > 0)
    reach = np.stack([np.cumsum(depth) - depth, depth], axis=1).astype(np.int32)
    return reach, np.concatenate(fading), ends


def _fading(bend: Doubles, line: NDArray[np.int_] | int) -> Doubles:
    """Return 1 - c_r / c_(r+1) at line r, c_r = cosh((r + 1/2) bend), without its cancellation."""
    once, often = np.expm1(-bend), np.expm1(-(2 * line + 2) * bend)
    return np.asarray(once * often / (1 + (1 + once) * (1 + often)))
