"""Normals, contact, edges and heights from an axial rotation; or its wave alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from mirrorskin.engine.nearest import with_nearest
from mirrorskin.engine.provenance import naming, sign, told, told_level
from mirrorskin.engine.rotation.coarse_height import coarse_heights
from mirrorskin.engine.rotation.correlation import Correlator
from mirrorskin.engine.rotation.design_matrix import LONGEST, Doubles, cut_into_turns, longest_turn
from mirrorskin.engine.rotation.edges import find_edges
from mirrorskin.engine.rotation.normals import NormalEstimator, Normals
from mirrorskin.engine.rotation.normals_kernel import NORMAL_METHODS, NormalMethod, options_from
from mirrorskin.engine.rotation.normals_to_height import integrate_normals
from mirrorskin.engine.rotation.registration import Registered, check_heights
from mirrorskin.engine.rotation.response import HALF_WAY, Response, initial_response, wall_response_of
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import Block, Header, InputError, ProcessValue, Result, Source, WallResponse, check_phase
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
    if gain is None and source.header.zenith_gain is None and wall_response_of(source) is None:
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
    result = rotation_maps(found)
    if source.header.pixel_size is None:
        return sign(result, source, found.device, found.process | {"height": _NO_PIXEL_SIZE})
    with naming(source):
        relief = integrate_normals(
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
    wall = wall_response_of(source) if gain is None else None
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


def rotation_maps(rotation: Rotation) -> Result:
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


_REACH = 5  # pixels across, of which a registered sample may be made
_ROUNDS = 2  # in which it is found how high the object stands


@dataclass(frozen=True, slots=True)
class Found:
    """What a run tells; see ``mirrorskin.engine.rotation.rotation.Rotation``."""

    normals: Normals
    white: NDArray[np.float32]
    edges: NDArray[np.uint8]
    systematic: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True)
class Run:
    """How a rotation is to be told.

    Attributes
    ----------
    source : Source
    header : Header
        What to believe of it; a tilt of None is one to estimate.
    device : Device
    method, noise, per_turn, memory_limit, progress
        As for ``reconstruct_rotation``.
    """

    source: Source
    header: Header
    device: Device
    method: NormalMethod
    noise: float | None
    per_turn: bool
    memory_limit: int
    progress: Progress | None

    def linear(self, heights: ArrayLike | None) -> Found:
        """Tell the normals of pixels that are linear in the zenith; registered, if there are heights."""
        frames: Source = self.source
        if heights is not None:
            frames = Registered(self.source, heights, self.device, self.header)
        return self._told(frames, self._normals(frames, None, self.per_turn, self.progress))

    def calibrated(
        self, wall: WallResponse, heights: ArrayLike | None
    ) -> tuple[Found, dict[str, ProcessValue]]:
        """Tell the normals under a wall, and how.

        Where a pixel looks depends on the height of what it sees. Heights that are not given are found in the
        first turn; see `coarse_heights`. Frames are registered with them where the pivot is known.
        """
        response = initial_response(wall, self.source, self.header)
        if heights is not None:
            known = check_heights(heights, self.source.shape[1:])
            how, stand = "given", with_nearest(known).astype(np.float64)
        elif self.source.rewindable:
            how, stand = "found in the first turn", self._stand(response)
        else:
            how, stand = "half the press: the source cannot be read twice", self._half_way()
        frames, response = self._placed_at(self.source, response, stand)
        found = self._told(frames, self._normals(frames, response, self.per_turn, self.progress))
        process: dict[str, ProcessValue] = {
            "zenith": "calibrated",
            "zenith_error": wall.error,
            "heights": how,
            "registered": isinstance(frames, Registered),
        }
        return replace(found, systematic=response.sigma), process

    def _stand(self, response: Response) -> Doubles:
        """Find from the first turn how high the object is, less the press, (H, W), mm."""
        pixel_size, press = self.header.pixel_size, self.header.press
        assert pixel_size is not None
        assert press is not None
        turn, heights = FirstTurn(self.source), self._half_way()
        for _ in range(_ROUNDS):
            frames, response = self._placed_at(turn, response, heights)
            normals = self._normals(frames, response, False, None)
            maps = normals.vectors, normals.contact, response.level(normals.mean)
            heights = coarse_heights(*maps, pixel_size, press, self.device) - press
        return heights

    def _half_way(self) -> Doubles:
        """Return the height of an object of which nothing is known yet, less the press, (H, W), mm."""
        assert self.header.press is not None
        return np.full(self.source.shape[1:], -HALF_WAY * self.header.press)

    def _placed_at(self, source: Source, response: Response, heights: Doubles) -> tuple[Source, Response]:
        """Return frames that follow an object of known heights, mm, if they can, and the response to them."""
        follows = self.header.pivot is not None and self.header.tilt is not None
        assert self.header.press is not None
        response = response.at(self.header.press + heights, follows)
        if follows:
            levels = self._levels(response)
            return Registered(source, heights, self.device, levels, response.sight), response
        return source, response

    def _levels(self, response: Response) -> Header:
        """Return the header with each pixel's counts without light, and for full light, as a scale."""
        offset, per_count = response.planes[:2]
        return replace(self.header, zenith_offset=offset, zenith_gain=1 / per_count)

    def _normals(
        self, frames: Source, response: Response | None, per_turn: bool, progress: Progress | None
    ) -> Normals:
        """Feed the frames through an estimator."""
        size = math.prod(frames.shape) * frames.dtype.itemsize
        with naming(self.source):
            estimator = NormalEstimator(
                frames.shape[1:],
                frames.dtype,
                longest=_longest_turn(frames),
                per_turn=per_turn,
                memory_limit=min(self.memory_limit, 2 * size),
                **options_from(self.header, self.method, self.noise, response, self.device),
            )
            feed(frames, estimator, range(frames.shape[0]), progress)
            return estimator.result()

    def _told(self, frames: Source, normals: Normals) -> Found:
        """Find the edges, and account for a registration."""
        edges = _edges(normals, self.device)  # where contact ends, before that is moved inwards
        white = normals.sigma
        if isinstance(frames, Registered):
            white = white if self.noise is not None else white / frames.noise_gain
            normals = _mend(normals, frames.noise_gain, given=self.noise is not None)
        return Found(normals, white, edges)


