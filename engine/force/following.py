"""Contacts near earlier ones, found on a device."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.force.blocks import Blocks
from mirrorskin.engine.force.halfspace import (
    GRADIENT_ERROR,
    HalfSpace,
    Mask,
    Pressed,
    Singles,
    Window,
    influences,
    overlap_outside,
    point_spectrum,
    punches,
    reach_of,
    window_of,
)
from mirrorskin.engine.force.tangential import ContactShear, inverse_spectra, tensor_spectra
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.device import Device
from mirrorskin.kernels.skin.contact import LANES, LOADS, NUMBERS, PLANES, WORK

_WIDE = 64  # columns of a contact above which loads are found by transforms
_GROWTH = 0.5  # maximum distance of a window's border from the contact, as a share of the contact's length
_MARGIN = 2  # blocks around a new window, so that it remains for some time
_SHRUNK, _SPARE = 0.7, 12  # share of a window's length, less these blocks, below which a smaller one is taken


class _Tables(NamedTuple):
    """Tables for windows of some columns, on the device; see `mirrorskin.kernels.skin.contact`."""

    basis: Array
    across: Array  # the basis, transposed
    weights: Array
    inverse: Array


class Maps(NamedTuple):
    """Maps of a result, float32, in C order."""

    height: Singles  # (H, W), mm
    sigma: Singles | None  # (H, W), mm
    displacement: Singles | None  # along x and y, (H, W, 2), mm
    displacement_sigma: Singles | None  # (H, W) or (H, W, 2), mm


class Sums(NamedTuple):
    """Sums over the blocks of the window; see `mirrorskin.kernels.skin.contact.contact_follow`."""

    pressure: float
    x: float
    y: float
    xx: float
    yy: float
    contact: float
    border: float
    changed: float  # since the first of the earlier contacts
    changed_later: float  # since the second
    later: float
    lost: float
    inverse_sigma: float
    lacking: list[float]
    covariance: list[float]
    displacements: list[float]
    displacement_variances: list[float]

    @classmethod
    def of(cls, numbers: list[float]) -> Sums:
        """Return the numbers of the kernel."""
        lists = numbers[12:15], numbers[15:21], numbers[21:23], numbers[23:]
        return cls._make([*numbers[:12], *lists])


class ContactFollower:
    """Averages maps over blocks, and finds their contacts near earlier ones, on a device.

    The model is that of `mirrorskin.engine.force.halfspace.press`.

    Attributes
    ----------
    window : (slice, slice)
        The blocks around the contact; all blocks that may touch are inside, unless they are far away.
    surface : ndarray, (rows, columns), float32
        Heights of all blocks, mm above the rest plane, NaN where there is none.
    contact : ndarray, (rows, columns), bool
    gap, strain : ndarray, (H, W), float32
        Of the blocks of the window: gap in contact, mm, and pressure over Young's modulus, also below 0.
    variance, moved, moved_variance : ndarray, (1 or 2, H, W), float32
        Near the contact, else 0: mean squares of the standard deviations of heights; means of displacements
        along x and y; and mean squares of their standard deviations.
    sums : Sums
    """

    window: Window
    surface: Singles
    contact: Mask
    gap: Singles
    strain: Singles
    variance: Singles
    moved: Singles
    moved_variance: Singles
    sums: Sums

    def __init__(self, blocks: Blocks, compliance: float, device: Device) -> None:
        self.blocks, self._space, self._device = blocks, blocks.space, device
        self.compliance, self._lift = compliance, compliance * blocks.space.pixel_area
        self._tables: dict[tuple[int, int], _Tables] = {}
        self._arrays: dict[tuple[str, tuple[int, ...]], Array] = {}
        self._is_same = 0  # 1 if nothing was written since the last contact was found
        self.reset()

    def reset(self) -> None:
        """Forget the last contact."""
        self.window = slice(0, 1), slice(0, 1)
        self._write(np.zeros((2, 1, 1), np.float32))

    def follow(self, maps: Maps, travel: float, loose: float, least: float) -> bool:
        """Average maps, find their contact near the last one, and return whether there is one.

        Gaps in contact, and overlaps elsewhere, are at most ``least``, mm, or ``loose`` times the greatest
        height if that is more; a block remains in contact if a pull that displaces it by less would be
        needed.
        """
        displacement_sigma = maps.displacement_sigma
        self._given: dict[str, Any] = {
            "sigma_kinds": int(maps.sigma is not None),
            "displacement_kinds": 0 if maps.displacement is None else 2,
            "displacement_sigma_kinds": 0 if displacement_sigma is None else displacement_sigma.ndim - 1,
        }
        for name, values in zip(Maps._fields, maps, strict=True):
            self._given[name] = None if values is None else self._device.share(name, values)
        self._given |= {"travel": travel, "loose": loose, "least": least}
        if not self._find():
            return False
        reach, strain = self.surface > 0, self._whole(self.strain)
        if self._place(self.contact, reach):
            self._write(np.stack([strain, self.contact])[(slice(None), *self.window)])
            if not self._find():
                return False
        outside = reach.copy()
        outside[self.window] = False
        if not outside.any():
            return True
        heights = np.where(np.isfinite(self.surface), self.surface, np.float32(-np.inf))
        tolerance = max(loose * float(heights.max()), least)
        strain = self._whole(self.strain)
        return not overlap_outside(
            self._space, heights, self.compliance, tolerance, strain, self.window
        ).any()

    def restart(self, pressed: Pressed) -> None:
        """Start from a press of the surface of the last maps."""
        self._place(pressed.contact, self.surface > 0)
        self._write(np.stack([pressed.strain, pressed.contact])[(slice(None), *self.window)])
        if not self._find():
            raise NotConverged("the contact was not found again")

    def weigh(self, loads: Singles) -> None:
        """Compute the sums with other loads, (`LOADS`, H, W), of the window."""
        self._loads = self._array("loads", (LOADS, *self.shape))
        self._loads.write(self._padded(loads))
        self._find()

    def load(self, forms: Singles, start: Singles) -> Singles:
        """Return the strains that move the contact by given forms, about 1 mm, (n, parts, rows, columns).

        Pressures have one part; tractions have two, along x and along rows. Maps are those of all blocks.
        """
        count, parts = start.shape[:2]
        rows, columns = _box(self.contact)
        if columns.stop - columns.start > _WIDE:
            return self._load_by_transforms(forms, start)
        columns = _rounded_slice(columns, self.contact.shape[1])
        shape, place = (rows.stop - rows.start, _rounded(columns.stop - columns.start)), (..., rows, columns)
        inside = ..., slice(columns.stop - columns.start)
        arrays = {}
        for name, values in (("contact", self.contact), ("forms", forms), ("strains", start)):
            leading = () if values is self.contact else (count, parts)
            padded = np.zeros((*leading, *shape), np.float32)
            padded[inside] = values[place]
            arrays[name] = self._array(name, padded.shape)
            arrays[name].write(padded)
        arrays["work"] = self._array("work of loads", (count, parts, WORK, *shape))
        self._launch(
            "contact_load", shape, parts, count, parts=parts, count=count, tolerance=GRADIENT_ERROR, **arrays
        )
        strains = np.zeros_like(start)
        strains[place] = arrays["strains"].read()[inside]
        if not np.isfinite(strains).all():
            raise NotConverged("the load that moves the contact was not found")
        return strains

    def _load_by_transforms(self, forms: Singles, start: Singles) -> Singles:
        """Return what `load` does, by the host's transforms, which take less time for a wide contact."""
        contact, space = self.contact, self._space
        if start.shape[1] == 1:
            return np.asarray(punches(space, contact, forms[:, 0], self.compliance, start[:, 0]))[
                :, np.newaxis
            ]
        window, part = window_of(space, contact)
        strains, place = np.zeros_like(start), (..., *window)
        system = ContactShear(contact[window], part.pixel_size, contact.shape)
        strains[place] = system.weights(GRADIENT_ERROR, start[place])
        return strains

    def _find(self) -> bool:
        """Find the contact near the last one in the window, and return whether there is one."""
        rows, columns = self.shape
        map_rows, map_columns = self.blocks.shape
        blocks, group = math.prod(self._space.shape), self._device.layout.group
        strip = max(2 * map_columns + LANES, NUMBERS * group)
        self._launch(
            "contact_follow",
            self.shape,
            1,
            1,
            map_rows=map_rows,
            map_columns=map_columns,
            top=self.window[0].start,
            left=self.window[1].start,
            is_same=self._is_same,
            bend=self.blocks.bend,
            own=self._space.own_displacement,
            work=self._array("work", (WORK * rows * columns + blocks + strip,)),
            loads=self._loads,
            found=self._found,
            **self._given,
        )
        found = self._found.read()
        self.surface = found[:blocks].reshape(self._space.shape)
        sheet = found[blocks:-NUMBERS].reshape(PLANES, rows, columns)[self._inside]
        self.gap, self.strain, self.variance = sheet[0], sheet[1], sheet[3]
        self.moved, self.moved_variance = sheet[4:6], sheet[6:8]
        self.sums = Sums.of(found[-NUMBERS:].tolist())
        self.contact = self._whole(sheet[2]) > 0
        is_found = math.isfinite(self.gap[0, 0]) and bool(self.contact.any())
        self._is_same = int(is_found)
        return is_found

    def _place(self, contact: Mask, reach: Mask) -> bool:
        """Move the window if it does not suit a contact, and the blocks that may touch; return whether."""
        window = []
        for near, far, size, part in zip(_box(contact), _box(reach), contact.shape, self.window, strict=True):
            more = max(math.ceil(_GROWTH * (near.stop - near.start)), 1)
            start, stop = max(far.start, near.start - more), min(far.stop, near.stop + more)
            length = part.stop - part.start
            if not (part.start <= start and stop <= part.stop and stop - start > _SHRUNK * length - _SPARE):
                part = slice(max(start - _MARGIN, 0), min(stop + _MARGIN, size))
            window.append(part)
        # Columns are rounded up where the grid permits, because few tables are then computed.
        rows, columns = window
        columns = _rounded_slice(columns, contact.shape[1])
        has_moved = (rows, columns) != self.window
        self.window = rows, columns
        return has_moved

    def _write(self, start: Singles) -> None:
        """Write strain and contact of an initial guess, (2, H, W), of the window."""
        blocks, (rows, columns) = math.prod(self._space.shape), self.shape
        values = np.zeros(blocks + PLANES * rows * columns + NUMBERS, np.float32)
        values[blocks:-NUMBERS].reshape(PLANES, rows, columns)[self._inside][1:3] = start
        self._found, self._is_same = self._array("found", values.shape), 0
        self._found.write(values)
        self._loads = self._array("loads", (LOADS, rows, columns))
        self._loads.fill()

    def _whole(self, values: NDArray[Any]) -> Singles:
        """Return a map of the window as one of all blocks, 0 outside."""
        whole = np.zeros(self._space.shape, np.float32)
        whole[self.window] = values
        return whole

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window on the device."""
        rows, columns = (part.stop - part.start for part in self.window)
        return rows, _rounded(columns)

    @property
    def _inside(self) -> tuple[Any, ...]:
        """The part of maps on the device, (..., rows, columns), that is in the window."""
        return ..., slice(self.window[1].stop - self.window[1].start)

    def _padded(self, values: NDArray[Any]) -> Singles:
        """Return maps of the window, (..., H, W), as they are on the device."""
        padded = np.zeros((*values.shape[:-2], *self.shape), np.float32)
        padded[self._inside] = values
        return padded

    def _launch(
        self, name: str, shape: tuple[int, int], parts: int, groups: int, /, **arguments: Any
    ) -> None:
        rows, columns = shape
        group, tables = self._device.layout.group, self._tables.get((columns, parts))
        if tables is None:
            values = wave_tables(self._space, columns, parts)
            tables = _Tables(*(self._device.from_host("tables of waves", table) for table in values))
            self._tables[columns, parts] = tables
        self._device.kernel("contact", name, GROUP=group, BINNING=self.blocks.binning)(
            groups * group,
            rows=rows,
            columns=columns,
            reach=self._space.shape[0],
            lift=self._lift,
            **tables._asdict(),
            **arguments,
            moved=0,
        )

    def _array(self, name: str, shape: tuple[int, ...]) -> Array:
        """Return an array for maps of a name and shape, which is kept."""
        key = name, shape
        if key not in self._arrays:
            self._arrays[key] = self._device.array(name, shape, np.float32)
        return self._arrays[key]


def _rounded(columns: int) -> int:
    return -(-columns // LANES) * LANES


def _rounded_slice(columns: slice, size: int) -> slice:
    """Return columns whose number is rounded up, as far as the grid permits."""
    length = _rounded(columns.stop - columns.start)
    stop = min(columns.start + length, size)
    return slice(max(stop - length, 0), stop)


def _box(mask: Mask) -> tuple[slice, slice]:
    """Return the smallest box around a mask."""
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    return slice(y, y + height), slice(x, x + width)


def wave_tables(space: HalfSpace, columns: int, parts: int) -> tuple[Doubles, ...]:
    """Return the basis, its transpose, and the weights of the convolution and of its approximate inverse.

    See `mirrorskin.kernels.skin.contact`.
    """
    rows, width = space.shape
    period, angle = 2 * columns, math.pi / columns * np.arange(columns)[:, np.newaxis]
    cosines, sines = np.cos(angle * np.arange(columns + 1)), np.sin(angle * np.arange(1, columns))
    basis, grid = np.concatenate([cosines, sines], axis=1), (2 * rows, period)
    if parts == 1:
        kernels = [space.influence()]
        inverses = [1 / point_spectrum(grid, space.pixel_size, reach_of(grid, space.pixel_size))[0]]
    else:
        kernels = influences(tensor_spectra, space.shape, space.pixel_size)
        inverses = list(inverse_spectra(grid, space.pixel_size))
    near, weights, inverse = min(width, columns), [], []
    for kernel, spectrum, sign in zip(kernels, inverses, (1, 1, -1), strict=False):
        whole = np.zeros((rows, period))
        whole[:, :near] = kernel[:, :near]
        whole[:, period - near + 1 :] = sign * kernel[:, near - 1 : 0 : -1]
        weights.append(_waves(fft.rfft(whole), sign))
        inverse.append(_waves(fft.ifft(spectrum, axis=0)[:rows], sign))
    return basis, basis.T, np.stack(weights), np.stack(inverse)


def _waves(spectrum: NDArray[np.complex128], sign: int) -> Doubles:
    """Return the weights of cosines and sines of a kernel, even or odd along rows, from its transform."""
    columns = spectrum.shape[1] - 1
    share = np.full(columns + 1, 1 / columns)
    share[[0, -1]] /= 2
    if sign > 0:
        cosines = sines = share * spectrum.real
    else:
        sines = -share * spectrum.imag
        sines[:, [0, -1]] = 0
        cosines = -sines
    return np.concatenate([cosines, sines[:, 1:-1]], axis=1)
