"""Direct solver for a full rectangle with uniform weights, by cosine transforms of rows and columns."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.height_variance import expected_misfit, find_rectangle_variance
from mirrorskin.engine.integration.validation import Floats, Inputs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device, Kernel

Whole = NDArray[np.intp]

_RADICES = 13, 11, 7, 5, 3  # odd radices; see ``rectangle.cl``
_RARE = 7  # smallest radix that needs a kernel with more registers
_PIECE = 16, 256  # rows and columns of a work-item on a CPU
_SAMPLED = 64  # step of the rows that are checked for missing slopes
_STIFF = 100.0  # weight of known heights relative to links above which float32 is not accurate enough
_LANES = 8  # adjacent lines in a vector on a CPU
_LEAST_ROOM, _MOST_ROOM = 256, 4096  # complex numbers in local memory; longer lines use global memory

Table = NDArray[np.float64] | NDArray[np.intp]


def make_plan(length: int, lanes: int) -> dict[str, Table]:
    """Return the tables for transforms of lines of a length, by the names of the kernels' arguments.

    ``plan``, (S, 2): radix and distance of the points of each step. ``roots``, (size, 2): roots of unity.
    ``place``, (modes, 2): indices of modes k and length - k in the output. ``turns``, (modes, 2): cosine and
    sine of pi k / (2 length). A length with a large prime factor is computed as a convolution of a larger
    size (Bluestein): ``chirp``, (length, 2), multiplies points and modes; ``other``, (size, 2), is the
    Fourier transform of the second factor, in the order of the output. Complex numbers are pairs.
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
        filter_ = np.zeros(size, complex)
        filter_[:length] = chirp.conj()
        filter_[size - length + 1 :] = chirp[:0:-1].conj()
        other = np.empty(size, complex)
        other[_order(radices)] = np.fft.fft(filter_) / size
    plan = np.stack([radices, size // np.cumprod(radices, dtype=np.intp)], axis=1).astype(np.intp)
    roots, turns = np.exp(-2j * np.pi * np.arange(size) / size), np.exp(0.5j * np.pi * mode / length)
    numbers = {"roots": roots, "turns": turns, "chirp": chirp, "other": other}
    parts = {name: np.stack([values.real, values.imag], axis=-1) for name, values in numbers.items()}
    return {"plan": plan, "place": place, **parts}


def find_radices(length: int) -> list[int] | None:
    """Return the radices of a Fourier transform; None if a prime factor is too large."""
    odd = []
    for radix in _RADICES:
        while length % radix == 0:
            odd.append(radix)
            length //= radix
    twos = length.bit_length() - 1
    return [4] * (twos // 2) + odd + [2] * (twos % 2) if length == 1 << twos else None


def _order(radices: list[int]) -> NDArray[np.intp]:
    """Return the index of each mode in the output: digit reversal."""
    place = np.zeros(1, np.intp)
    for radix in reversed(radices):
        place = (place[:, np.newaxis] + place.size * np.arange(radix)).ravel()
    return place


def find_modes(length: int, lanes: int) -> Whole:
    """Return the modes of a row's slots, (strips, 2 lanes); unused slots have a number other than 0."""
    low = np.arange(-(-(length // 2 + 1) // lanes) * lanes).reshape(-1, lanes)
    return np.concatenate([np.minimum(low, length), np.maximum(length - low, 1)], axis=1)


def seems_full(inputs: Inputs) -> bool:
    """Return whether all pixels have uniform weights, slopes and known heights, from a subset of rows."""
    maps = inputs.weight_x, inputs.edges, inputs.known_height_weights
    if any(weights is not None for weights in maps) or _screening(inputs) > _STIFF:
        return False
    if inputs.mask is not None and not inputs.mask.all():
        return False
    rows = slice(None, None, _SAMPLED if min(inputs.shape) > 1 else 1)
    values = inputs.dz_dx, inputs.dz_dy, inputs.known_heights
    # Data on a device are not checked: an undefined slope shows in the heights.
    return all(bool(np.isfinite(map_[rows]).all()) for map_ in values if isinstance(map_, np.ndarray))


def _screening(inputs: Inputs) -> float:
    if inputs.known_heights is None:
        return 0.0
    return math.prod(inputs.pixel_size) / inputs.typical_weight * inputs.known_height_weight


class Rectangle:
    """Direct solver of A u = b for heights u of a full picture with uniform links.

    A is the Laplacian of the pixels' graph: (A u)_i is the sum of w (u_i - u_j) over the neighbours j, with
    one weight w along x and another along y, plus a screening on the diagonal. Its eigenvectors are the
    cosine modes (Simchony et al., IEEE PAMI 12, 1990). The solution is exact except for rounding.

    Links along x have the weight scale / width^2, links along y scale / height^2, with the pixel's width and
    height. Several pictures, (R, H, W), are solved at once. One thread at a time may use the object.
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
        self._runs = [self._prepare(columns, groups[0]), self._prepare(rows, groups[1])]
        self._along = device.from_host("along", self._rates(modes, columns, self._weights[0]))
        self._across: tuple[float, Array] | None = None  # screening, and eigenvalues along y
        self._deviation: tuple[float, Floats] | None = None  # screening, and standard deviation
        self._work: tuple[Array, Array] | None = None  # right side, and partial sums

    def solve(self, source: Array, screening: float = 0.0, height: Array | None = None) -> Array:
        """Return heights, in a given array or a new one, for a right side and a screening.

        Without screening their mean is 0; the mean of the right side is ignored.
        """
        if self._across is None or self._across[0] != screening:
            rows = self.shape[-2]
            across = self._rates(np.arange(rows + 1), rows, self._weights[1], screening)
            self._across = screening, self._device.from_host("across", across)
        if height is None:
            height = self._device.array("height", self.shape, np.float32, zeroed=False)
        rates = {"along": self._along, "across": self._across[1]}
        self._transform("rectangle_modes", 0, rows=math.prod(self.shape[:-1]), source=source)
        self._transform("rectangle_divide", 1, pictures=math.prod(self.shape[:-2]), **rates)
        self._transform("rectangle_heights", 0, rows=math.prod(self.shape[:-1]), height=height)
        return height

    def integrate(self, inputs: Inputs, sigma: bool) -> tuple[Any, Floats | None] | None:
        """Return heights, mm, from slopes, and their standard deviation, (H, W), if ``sigma``.

        The heights are on the device if the slopes are. None if a slope or a known height is missing. The
        scale must be the area of a pixel.
        """
        (width, height), (along, across), screening = self._size, self._weights, _screening(inputs)
        names = [name for name in ("dz_dx", "dz_dy", "known_heights") if getattr(inputs, name) is not None]
        maps: dict[str, Any] = {name: self._device.share(name, getattr(inputs, name)) for name in names}
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
        on_device = isinstance(inputs.dz_dx, Array)
        heights: Any = relief if on_device else relief.release()
        first = relief.read(0) if on_device else heights[..., 0, 0]
        if not np.isfinite(first).all():  # one undefined slope makes all heights undefined
            return None
        deviation = None
        if sigma:
            factor = math.prod(self._size) / inputs.typical_weight
            if not inputs.weights_given:
                misfit = float(sums.read().sum(dtype=np.float64)) / pictures
                factor *= self._excess(misfit / factor, len(names) > 2)
            deviation = self.deviation(screening) * np.float32(factor**0.5)
        if not on_device:
            heights += np.float32(inputs.datum)
        return heights, deviation

    def deviation(self, screening: float = 0.0) -> Floats:
        """Return the standard deviation of heights, (H, W), if weights are inverse variances; cached."""
        if self._deviation is None or self._deviation[0] != screening:
            rows, columns = self.shape[-2:]
            variance = find_rectangle_variance((rows, columns), self._weights, screening)
            self._deviation = screening, np.sqrt(variance)
        return self._deviation[1]

    def _excess(self, misfit: float, anchored: bool) -> float:
        """Return the misfit over that expected for noise of variance 1; NaN without a loop of links."""
        rows, columns = self.shape[-2:]
        links, pixels = rows * (columns - 1) + (rows - 1) * columns, rows * columns
        unit = expected_misfit(links, pixels, pixels * anchored, int(not anchored), self._weights)
        return misfit / unit if unit > 0 else math.nan

    def _rates(
        self, mode: NDArray[np.integer[Any]], length: int, weight: float, screening: float = 0.0
    ) -> Doubles:
        """Return the eigenvalues of modes along lines, times the factor of all transforms."""
        eigenvalue = 4 * weight * np.sin(np.pi * mode / (2 * length)) ** 2 + screening
        return 4 * math.prod(self.shape[-2:]) * eigenvalue

    def _prepare(self, length: int, groups: int) -> tuple[int, dict[str, int], dict[str, Any]]:
        """Return the number of work-groups for lines of a length, the kernels' macros, and their tables."""
        tables = make_plan(length, self._lanes)
        steps, size, capacity = len(tables["plan"]), len(tables["roots"]), _MOST_ROOM
        if self._lanes == 1:
            capacity = max(_LEAST_ROOM, 1 << (size - 1).bit_length())
        inside = size <= capacity <= _MOST_ROOM
        scratch = self._array("scratch", (1 if inside else groups * size * 2 * self._lanes,))
        odd = int(tables["plan"][:, 0].max(initial=0) >= _RARE)
        arrays = {
            name: self._device.from_host(name, table, np.int32 if table.dtype == np.intp else np.float32)
            for name, table in tables.items()
        }
        macros = {"LANES": self._lanes, "ROOM": capacity if inside else 0, "ODD": odd}
        sizes = {"length": length, "size": size, "steps": steps}
        return groups, macros, {**sizes, **arrays, "scratch": scratch}

    def _transform(self, name: str, axis: int, **arguments: Any) -> None:
        """Run a transform of rows (axis 0) or columns (axis 1)."""
        groups, _, tables = self._runs[axis]
        kernel, spectrum = self._kernel(name, axis), self._spectrum
        tables |= {"padded": spectrum.shape[1], "spectrum": spectrum}
        kernel(groups * kernel.group, **tables, **arguments, moved=2 * spectrum.nbytes)

    def _kernel(self, name: str, axis: int, **macros: int) -> Kernel:
        return self._device.kernel("rectangle", name, **{**self._runs[axis][1], "KNOWN": 0, **macros})

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        return self._device.array(name, shape, np.float32)