def _edges(normals: Normals, device: Device) -> NDArray[np.uint8]:
    """Find the edges of each turn, or of their mean."""
    maps = normals.vectors, normals.sigma, normals.contact
    if normals.contact.ndim == 2:
        return find_edges(*maps, device=device)
    return np.stack([find_edges(*turn, device=device) for turn in zip(*maps, strict=True)])


def _longest_turn(source: Source) -> int:
    """Return how many frames a turn may have: as many as they have, where that is known beforehand."""
    phase: NDArray[np.float64] | None = getattr(source, "phase", None)
    return LONGEST if phase is None else longest_turn(phase)


def _mend(normals: Normals, noise_gain: NDArray[np.float32], given: bool) -> Normals:
    """Account for what interpolation did to a pixel's noise, and where it reached beyond the contact.

    Noise that was told from the frames themselves knows of the former. Samples are made of 4 x 4, of which
    two on either side may have lost contact.
    """
    reach = np.ones((1,) * (normals.contact.ndim - 2) + (_REACH, _REACH), bool)
    lost = np.isfinite(normals.sigma) & (normals.contact == 0)
    inside = normals.contact * ~ndimage.binary_dilation(lost, reach)
    sigma = normals.sigma * noise_gain if given else normals.sigma
    return replace(normals, sigma=sigma, contact=inside)


class FirstTurn:
    """The frames of a source's first turn, as a source.

    Parameters
    ----------
    source : Source
        Of axial motion, which can be rewound. It is read up to the first frame of the second turn, and to 64
        frames at most.

    Attributes
    ----------
    name, header, motion, dtype
        Those of the source.
    shape : (int, int, int)
    phase : ndarray, (T,), float64
    rewindable : bool
        True.

    Raises
    ------
    mirrorskin.io.InputError
        A phase is missing, or the source cannot be read.
    """

    rewindable = True

    def __init__(self, source: Source) -> None:
        self.name, self.header, self.motion, self.dtype = (
            source.name,
            source.header,
            source.motion,
            source.dtype,
        )
        frames: list[NDArray[Any]] = []
        phase = np.empty(0)
        source.rewind()
        while len(frames) < LONGEST and (block := source.read()) is not None:
            phase = np.concatenate(
                [phase, check_phase(block.phase, len(block.frames), f"{self.name}: phase")]
            )
            if len(cut_into_turns(phase)) > 1:
                break
            frames.extend(block.frames.copy())
        self._frames = np.stack(frames) if frames else np.empty((0, *source.shape[1:]), source.dtype)
        self.phase = phase[: len(frames)]
        self.shape = self._frames.shape
        self._next = 0

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._next = 0

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the next frames; see ``Source.read``."""
        count = min(1 if out is None else len(out), self.shape[0] - self._next)
        if count == 0:
            return None
        part = slice(self._next, self._next + count)
        self._next = part.stop
        block = Block(self._frames[part], part.start, phase=self.phase[part])
        if out is None:
            return block
        out[:count] = block.frames
        return replace(block, frames=out[:count])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass
