"""Normals, contact, edges and heights from an axial rotation; or its wave alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.provenance import naming, sign, told, told_level
from mirrorskin.engine.rotation.correlation import Correlator
from mirrorskin.engine.rotation.launch import NORMAL_METHODS, NormalMethod
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.relief import find_relief
from mirrorskin.engine.rotation.response import response_of
from mirrorskin.engine.rotation.run import Run
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import Header, InputError, ProcessValue, Result, Source
from mirrorskin.kernels.device import Device, open_device

_NO_GAIN = "none: the recording has no zenith gain"
_NO_PIXEL_SIZE = "none: the recording has no pixel size"


@dataclass(frozen=True, slots=True)
class Rotation:
    """What a rotation tells of each pixel.

    Attributes
    ----------
    normals : Normals
    white : ndarray, (H, W), float32
        The predicted errors, radians, that normals would have without registration. That makes errors smaller
        but neighbours' alike, and means over many pixels no better.
    edges : ndarray, (H, W), uint8
    device : Device
    process : dict
        What it was made with.
    systematic : ndarray, (H, W), float32, or None
        Standard errors, radians, that a calibration adds to the normals', alike for neighbours.
    """

    normals: Normals
    white: NDArray[np.float32]
    edges: NDArray[np.uint8]
    device: Device
    process: dict[str, ProcessValue]
    systematic: NDArray[np.float32] | None = None


def reconstruct_rotation(
    source: Source,
    *,
    method: NormalMethod = "exact",
    tilt: float | Literal["estimate"] | None = None,
    gain: ArrayLike | None = None,
    offset: ArrayLike | None = None,
    noise: float | None = None,
    per_turn: bool = False,
    heights: ArrayLike | None = None,
    robust: bool = False,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Reconstruct normals from an axial rotation of one turn or more, and the heights that fit them.

    Brightness is what the zenith response of the source's calibration says (see `mirrorskin.io.Calibrated`).
    Without one, it is taken to be linear in the zenith between the source's dark and bright references, where
    it has them. Without a zenith gain, there are azimuth, mean, modulation and residual only; without a pixel
    size, no heights. Heights are relative: the mean of each connected piece is 0.

    Parameters
    ----------
    source : Source
        Of axial motion. It is rewound first, if it can be.
    method : {"exact", "paper"}
        See ``estimate_normals``.
    tilt : float or "estimate", optional
        Half-angle of the precession, radians; by default the source's own. It is estimated from the first
        turn on request only: where the pivot is far from the object's surface, that is wrong.
    gain, offset : array_like, scalar or (H, W), optional
        Counts per radian of zenith, and counts at zenith 0, instead of the source's own and of a calibrated
        response; an offset that nobody knows is 0.
    noise : float, optional
        Standard deviation of a sample, counts; by default told from the first turn.
    per_turn : bool
        Whether to tell each turn alone, in maps with a leading axis, instead of the mean over turns.
    heights : array_like, (H, W), optional
        Millimetres of the surface: frames are registered for the pivot's shift with them first; see
        ``Registered``. A calibrated response needs them in any case: where they are not given, they are found
        in a first pass over the source.
    robust : bool
        Whether the surface may break, at discontinuities that are found in it; see
        `mirrorskin.engine.integrate`. Edges are drawn there, too.
    memory_limit : int
        Bytes of host memory for frames on the move.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    progress : callable, optional
        Told the number of frames so far.

    Returns
    -------
    Result

    Raises
    ------
    mirrorskin.io.InputError
        Phases, tilt, scale or heights that are missing or cannot be used.
    mirrorskin.engine.NotConverged
        The heights that fit the normals were not found.
    """
    if gain is None and source.header.zenith_gain is None and response_of(source) is None:
        check_method(source, method)
        _need_no_gain(source, per_turn, heights)
        return correlate_source(source, memory_limit=memory_limit, device=device, progress=progress)
    found = estimate_rotation(
        source,
        method=method,
        tilt=tilt,
        gain=gain,
        offset=offset,
        noise=noise,
        per_turn=per_turn,
        heights=heights,
        memory_limit=memory_limit,
        device=device,
        progress=progress,
    )
    result = maps_of(found)
    if source.header.pixel_size is None:
        return sign(result, source, found.device, found.process | {"height": _NO_PIXEL_SIZE})
    with naming(source):
        relief = find_relief(
            found.normals, found.white, source.header.pixel_size, robust=robust, device=found.device
        )
    result = replace(
        result,
        height=relief.height,
        height_sigma=relief.sigma,
        component=relief.component,
        offset_unknown=relief.offset_unknown,
        edges=found.edges if relief.edges is None else found.edges | relief.edges,
    )
    return sign(result, source, found.device, found.process | relief.process)


