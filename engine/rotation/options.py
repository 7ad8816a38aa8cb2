"""What normals are told with: the options that a stack, a window and a live run share, checked once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Required, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.frames import check_dtype
from mirrorskin.engine.rotation.fit_noise import CountNoise
from mirrorskin.engine.rotation.launch import NORMAL_METHODS, NormalLaunch, NormalMethod
from mirrorskin.engine.rotation.response import Response
from mirrorskin.engine.rotation.scale import Scale, make_scale
from mirrorskin.engine.rotation.tilt import check_tilt
from mirrorskin.io import Header, InputError
from mirrorskin.kernels.device import Device, open_device


class NormalOptions(TypedDict, total=False):
    """Options of ``mirrorskin.engine.estimate_normals``, which says what they are; the tilt is needed."""

    tilt: Required[float | None]
    gain: ArrayLike | None
    offset: ArrayLike
    method: NormalMethod
    noise: float | None
    low: ArrayLike | None
    high: ArrayLike | None
    response: Response | None
    device: str | Device | None


def options_of(
    header: Header,
    method: NormalMethod,
    noise: float | None,
    response: Response | None,
    device: str | Device | None,
) -> NormalOptions:
    """Return the options that a header tells, with others."""
    return {
        "tilt": header.tilt,
        "gain": header.zenith_gain,
        "offset": 0.0 if header.zenith_offset is None else header.zenith_offset,
        "low": header.dark,
        "high": header.bright,
        "method": method,
        "noise": noise,
        "response": response,
        "device": device,
    }


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What is made of the options.

    Attributes
    ----------
    tilt : float or None
        Radians; None where it is to be estimated.
    noise : CountNoise or None
        None where the samples are to tell it.
    scale : Scale or Response
    device : Device
    launch : NormalLaunch
    """

    tilt: float | None
    noise: CountNoise | None
    scale: Scale | Response
    device: Device
    launch: NormalLaunch


def set_up(
    shape: tuple[int, int],
    dtype: np.dtype[Any],
    *,
    tilt: float | None,
    gain: ArrayLike | None = None,
    offset: ArrayLike = 0.0,
    method: NormalMethod = "exact",
    noise: float | None = None,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    response: Response | None = None,
    device: str | Device | None = None,
) -> Setup:
    """Check options for frames of a shape, rows and columns, and a type, and open the device.

    Raises
    ------
    mirrorskin.io.InputError
        Options that cannot be used.
    """
    check_dtype(dtype)
    if method not in NORMAL_METHODS:
        raise InputError(f"unknown method {method!r}; known are {', '.join(NORMAL_METHODS)}")
    given_tilt = None if tilt is None else check_tilt(tilt)
    scale = response or make_scale(gain, offset, low, high, shape)
    given_noise = None if noise is None else _even_noise(noise)
    opened = open_device(device)
    return Setup(given_tilt, given_noise, scale, opened, NormalLaunch(opened, dtype, scale, method))


def _even_noise(noise: float) -> CountNoise:
    """Return the noise of samples that all have the same, of a standard deviation in counts."""
    if not 0 < noise < np.inf:
        raise InputError(f"noise {noise}: a standard deviation in counts is needed, such as 1.5")
    return CountNoise(noise**2, 0.0, noise**2)
