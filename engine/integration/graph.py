"""The graph that heights live on: pixels, links between neighbours, and its connected components."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.engine.integration.validation import Flags, Floats, Inputs
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.links import DOWN, KNOWN, RIGHT, SLOPE

Plane = tuple[float, float, float]
"""Slopes along x and y, and the height of the top left pixel, mm."""

LEVEL: Plane = (0.0, 0.0, 0.0)
_CHUNK, _STRIP = 256, 16  # columns and rows of a work-item that is a core's loop; see links.cl
_SAMPLES = 64  # along each side of the picture, to tell how it leans


@dataclass(frozen=True, slots=True)
class Links:
    """A weighted least-squares problem on the pixels' graph: sum w (u_j - u_i - d)^2 + sum a (u_i - k_i)^2.

    Its normal equations are A u = b; everything lies on the device, and belongs to it by now.

    Attributes
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.
    right, down : Array, (H, W), float32
        Weight w of the link to the pixel on the right, and to the one below; 0 where there is none.
    anchor : Array, (H, W), float32, or None
        Weight a of a known height; 0 where there is none. None without any.
    source : Array, (H, W), float32
        Right side b: of each pixel the sum of -w d over links that leave it and w d over those that end in
        it, and a k.
    """

    device: Device
    shape: tuple[int, int]
    right: Array
    down: Array
    anchor: Array | None
    source: Array


@dataclass(frozen=True, slots=True)
class Graph:
    """The links of a picture, and what it takes to read their heights.

    Attributes
    ----------
    links : Links
    flags : ndarray, (H, W), uint8
        What the pixels are; see ``mirrorskin.kernels.links``. The device's memory.
    scale : float
        By what the weights were multiplied to be about 1.
    plane : (float, float, float)
        What the heights are relative to, besides the inputs' datum.
    """

    links: Links
    flags: Flags
    scale: float
    plane: Plane


class LinkRoom:
    """Room on a device for a picture's maps and their links; what was allocated is used again.

    Parameters
    ----------
    device : Device
    shape : (int, int)
        Rows and columns.

    Attributes
    ----------
    scale : float
        By what the weights were multiplied to be about 1.
    flags : Array, (H, W), uint8
        What the pixels are; see ``mirrorskin.kernels.links``.
    heights : list of Array, (H, W), float32
        Known heights above the inputs' datum, and their weights; empty without any.
    """

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        self.device = device
        self.shape = shape
        self.heights: list[Array] = []
        self._arrays: dict[str, Array] = {}

    def take(self, inputs: Inputs) -> Flags:
        """Bring maps to the device; return what the pixels are.

        The flags are those of the device, and only good until the next call.
        """
        self._inputs = inputs
        self.scale = inputs.pixel_size[0] * inputs.pixel_size[1] / inputs.typical
        self._slopes = self.put("dz_dx", inputs.dz_dx), self.put("dz_dy", inputs.dz_dy)
        mask = self._put_some(mask=inputs.mask)
        self._weights = self._put_some(weight_x=inputs.weight_x, weight_y=inputs.weight_y)
        self.heights = self._put_some(heights=inputs.heights, height_weights=inputs.height_weights)
        self._macros = {
            "MASK": len(mask),
            "WEIGHTS": len(self._weights),
            "HEIGHTS": len(self.heights),
            "KEEP": 0,
        }
        edges = self._put_some(edges=inputs.edges)
        self._flag(mask, edges)
        flags: Flags = self.flags.download()
        return flags

    def adopt(self, inputs: Inputs, *maps: str) -> None:
        """Take maps that are on the device already, in arrays of this room: slopes, and weights.

        Parameters
        ----------
        inputs : Inputs
            Whose maps, slopes and two of weights, are not looked at.
        *maps : str
            Names of the arrays, in that order.
        """
        self._inputs = inputs
        self.scale = inputs.pixel_size[0] * inputs.pixel_size[1] / inputs.typical
        dz_dx, dz_dy, *self._weights = (self._make(name, np.float32) for name in maps)
        self._slopes, self.heights = (dz_dx, dz_dy), []
        self._macros = {"MASK": 0, "WEIGHTS": len(self._weights), "HEIGHTS": 0, "KEEP": 0}
        self._flag([], [])

    def array(self, name: str) -> Array:
        """Return one of the room's arrays of floats, (H, W)."""
        return self._make(name, np.float32)

    def _flag(self, mask: list[Array], edges: list[Array]) -> None:
        """Tell what the pixels are."""
        self.flags = self._make("flags", np.uint8)
        uncut = self._make("uncut", np.uint8) if edges else self.flags
        self._run("links_flags", *self._slopes, *mask, *self._weights, *self.heights, uncut)
        if edges:
            self._run("links_cut", *self._slopes, *edges, uncut, self.flags)

    def lean(self) -> Plane:
        """Return a plane that leans with the slopes, 0 in the middle: above it, heights have more digits."""
        some = tuple(slice(step // 2, None, step) for step in (-(-size // _SAMPLES) for size in self.shape))
        known = self.flags.host[some] & SLOPE != 0
        if not known.any():
            return LEVEL
        x, y = (float(slope[some][known].mean()) for slope in (self._inputs.dz_dx, self._inputs.dz_dy))
        rise = self.rise((x, y, 0.0))
        return x, y, -(rise[0] * (self.shape[1] - 1) + rise[1] * (self.shape[0] - 1)) / 2

    def rise(self, plane: Plane) -> Plane:
        """Return how much a plane rises from column to column and row to row, and where it begins, mm."""
        width, height = self._inputs.pixel_size
        return plane[0] * width, -plane[1] * height, plane[2]

    def join(self, plane: Plane = LEVEL) -> Links:
        """Return the links of heights above a plane."""
        right, down = self._make("right", np.float32), self._make("down", np.float32)
        anchor = self._make("anchor", np.float32) if self.heights else None
        kept = [right, down] if anchor is None else [right, down, anchor]
        source = self._make("source", np.float32)
        arguments, _ = self._graph(plane, None)
        self._run("links_join", *arguments, *kept, source, KEEP=1)
        return Links(self.device, self.shape, right, down, anchor, source)

    def ask(self, plane: Plane = LEVEL, links: Links | None = None) -> Array:
        """Return the right side alone, for weights that a solver has: those of ``links``, if there are."""
        source = self._make("source", np.float32)
        arguments, macros = self._graph(plane, links)
        self._run("links_join", *arguments, source, **macros)
        return source

    def misfit(self, relief: Array, plane: Plane = LEVEL, links: Links | None = None) -> float:
        """Return the sum that is made least, without unit, at heights above a plane."""
        sums = self._make("sums", np.float32, (self._items("links_misfit"),))
        arguments, macros = self._graph(plane, links)
        self._run("links_misfit", *arguments, relief, sums, **macros)
        return float(sums.download().sum(dtype=np.float64)) / self.scale

    def smooth(self, values: NDArray[np.float32], steps: int) -> NDArray[np.float32]:
        """Return values, (H, W), averaged along links: of each step a fifth goes to each linked neighbour."""
        here, there = self.put("values", values), self._make("smoothed", np.float32)
        for _ in range(steps):
            self._run("links_smooth", self.flags, here, there)
            here, there = there, here
        smoothed: NDArray[np.float32] = here.download().copy()
        return smoothed

    def disturb(self, x: Floats, y: Floats, z: Floats) -> None:
        """Put noise, (H, W), in place of the slopes and, where there are any, of the known heights."""
        names = ["dz_dx", "dz_dy", "heights"][: 3 if self.heights else 2]
        for name, noise in zip(names, (x, y, z), strict=False):
            self.put(name, noise)

    def _graph(self, plane: Plane, links: Links | None) -> tuple[list[Array | float], dict[str, int]]:
        """Return the arguments of what goes over links, and its macros."""
        inputs = self._inputs
        width, height = inputs.pixel_size
        weights, maps, macros = (
            [self.scale * inputs.weight / size**2 for size in (width, height)],
            self._weights,
            {},
        )
        if links is not None:
            weights, maps, macros = [1.0, 1.0], [links.right, links.down], {"WEIGHTS": 3}
        numbers = *weights, self.scale * inputs.height_weight, width, height, *plane
        return [*self._slopes, self.flags, *maps, *self.heights, *numbers], macros

    def _put_some(self, **maps: NDArray[np.generic] | None) -> list[Array]:
        return [self.put(name, values) for name, values in maps.items() if values is not None]

    def put(self, name: str, values: NDArray[np.generic]) -> Array:
        """Return an array on the device that holds values, (H, W)."""
        array = self._make(name, values.dtype)
        array.claim()
        array.host[...] = values
        array.upload()
        return array

    def _make(self, name: str, dtype: DTypeLike, shape: tuple[int, ...] | None = None) -> Array:
        if name not in self._arrays:
            self._arrays[name] = self.device.array(name, shape or self.shape, dtype)
            self._arrays[name].upload()
        return self._arrays[name]

    def _items(self, name: str) -> int:
        """Return how many work-items a kernel takes; see there."""
        (rows, columns), tile = self.shape, self.device.layout.tile
        strip = _STRIP if tile >= _CHUNK and name in ("links_flags", "links_join", "links_misfit") else 1
        return -(-rows // strip) * -(-columns // min(tile, _CHUNK))

    def _run(self, name: str, *arguments: float | Array | np.generic, **macros: int) -> None:
        sizes = [np.int32(size) for size in self.shape]
        values = [np.float32(one) if isinstance(one, float) else one for one in arguments]
        moved = sum(one.host.nbytes for one in values if isinstance(one, Array))
        kernel = self.device.kernel("links", name, **{**self._macros, **macros})
        kernel(self._items(name), *sizes, *values, moved=moved)


Labels = NDArray[np.int32]

_CHUNK = 256  # columns of a work-item that is a core's loop; see components.cl
_STRIPS = 64  # pieces of the picture that are summed alone
_MOST_SUMS = 1 << 22  # of all strips and components


@dataclass(frozen=True, slots=True)
class Components:
    """The connected pieces of a surface.

    Attributes
    ----------
    labels : ndarray, (H, W), int32
        Numbered in reading order of their first pixels; -1 where there is no answer.
    offset_unknown : ndarray, (components,), bool
        Whether a piece has no known height.
    """

    labels: Labels
    offset_unknown: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.offset_unknown)


def find_components(flags: Flags, cut: bool) -> Components:
    """Tell apart what links hold together.

    Parameters
    ----------
    flags : ndarray, (H, W), uint8
        What the pixels are; see ``mirrorskin.kernels.links``.
    cut : bool
        Whether there may be neighbours with an answer but no link.
    """
    answered = np.asarray(flags & (SLOPE | KNOWN), np.uint8)
    labels, count = _label_cut(flags, answered) if cut else _label(answered)
    unknown = np.ones(count, bool)
    unknown[labels[flags & KNOWN != 0]] = False
    for told in (labels, unknown):  # surfaces of the same picture share them
        told.flags.writeable = False
    return Components(labels, unknown)


def _label(answered: Flags) -> tuple[Labels, int]:
    count, numbers = cv2.connectedComponents(answered, connectivity=4, ltype=cv2.CV_32S)
    labels = np.asarray(numbers, np.int32)
    labels -= 1
    return labels, count - 1


def _label_cut(flags: Flags, answered: Flags) -> tuple[Labels, int]:
    """Label a doubled grid: pixels at even places, links between them."""
    rows, columns = flags.shape
    doubled = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
    doubled[::2, ::2] = answered
    doubled[::2, 1::2] = (flags & RIGHT)[:, :-1]
    doubled[1::2, ::2] = (flags & DOWN)[:-1]
    labels, count = _label(doubled)
    return np.ascontiguousarray(labels[::2, ::2]), count


class Settler:
    """Brings relief to its height: above its plane, and each piece on its own offset.

    Parameters
    ----------
    room : LinkRoom
        Whose flags say where there are answers.
    """

    def __init__(self, room: LinkRoom) -> None:
        self._room, self._device = room, room.device
        self._labels: Array | None = None
        self._arrays: dict[str, Array] = {}
        self._components: Components | None = None

    def take(self, components: Components) -> None:
        """Work on these pieces from now on."""
        if components is self._components:
            return
        self._components = components
        if components.count > 1:
            self._labels = self._labels or self._device.array("labels", components.labels.shape, np.int32)
            self._labels.claim()
            self._labels.host[...] = components.labels
            self._labels.upload()

    def settle(self, relief: Array, plane: Plane, datum: float) -> NDArray[np.float32]:
        """Return heights, (H, W), mm.

        The mean of a piece without a known height is 0. The others are where their known heights, which are
        above ``datum``, want them: where these weigh little, a solver is done long before it is there.
        """
        unknown = self._pieces.offset_unknown
        offsets = self._make("offsets", unknown.shape)
        offsets.claim()
        for some, maps, level in ((unknown, [], 0.0), (~unknown, self._room.heights, datum)):
            if some.any():
                offsets.host[some] = level - self._means(relief, plane, maps)[some]
        offsets.upload()
        height = self._device.array("settled", self._room.shape, np.float32)
        self._settle(relief, plane, offsets, height)
        settled: NDArray[np.float32] = height.hand_over()
        return settled

    def launch(self, relief: Array, plane: Plane) -> Array:
        """Put on the queue what ``settle`` does where no height is known.

        Returns
        -------
        Array, (H, W), float32
            Heights, until the next launch.
        """
        count, rows = self._pieces.count, self._room.shape[0]
        strip = self._strip(count)
        strips = -(-rows // strip)
        sums = [self._grow(name, strips * count) for name in ("live sums", "live totals")]
        self._run("components_sum", strips, relief, plane, [np.int32(strip), np.int32(count), *sums])
        offsets = self._grow("live offsets", count)
        kernel = self._device.kernel("components", "components_level")
        kernel(count, np.int32(strips), np.int32(count), *sums, offsets, moved=8 * strips * count)
        height = self._make("live heights", self._room.shape)
        self._settle(relief, plane, offsets, height)
        return height

    def _means(self, relief: Array, plane: Plane, maps: list[Array]) -> NDArray[np.float64]:
        """Return by how much each piece is above 0, or above what is known of it, (components,), mm."""
        count, rows = self._pieces.count, self._room.shape[0]
        strip = self._strip(count)
        strips = -(-rows // strip)
        sums = [self._make(name, (strips, count)) for name in ("sums", "totals")]
        numbers = np.int32(strip), np.int32(count)
        self._run("components_sum", strips, relief, plane, [*maps, *numbers, *sums], HEIGHTS=len(maps))
        sum_, total = (part.download().sum(axis=0, dtype=np.float64) for part in sums)
        return np.asarray(np.divide(sum_, total, out=np.zeros(count), where=total > 0))

    def _strip(self, count: int) -> int:
        """Return the rows of a piece of the picture that is summed alone, for so many components."""
        rows = self._room.shape[0]
        return max(-(-rows // _STRIPS), -(-rows * count // _MOST_SUMS))

    def _settle(self, relief: Array, plane: Plane, offsets: Array, height: Array) -> None:
        rows, columns = self._room.shape
        items = rows * -(-columns // min(self._device.layout.tile, _CHUNK))
        self._run("components_settle", items, relief, plane, [offsets, height])

    @property
    def labels(self) -> Labels:
        """The pieces' numbers, (H, W)."""
        return self._pieces.labels

    @property
    def _pieces(self) -> Components:
        if self._components is None:
            raise RuntimeError("take pieces first")
        return self._components

    def _make(self, name: str, shape: tuple[int, ...]) -> Array:
        if name not in self._arrays or self._arrays[name].host.shape != shape:
            self._arrays[name] = self._device.array(name, shape, np.float32)
            self._arrays[name].upload()
        return self._arrays[name]

    def _grow(self, name: str, size: int) -> Array:
        """Return room for so many numbers or more: pieces come and go from frame to frame."""
        known = self._arrays.get(name)
        if known is None or known.host.size < size:
            return self._make(name, (2 * size,))
        return known

    def _run(
        self,
        name: str,
        items: int,
        relief: Array,
        plane: Plane,
        rest: list[Array | np.generic],
        **macros: int,
    ) -> None:
        one = self._pieces.count == 1
        labels = self._room.flags if one or self._labels is None else self._labels
        sizes = [np.int32(size) for size in self._room.shape]
        rise = [np.float32(value) for value in self._room.rise(plane)]
        kernel = self._device.kernel("components", name, **{"ONE": int(one), "HEIGHTS": 0, **macros})
        kernel(items, *sizes, self._room.flags, labels, relief, *rise, *rest, moved=2 * relief.host.nbytes)
