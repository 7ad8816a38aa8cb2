"""Heights of a full rectangle by a direct solver: cosine modes of its rows and columns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.height_variance import expected_misfit, find_rectangle_variance
from mirrorskin.engine.integration.validation import Floats, Inputs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device

Doubles = NDArray[np.float64]
Whole = NDArray[np.int32]

HALF = 8
"""Pairs of modes that go together."""

SLOTS = 2 * HALF
"""Modes of a strip of the spectrum; see ``rectangle.cl``."""

_RADICES = 13, 11, 7, 5, 3  # the odd ones; see ``rectangle.cl``
_RARE = 7  # and more: kernels for others take fewer registers
_PIECE = 16, 256  # rows and columns of an item that is a core's loop, when it goes over pixels
_SAMPLED = 64  # rows of which one is looked at, whether a picture is full
_STIFF = 100.0  # times a link's that known heights weigh, above which float32 has too few digits
_LANES = 8  # lines side by side in a vector, where an item is a core's loop
_LEAST_ROOM, _MOST_ROOM = 256, 4096  # complex numbers in a group's own memory; where there are more, none are


@dataclass(frozen=True, slots=True)
class Plan:
    """Tables for the transforms of lines of one length, as the kernels take them."""

    length: int  # points of a line
    size: int  # points of the Fourier transform that does it: as many, or those of a convolution
    steps: Whole  # (S, 2), int32: radices, and how far apart the points are that they add
    roots: Doubles  # (size, 2), float64: roots of 1, real and imaginary parts
    place: Whole  # (modes, 2), int32: where modes k and length - k come out
    turns: Doubles  # (modes, 2), float64: cosine and sine of k's quarter turns, pi k / (2 length)
    # Empty where no convolution is needed: (length, 2), float64: what points and modes are multiplied by; and
    # (size, 2), float64: Fourier transform of the convolution's other factor, in the order of the modes.
    chirp: Doubles
    other: Doubles


def make_plan(length: int) -> Plan:
    """Return the tables for lines of so many points."""
    size, mode = length, np.arange(-(-(length // 2 + 1) // HALF) * HALF)
    pairs = np.stack([mode % length, -mode % length], axis=1)
    chirp, other = (np.empty(0, complex),) * 2
    radices = find_radices(length)
    if radices is not None:
        pairs = _order(radices)[pairs]
    else:
        size = min(odd << (-(-2 * length // odd) - 1).bit_length() for odd in (1, 3, 5))
        radices = find_radices(size) or []
        chirp = np.exp(-1j * np.pi * (np.arange(length) ** 2 % (2 * length)) / length)
        both = np.zeros(size, complex)
        both[:length] = chirp.conj()
        both[size - length + 1 :] = chirp[:0:-1].conj()
        other = np.empty(size, complex)
        other[_order(radices)] = np.fft.fft(both) / size
    steps = np.stack([radices, size // np.cumprod(radices, dtype=np.int64)], axis=1)
    tables = np.exp(-2j * np.pi * np.arange(size) / size), np.exp(0.5j * np.pi * mode / length), chirp, other
    roots, turns, chirps, others = (np.stack([one.real, one.imag], axis=-1) for one in tables)
    return Plan(length, size, steps.astype(np.int32), roots, pairs.astype(np.int32), turns, chirps, others)


def find_radices(length: int) -> list[int] | None:
    """Return the steps of a Fourier transform; None where a prime factor is too large."""
    odd = []
    for radix in _RADICES:
        while length % radix == 0:
            odd.append(radix)
            length //= radix
    twos = length.bit_length() - 1
    return [4] * (twos // 2) + odd + [2] * (twos % 2) if length == 1 << twos else None


def _order(radices: list[int]) -> NDArray[np.intp]:
    """Return where each mode is when all steps are done: its digits, the other way round."""
    place = np.zeros(1, np.intp)
    for radix in reversed(radices):
        place = (place[:, np.newaxis] + place.size * np.arange(radix)).ravel()
    return place


def find_modes(length: int) -> Whole:
    """Return the modes of a row's slots, (strips, 16); those that mean nothing are never 0."""
    low = np.arange(-(-(length // 2 + 1) // HALF) * HALF, dtype=np.int32).reshape(-1, HALF)
    return np.concatenate([np.minimum(low, length), np.maximum(length - low, 1)], axis=1)


class Rectangle:
    """Solver of A u = b for heights u, where all pixels of a picture are there and all links alike.

    A is the Laplacian of the pixels' graph: (A u)_i is the sum of w (u_i - u_j) over the neighbours j, with
    one weight w along x and one along y; a screening may be added on its diagonal. The picture's cosine modes
    are its eigenvectors (Simchony et al., IEEE PAMI 12, 1990). It is exact but for rounding, and takes any
    shape.

    Links along x have the weight scale / width^2, those along y scale / height^2, of pixels of a width and
    height. Several pictures, (R, H, W), are solved at once. It needs one map of the picture's size, and one
    thread at a time.
    """

    def __init__(
        self, shape: tuple[int, ...], pixel_size: tuple[float, float], device: Device, scale: float = 1.0
    ) -> None:
        self._device, self._shape = device, shape
        self.lanes = _LANES if device.layout.tile > 1 else 1
        self._pictures, (rows, columns) = math.prod(shape[:-2]), shape[-2:]
        self._weights = scale / pixel_size[0] ** 2, scale / pixel_size[1] ** 2
        plans = make_plan(columns), make_plan(rows)
        strips, at_once = len(plans[0].place) // HALF, 2 * self.lanes
        groups = -(-self._pictures * rows // at_once), strips * self._pictures * SLOTS // at_once
        self._spectrum = device.array("spectrum", (strips, groups[0] * at_once, SLOTS), np.float32)
        self._spectrum.upload()
        self._runs = [self._prepare(plan, count) for plan, count in zip(plans, groups, strict=True)]
        self._along = device.given("along", self._rates(find_modes(columns), columns, self._weights[0]))
        self._across: tuple[float, Array] | None = None
        self._deviation: tuple[float, Floats] | None = None

    def deviation(self, screening: float = 0.0) -> Floats:
        """Return the standard deviation of heights, (H, W), where weights are inverse variances; kept."""
        if self._deviation is None or self._deviation[0] != screening:
            rows, columns = self._shape[-2:]
            variance = find_rectangle_variance((rows, columns), self._weights, screening)
            self._deviation = screening, np.sqrt(variance)
        return self._deviation[1]

    def solve(self, source: Array, screening: float = 0.0, height: Array | None = None) -> Array:
        """Return heights, in a given array or a new one, for a right side and a screening.

        Their mean is 0: what the right side sums to is left out.
        """
        if self._across is None or self._across[0] != screening:
            rows = self._shape[-2]
            across = self._rates(np.arange(rows + 1), rows, self._weights[1], screening)
            self._across = screening, self._device.given("across", across)
        if height is None:
            height = self._device.array("height", self._shape, np.float32, zeroed=False)
            height.upload()
        lying, standing = self._runs
        spectrum: dict[str, Any] = {"spectrum": self._spectrum}
        lines, moved = {"rows": self._pictures * self._shape[-2], **spectrum}, 2 * self._spectrum.host.nbytes
        self._run("rectangle_modes", lying, moved, source=source, **lines)
        rates = {"along": self._along, "across": self._across[1]}
        self._run("rectangle_divide", standing, moved, pictures=self._pictures, **rates, **spectrum)
        self._run("rectangle_heights", lying, moved, height=height, **lines)
        return height

    def _rates(
        self, mode: NDArray[np.integer[Any]], length: int, weight: float, screening: float = 0.0
    ) -> Doubles:
        """Return what links along lines, a screening and all transforms make of a mode."""
        own = 4 * weight * np.sin(np.pi * mode / (2 * length)) ** 2 + screening
        return 4 * math.prod(self._shape[-2:]) * own

    def _prepare(self, plan: Plan, groups: int) -> tuple[int, dict[str, int], dict[str, Any]]:
        """Return how many groups go through a plan, the kernels' macros, and the plan on the device."""
        given, lanes, room = self._device.given, self.lanes, _MOST_ROOM
        if lanes == 1:
            room = max(_LEAST_ROOM, 1 << (plan.size - 1).bit_length())
        inside = plan.size <= room <= _MOST_ROOM
        outside = 1 if inside else groups * plan.size * 2 * lanes
        scratch = self._device.array("scratch", (outside,), np.float32)
        scratch.upload()
        tables = {name: given(name, getattr(plan, name)) for name in ("roots", "turns", "chirp", "other")}
        whole = {"plan": given("plan", plan.steps, np.int32), "place": given("place", plan.place, np.int32)}
        sizes = {"length": plan.length, "size": plan.size, "steps": len(plan.steps)}
        odd = int(plan.steps[:, 0].max(initial=0) >= _RARE)
        macros = {"LANES": lanes, "ROOM": room if inside else 0, "ODD": odd, "HEIGHTS": 0}
        padded = self._spectrum.host.shape[1]
        return groups, macros, {"padded": padded, **sizes, **whole, **tables, "scratch": scratch}

    def _run(
        self, name: str, run: tuple[int, dict[str, int], dict[str, Any]], moved: int, **arguments: Any
    ) -> None:
        groups, macros, plan = run
        kernel = self._device.kernel("rectangle", name, **macros)
        kernel(groups * kernel.group, **plan, **arguments, moved=moved)


def seems_full(inputs: Inputs) -> bool:
    """Tell whether all pixels have slopes and known heights that count alike; soon, by some of the rows."""
    maps = inputs.weight_x, inputs.edges, inputs.known_height_weights
    if any(one is not None for one in maps) or _screening(inputs) > _STIFF:
        return False
    if inputs.mask is not None and not inputs.mask.all():
        return False
    some = slice(None, None, _SAMPLED if min(inputs.shape) > 1 else 1)
    given = inputs.dz_dx, inputs.dz_dy, inputs.known_heights
    return all(bool(np.isfinite(one[some]).all()) for one in given if one is not None)


def _screening(inputs: Inputs) -> float:
    if inputs.known_heights is None:
        return 0.0
    return math.prod(inputs.pixel_size) / inputs.typical_weight * inputs.known_height_weight


class SlopeRectangle:
    """Heights from slopes in pictures of one shape and pixel size that seem full. One thread at a time."""

    def __init__(self, shape: tuple[int, int], pixel_size: tuple[float, float], device: Device) -> None:
        self._device, self._shape, self._size = device, shape, pixel_size
        self._area = math.prod(pixel_size)
        self._weights = self._area / pixel_size[0] ** 2, self._area / pixel_size[1] ** 2
        self._solver = Rectangle(shape, pixel_size, device, self._area)
        rows, columns = shape
        width = _PIECE[1] if device.layout.tile > 1 else 1
        self._items = -(-rows // _PIECE[0]) * -(-columns // width)
        self._source = device.array("source", shape, np.float32)
        self._sums = device.array("sums", (self._items,), np.float32)
        for array in (self._source, self._sums):
            array.upload()

    def solve(self, inputs: Inputs, sigma: bool) -> tuple[Floats, Floats | None] | None:
        """Return heights, (H, W), mm, and their standard deviation if wanted; None where one is missing."""
        (width, height), (along, across) = self._size, self._weights
        maps: dict[str, Any] = {
            name: self._device.seen(name, getattr(inputs, name)) for name in ("dz_dx", "dz_dy")
        }
        screening = _screening(inputs)
        if inputs.known_heights is not None:
            maps |= {"heights": self._device.seen("heights", inputs.known_heights), "weight_z": screening}
        factors = {"x": along * width / 24, "y": -across * height / 24}
        self._run("rectangle_source", **maps, **factors, source=self._source)
        relief = self._solver.solve(self._source, screening)
        if sigma:
            weights = {"weight_x": along, "weight_y": across, "size_x": width, "size_y": height}
            self._run("rectangle_misfit", **maps, **weights, relief=relief, sums=self._sums)
        found: Floats = relief.detach()
        if not math.isfinite(found[0, 0]):  # what is no number anywhere is so everywhere
            return None
        deviation = self._deviation(inputs, screening) if sigma else None
        if inputs.known_heights is not None:
            found += np.float32(inputs.datum)
        return found, deviation

    def _deviation(self, inputs: Inputs, screening: float) -> Floats:
        """Return the heights' standard deviation; by how well slopes fit, where no weights were given."""
        (rows, columns), scale = self._shape, self._area / inputs.typical_weight
        factor = scale
        if not inputs.weights_given:
            links, pixels = rows * (columns - 1) + (rows - 1) * columns, rows * columns
            known, free = (pixels, 0) if inputs.known_heights is not None else (0, 1)
            unit = expected_misfit(links, pixels, known, free, self._weights)
            misfit = float(self._sums.download().sum(dtype=np.float64)) / scale
            factor *= misfit / unit if unit > 0 else math.nan
        return self._solver.deviation(screening) * np.float32(factor**0.5)

    def _run(self, name: str, **arguments: Any) -> None:
        rows, columns = self._shape
        macros = {"HEIGHTS": int("heights" in arguments)}
        moved = 12 * rows * columns
        kernel = self._device.kernel("rectangle", name, LANES=self._solver.lanes, ROOM=0, ODD=0, **macros)
        kernel(self._items, rows=rows, columns=columns, **arguments, moved=moved)
