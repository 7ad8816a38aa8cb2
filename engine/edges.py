"""Edges: where the normal jumps, and where contact ends (paper, section 4.2)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.kernels.device import Array, Device, open_device

_LEAST = math.radians(10.0)  # jump that is an edge
_QUIET = math.radians(1.6)  # standard error of a jump, of which that is six
_SURE = 4.0  # standard errors: one pixel in 3000 of a smooth surface has as much by chance


def find_edges(
    vectors: NDArray[np.float32],
    sigma: NDArray[np.float32],
    contact: NDArray[np.uint8],
    *,
    device: str | Device | None = None,
) -> NDArray[np.uint8]:
    """Draw thin lines where the normal jumps by more than 10 degrees, and round the contact.

    A pixel is compared with its neighbour to the right and below. Where their standard errors make a jump
    uncertain by more than 1.6 degrees, means of 2 x 3 pixels on either side are compared, or of 3 x 5. A
    jump must be 4 of its standard errors. Lines are where it is largest; where contact ends, the first pixels
    outside. The picture's border is no edge, nor is a pixel that nearly all neighbours contradict about
    contact. A surface that bends by 3 degrees a pixel looks like an edge to the widest means.

    Parameters
    ----------
    vectors : ndarray, (H, W, 3), float32
        Unit normals; NaN where there is none.
    sigma : ndarray, (H, W), float32
        Their standard error, radians.
    contact : ndarray, (H, W), uint8
        1 where there is contact in every frame.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``. It holds all maps at once, 28 bytes a pixel.

    Returns
    -------
    ndarray, (H, W), uint8
        1 on edges.

    Raises
    ------
    mirrorskin.io.InputError
        The maps are not of one size.
    mirrorskin.kernels.errors.DeviceError
        No device, or one without room for the maps.
    """
    shape = contact.shape
    if contact.ndim != 2 or vectors.shape != (*shape, 3) or sigma.shape != shape or 0 in shape:
        told = f"vectors {vectors.shape}, sigma {sigma.shape} and contact {shape}"
        raise InputError(f"{told} do not fit: (H, W, 3), (H, W) and (H, W) are needed")
    opened = open_device(device)
    normals, error = _put(opened, "vectors", vectors, np.float32), _put(opened, "sigma", sigma, np.float32)
    touched = _put(opened, "contact", contact != 0, np.uint8)
    clean, edges = (_put(opened, name, np.zeros(shape, np.uint8), np.uint8) for name in ("clean", "edges"))
    jumps = opened.array("jumps", (2, *shape), np.float32)
    jumps.upload()
    size = np.int32(shape[0]), np.int32(shape[1])
    limits = np.float32(_LEAST), np.float32(_QUIET), np.float32(_SURE)
    _run(opened, "edges_clean", touched, clean, *size)
    _run(opened, "edges_jumps", normals, error, clean, jumps, *size, *limits)
    _run(opened, "edges_thin", jumps, clean, edges, *size)
    return edges.download().copy()


def _put(device: Device, name: str, values: NDArray[np.generic], dtype: type[np.generic]) -> Array:
    array = device.array(name, values.shape, dtype)
    array.host[:] = values
    array.upload()
    return array


def _run(device: Device, name: str, *arguments: Array | np.generic) -> None:
    maps = [one.host for one in arguments if isinstance(one, Array)]
    pixels = maps[-1].shape[-2] * maps[-1].shape[-1]
    kernel = device.kernel("edges", name)
    kernel(-(-pixels // device.shape.tile), *arguments, moved=sum(one.nbytes for one in maps))
