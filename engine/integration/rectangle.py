"""Heights of a full rectangle by a direct solver: cosine modes of its rows and columns."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.height_variance import expected_misfit, find_rectangle_variance
from mirrorskin.engine.integration.validation import Floats, Inputs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device, Kernel

Doubles = NDArray[np.float64]
Whole = NDArray[np.intp]

_RADICES = 13, 11, 7, 5, 3  # the odd ones; see ``rectangle.cl``
_RARE = 7  # and more: kernels for others take fewer registers
_PIECE = 16, 256  # rows and columns of an item that is a core's loop, when it goes over pixels
_SAMPLED = 64  # rows of which one is looked at, whether a picture is full
_STIFF = 100.0  # times a link's that known heights weigh, above which float32 has too few digits
_LANES = 8  # lines side by side in a vector, where an item is a core's loop
_LEAST_ROOM, _MOST_ROOM = 256, 4096  # complex numbers in a group's own memory; where there are more, none are


Table = NDArray[np.float64] | NDArray[np.intp]


def make_plan(length: int, lanes: int) -> dict[str, Table]:
    """Return the tables for transforms of lines of so many points, by the kernels' names of them.

    ``plan``, (S, 2), are radices and how far apart the points are that they add, ``roots``, (size, 2), those
    of 1. ``place``, (modes, 2), is where modes k and length - k come out, ``turns``, (modes, 2), cosine and
    sine of pi k / (2 length). A length with a large prime factor takes a convolution of a larger size:
    ``chirp``, (length, 2), is what points and modes are multiplied by, ``other``, (size, 2), the Fourier
    transform of its other factor, in the order of the modes. All complex numbers are in two parts.
    """
    size, mode = length, np.arange(find_modes(length, lanes).size // 2)
    place, radices = np.stack([mode % length, -mode % length], axis=1), find_radices(length)
    chirp, other = (np.empty(0, complex),) * 2
    if radices is not None:
        place = _order(radices)[place]
    else:
        size = min(odd << (-(-2 * length // odd) - 1).bit_length() for odd in (1, 3, 5))
        radices = find_radices(size) or []
        chirp = np.exp(-1j * np.pi * (np.arange(length) ** 2 % (2 * length)) / length)
        both = np.zeros(size, complex)
        both[:length] = chirp.conj()
        both[size - length + 1 :] = chirp[:0:-1].conj()
        other = np.empty(size, complex)
        other[_order(radices)] = np.fft.fft(both) / size
    plan = np.stack([radices, size // np.cumprod(radices, dtype=np.intp)], axis=1).astype(np.intp)
    roots, turns = np.exp(-2j * np.pi * np.arange(size) / size), np.exp(0.5j * np.pi * mode / length)
    numbers = {"roots": roots, "turns": turns, "chirp": chirp, "other": other}
    parts = {name: np.stack([one.real, one.imag], axis=-1) for name, one in numbers.items()}
    return {"plan": plan, "place": place, **parts}


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


def find_modes(length: int, lanes: int) -> Whole:
    """Return the modes of a row's slots, (strips, 2 lanes); those that mean nothing are never 0."""
    low = np.arange(-(-(length // 2 + 1) // lanes) * lanes).reshape(-1, lanes)
    return np.concatenate([np.minimum(low, length), np.maximum(length - low, 1)], axis=1)


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

    shape: tuple[int, ...]

    def __init__(
        self, shape: tuple[int, ...], pixel_size: tuple[float, float], device: Device, scale: float = 1.0
    ) -> None:
        self._device, self.shape, self._size = device, shape, pixel_size
        self._lanes = _LANES if device.layout.tile > 1 else 1
        self._weights = scale / pixel_size[0] ** 2, scale / pixel_size[1] ** 2
        pictures, (rows, columns), at_once = math.prod(shape[:-2]), shape[-2:], 2 * self._lanes
        modes = find_modes(columns, self._lanes)
        groups = -(-pictures * rows // at_once), pictures * modes.size // at_once
        self._spectrum = self._array("spectrum", (len(modes), groups[0] * at_once, at_once))
        self._runs = [self._prepare(*one) for one in zip((columns, rows), groups, strict=True)]
        self._along = device.given("along", self._rates(modes, columns, self._weights[0]))
        self._across: tuple[float, Array] | None = None
        self._deviation: tuple[float, Floats] | None = None
        self._work: tuple[Array, Array] | None = None  # right side, and partial sums

    def solve(self, source: Array, screening: float = 0.0, height: Array | None = None) -> Array:
        """Return heights, in a given array or a new one, for a right side and a screening.

        Their mean is 0: what the right side sums to is left out.
        """
        if self._across is None or self._across[0] != screening:
            rows = self.shape[-2]
            across = self._rates(np.arange(rows + 1), rows, self._weights[1], screening)
            self._across = screening, self._device.given("across", across)
        if height is None:
            height = self._device.array("height", self.shape, np.float32, zeroed=False)
            height.upload()
        rates = {"along": self._along, "across": self._across[1]}
        self._transform("rectangle_modes", 0, rows=math.prod(self.shape[:-1]), source=source)
        self._transform("rectangle_divide", 1, pictures=math.prod(self.shape[:-2]), **rates)
        self._transform("rectangle_heights", 0, rows=math.prod(self.shape[:-1]), height=height)
        return height

    def integrate(self, inputs: Inputs, sigma: bool) -> tuple[Floats, Floats | None] | None:
        """Return heights, mm, from slopes, and if wanted their standard deviation, (H, W).

        None where a slope or a known height turns out to be missing. The scale must be a pixel's area.
        """
        (width, height), (along, across), screening = self._size, self._weights, _screening(inputs)
        names = [name for name in ("dz_dx", "dz_dy", "known_heights") if getattr(inputs, name) is not None]
        maps: dict[str, Any] = {name: self._device.seen(name, getattr(inputs, name)) for name in names}
        if len(names) > 2:
            maps["weight_z"] = screening
        pictures, (rows, columns) = math.prod(self.shape[:-2]), self.shape[-2:]
        tile = _PIECE if self._lanes > 1 else (_PIECE[0], 1)
        items = pictures * -(-rows // tile[0]) * -(-columns // tile[1])
        if self._work is None:
            self._work = self._array("source", self.shape), self._array("sums", (items,))
        source, sums = self._work

        def run(name: str, **arguments: Any) -> None:
            kernel = self._kernel(name, 0, KNOWN=int(len(names) > 2))
            sizes = {"pictures": pictures, "rows": rows, "columns": columns}
            kernel(items, **sizes, **maps, **arguments, moved=3 * source.nbytes)

        run("rectangle_source", x=along * width / 24, y=-across * height / 24, source=source)
        relief = self.solve(source, screening)
        if sigma:
            weights = {"weight_x": along, "weight_y": across, "size_x": width, "size_y": height}
            run("rectangle_misfit", **weights, relief=relief, sums=sums)
        found: Floats = relief.detach()
        if not np.isfinite(found[..., 0, 0]).all():  # what is no number anywhere is so everywhere
            return None
        deviation = None
        if sigma:
            factor = math.prod(self._size) / inputs.typical_weight
            if not inputs.weights_given:
                misfit = float(sums.download().sum(dtype=np.float64)) / pictures
                factor *= self._excess(misfit / factor, len(names) > 2)
            deviation = self.deviation(screening) * np.float32(factor**0.5)
        found += np.float32(inputs.datum)
        return found, deviation

    def deviation(self, screening: float = 0.0) -> Floats:
        """Return the standard deviation of heights, (H, W), where weights are inverse variances; kept."""
        if self._deviation is None or self._deviation[0] != screening:
            rows, columns = self.shape[-2:]
            variance = find_rectangle_variance((rows, columns), self._weights, screening)
            self._deviation = screening, np.sqrt(variance)
        return self._deviation[1]

    def _excess(self, misfit: float, known: bool) -> float:
        """Return how much worse slopes fit than noise of variance 1 would; NaN where nothing tells."""
        rows, columns = self.shape[-2:]
        links, pixels = rows * (columns - 1) + (rows - 1) * columns, rows * columns
        unit = expected_misfit(links, pixels, pixels * known, int(not known), self._weights)
        return misfit / unit if unit > 0 else math.nan

    def _rates(
        self, mode: NDArray[np.integer[Any]], length: int, weight: float, screening: float = 0.0
    ) -> Doubles:
        """Return what links along lines, a screening and all transforms make of a mode."""
        own = 4 * weight * np.sin(np.pi * mode / (2 * length)) ** 2 + screening
        return 4 * math.prod(self.shape[-2:]) * own

    def _prepare(self, length: int, groups: int) -> tuple[int, dict[str, int], dict[str, Any]]:
        """Return how many groups transform lines of a length, the kernels' macros, and their tables."""
        tables = make_plan(length, self._lanes)
        steps, size, room = len(tables["plan"]), len(tables["roots"]), _MOST_ROOM
        if self._lanes == 1:
            room = max(_LEAST_ROOM, 1 << (size - 1).bit_length())
        inside = size <= room <= _MOST_ROOM
        scratch = self._array("scratch", (1 if inside else groups * size * 2 * self._lanes,))
        odd = int(tables["plan"][:, 0].max(initial=0) >= _RARE)
        arrays = {
            name: self._device.given(name, one, np.int32 if one.dtype == np.intp else np.float32)
            for name, one in tables.items()
        }
        macros = {"LANES": self._lanes, "ROOM": room if inside else 0, "ODD": odd}
        sizes = {"length": length, "size": size, "steps": steps}
        return groups, macros, {**sizes, **arrays, "scratch": scratch}

    def _transform(self, name: str, way: int, **arguments: Any) -> None:
        groups, _, tables = self._runs[way]
        kernel, spectrum = self._kernel(name, way), self._spectrum
        tables |= {"padded": spectrum.shape[1], "spectrum": spectrum}
        kernel(groups * kernel.group, **tables, **arguments, moved=2 * spectrum.nbytes)

    def _kernel(self, name: str, way: int, **macros: int) -> Kernel:
        return self._device.kernel("rectangle", name, **{**self._runs[way][1], "KNOWN": 0, **macros})

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        array = self._device.array(name, shape, np.float32)
        array.upload()
        return array