def estimate_rotation(
    source: Source,
    *,
    method: NormalMethod = "exact",
    tilt: float | Literal["estimate"] | None = None,
    gain: ArrayLike | None = None,
    offset: ArrayLike | None = None,
    noise: float | None = None,
    per_turn: bool = False,
    heights: ArrayLike | None = None,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Rotation:
    """Find the normals of a rotation whose zenith gain is known; see ``reconstruct_rotation``."""
    check_method(source, method)
    header = _believe(source, tilt, gain, offset)
    wall = response_of(source) if gain is None else None
    run = Run(source, header, open_device(device), method, noise, per_turn, memory_limit, progress)
    if heights is not None and tilt == "estimate":
        raise InputError(f"{source.name}: frames are registered by a tilt that is known: give it")
    if wall is None:
        found = run.linear(heights)
        process: dict[str, ProcessValue] = {
            "zenith_gain": told(gain, source.header.zenith_gain, "none"),
            "zenith_offset": told(offset, source.header.zenith_offset, "0"),
            "low": told_level(source, "dark"),
            "high": told_level(source, "bright"),
            "heights": "none" if heights is None else "given",
        }
    else:
        found, process = run.calibrated(wall, heights)
    normals = found.normals
    process = {
        "method": method,
        "tilt": normals.tilt,
        "tilt_from": "estimate" if tilt == "estimate" else "given" if tilt is not None else "recording",
        "noise": normals.noise,
        "shot_noise": normals.shot,
        "turns": normals.turns,
        "frames": normals.frames,
        "per_turn": per_turn,
        **process,
    }
    return Rotation(normals, found.white, found.edges, run.device, process, found.systematic)


def correlate_source(
    source: Source,
    *,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Fit mean, cosine and sine of the phase to each pixel's brightness, over all frames of a source.

    Parameters
    ----------
    source : Source
        Of axial motion. It is rewound first, if it can be.
    memory_limit, device, progress
        As for `reconstruct_rotation`.

    Returns
    -------
    Result
        With azimuth, mean, cosine, sine, modulation and residual.

    Raises
    ------
    mirrorskin.io.InputError
        The phases do not determine the fit.
    """
    opened = open_device(device)
    size = math.prod(source.shape) * source.dtype.itemsize
    with naming(source):
        correlator = Correlator(
            source.shape[1:], source.dtype, device=opened, memory_limit=min(memory_limit, 2 * size)
        )
        feed(source, correlator, range(source.shape[0]), progress)
        wave = correlator.result()
    result = Result(
        azimuth=wave.azimuth,
        mean=wave.mean,
        cosine=wave.cosine,
        sine=wave.sine,
        modulation=wave.modulation,
        residual=wave.residual,
    )
    return sign(result, source, opened, {"method": "correlation", "frames": wave.frames, "zenith": _NO_GAIN})


def maps_of(rotation: Rotation) -> Result:
    """Put together what a rotation tells, but heights."""
    normals = rotation.normals
    return Result(
        normals=normals.vectors,
        zenith=normals.zenith,
        azimuth=normals.azimuth,
        normal_sigma=_with_systematic(normals.sigma, rotation.systematic),
        mean=normals.mean,
        modulation=normals.modulation,
        residual=normals.residual,
        edges=rotation.edges,
        contact=normals.contact,
    )


def check_method(source: Source, method: str) -> None:
    """Refuse a method that is none of a rotation."""
    if method not in NORMAL_METHODS:
        known = ", ".join(NORMAL_METHODS)
        raise InputError(f"{source.name} is a rotation, which method {method!r} cannot do: take {known}")


def _with_systematic(
    sigma: NDArray[np.float32], systematic: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    return sigma if systematic is None else np.hypot(sigma, systematic)


def _believe(
    source: Source,
    tilt: float | Literal["estimate"] | None,
    gain: ArrayLike | None,
    offset: ArrayLike | None,
) -> Header:
    """Return the source's header with what is given instead; a tilt of None is one to estimate."""
    header = source.header
    used = header.tilt if tilt is None else None if tilt == "estimate" else tilt
    if used is None and tilt != "estimate":
        raise InputError(
            f"{source.name} does not say how far the body leaned: give the tilt, such as 2.5deg,"
            " or have it estimated"
        )
    known_gain = header.zenith_gain if gain is None else np.asarray(gain, np.float64)
    known_offset = header.zenith_offset if offset is None else np.asarray(offset, np.float64)
    known_offset = np.zeros(()) if known_offset is None else known_offset
    return replace(header, tilt=used, zenith_gain=known_gain, zenith_offset=known_offset)


def _need_no_gain(source: Source, per_turn: bool, heights: ArrayLike | None) -> None:
    """Refuse what only normals have, of a source without a zenith gain."""
    if per_turn or heights is not None:
        asked = "turns of their own" if per_turn else "use for heights"
        raise InputError(f"{source.name} has no zenith gain, so no normals, and no {asked}: give the gain")
