"""Which pixels hang together, and at which height each piece of surface stands."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.links import LinkRoom, Plane
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.links import DOWN, KNOWN, RIGHT, SLOPE

Labels = NDArray[np.int32]
Flags = NDArray[np.uint8]

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
