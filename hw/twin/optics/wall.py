"""The optics traced: each line of sight goes by way of the mirror to the real wall, or past it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.twin.body import Body
from mirrorskin.hw.twin.optics.pattern import Pattern
from mirrorskin.hw.twin.sheet import Sheet
from mirrorskin.hw.twin.view import View
from mirrorskin.io.types import Floats
from mirrorskin.kernels.device import Device

_RAYS = 128  # of each pixel
_FADES = 24  # the light at the wall's edges fades over this part of the scatter
_GOLDEN = math.pi * (3 - math.sqrt(5))  # angle that never repeats: it spreads points evenly over a sphere


class Wall:
    """What the camera sees in the mirror: the lit wall, where and only where a ray gets there.

    At each pixel the line of sight is mirrored at the sheet's normal and scattered by its flakes
    (`scatter_rays`), and each ray is followed to the wall (`mirrorskin.kernels.wall`). Dark is a ray that

    - passes over the rim and leaves by the body's top;
    - goes down below the rest plane: it meets the sheet before the wall, and no second bounce is followed;
    - is totally reflected at the body's side, with an air gap;
    - starts outside the body.

    The sheet does not hide the wall from itself: a ray that would meet another part of the raised sheet
    passes through it. Between steep walls of a narrow groove that is too bright.

    Light agrees with the float64 reference within 2e-5, and within 1e-3 across a gap or less than 0.2 mm
    from the body's side. Without scatter, a ray that meets an edge within the rounding of float32 may fall
    on either side.

    Parameters
    ----------
    body : Body
    pattern : Pattern
    view : View
        The camera's lines of sight.
    device : Device
        Where it is computed.

    Raises
    ------
    mirrorskin.kernels.errors.DeviceError
        The device cannot hold the maps, or cannot run the kernel.
    """

    def __init__(self, body: Body, pattern: Pattern, view: View, device: Device) -> None:
        self._body, self._device, self._shape = body, device, view.shape
        table = pattern.table(body)
        places = [view.x, view.y]
        if not view.orthographic:
            places += [view.slope_x, view.slope_y]
        self._places = device.given("places", np.stack([place.ravel() for place in places]))
        self._rays = device.given("rays", scatter_rays(body.scatter))
        self._table = device.given("table", table)
        self._sheet = device.array("sheet", (3, *view.shape), np.float32)
        self._light = device.array("light", view.shape, np.float32)
        self._macros = {
            "OBLIQUE": int(not view.orthographic),
            "GAP": int(body.air_gap > 0),
            "TABLE": _depends_on(table),
            "LAMPS": int(body.asymmetry > 0),
        }

    def light(self, sheet: Sheet) -> NDArray[np.float32]:
        """Return the share of full light that each pixel sees.

        Full is what the pattern's clear places give where the lamps are brightest.

        Parameters
        ----------
        sheet : Sheet
            At the points that the pixels see, finite everywhere.

        Returns
        -------
        ndarray, (H, W), float32
            0 to 1.
        """
        self._sheet.claim()
        for plane, values in zip(self._sheet.host, (sheet.height, sheet.dz_dx, sheet.dz_dy), strict=True):
            plane[:] = values
        self._sheet.upload()
        self._launch()
        return self._light.download().copy()

    def _launch(self) -> None:
        body, pixels = self._body, self._light.host.size
        rows, columns = self._table.host.shape
        sizes = pixels, self._rays.host.shape[0], rows - 2, columns - 2
        geometry = body.radius, body.height, body.air_gap, body.index, body.scatter, fade_angle(body.scatter)
        lamps = (
            body.asymmetry * math.cos(body.asymmetry_azimuth),
            body.asymmetry * math.sin(body.asymmetry_azimuth),
        )
        maps = self._sheet, self._places
        self._device.kernel("wall", "wall_light", **self._macros)(
            -(-pixels // self._device.layout.tile),
            *(np.int32(size) for size in sizes),
            *maps,
            self._rays,
            self._table,
            *(np.float32(value) for value in (*geometry, *lamps)),
            self._light,
            moved=sum(array.host.nbytes for array in (*maps, self._light)),
        )


def scatter_rays(scatter: float) -> Floats:
    """Return rays scattered about a mirrored one, as `mirrorskin.kernels.wall.wall_light` takes them.

    A ray is turned off the mirrored one by the vector (u, v), of length at most a = scatter,
    across it. Its density ::

        1 / (2 pi a sqrt(a^2 - u^2 - v^2))

    is that of points spread evenly over a sphere of radius a and seen from afar. Equal slices of a sphere
    have equal surfaces (Archimedes), so that in every plane through the mirrored ray the low-pass is a box
    from -a to a, whichever way that plane lies. The rays are the points of a Fibonacci lattice: each in a
    slice of its own, each turned by the golden angle.

    Parameters
    ----------
    scatter : float
        Radians.

    Returns
    -------
    ndarray, (S, 3), float64
        Parts along the mirrored ray, along u and along v; the mirrored ray alone where nothing scatters.
    """
    if scatter == 0:
        return np.array([[1.0, 0.0, 0.0]])
    number = np.arange(_RAYS) + 0.5
    u = 1 - 2 * number / _RAYS
    v = np.sqrt(1 - u * u) * np.cos(number * _GOLDEN)
    length = np.sqrt(u * u + v * v)
    across = np.sin(scatter * length) / length
    return np.stack([np.cos(scatter * length), across * u, across * v], axis=1)


def fade_angle(scatter: float) -> float:
    """Return the angle over which a ray fades at the wall's edges, radians: what hides that rays are few."""
    return 2 * scatter / _FADES


def _depends_on(table: NDArray[np.float32]) -> int:
    """Return 0 where all of a wall is alike, 1 where it changes with height alone, 2 else."""
    if (table == table[:, :1]).all():
        return int((table != table[0, 0]).any())
    return 2
