"""Normals, contact, edges and heights from an axial rotation; or its wave alone.

Frames are read once where brightness is linear in the zenith. Under a calibrated wall, what a pixel shows
depends on the height of what it sees as well: that is found in the first turn, unless it is given.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.nearest_fill import fill_with_nearest
from mirrorskin.engine.press.growth import Growth, travel_wave
from mirrorskin.engine.provenance import attach_provenance, level_origin, naming, parameter_origin
from mirrorskin.engine.rotation.coarse_height import coarse_heights
from mirrorskin.engine.rotation.correlation import Correlator
from mirrorskin.engine.rotation.design_matrix import LONGEST, Doubles, cut_into_turns, longest_turn
from mirrorskin.engine.rotation.edges import find_edges
from mirrorskin.engine.rotation.frequency import Frequency, frequency_of
from mirrorskin.engine.rotation.normals import NormalEstimator, Normals
from mirrorskin.engine.rotation.normals_kernel import NORMAL_METHODS, NormalMethod, options_from
from mirrorskin.engine.rotation.normals_pose import PoseEstimator, PoseNormals
from mirrorskin.engine.rotation.normals_to_height import integrate_normals
from mirrorskin.engine.rotation.poses import even_windows, rocks
from mirrorskin.engine.rotation.registration import Registered, check_heights
from mirrorskin.engine.rotation.response import HALF_WAY, Response, initial_response, wall_response_of
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import Block, Header, InputError, Result, Source, WallResponse
from mirrorskin.io.frames import FrameSequence
from mirrorskin.io.maps import PoseStatus, status_of
from mirrorskin.io.positions import check_phase
from mirrorskin.io.types import Closing, ProcessValue
from mirrorskin.kernels.device import Device, open_device

_NO_GAIN = "none: the recording has no zenith gain"
_NO_PIXEL_SIZE = "none: the recording has no pixel size"
_REACH = 5  # pixels across, of which a registered sample may be made
_ROUNDS = 2  # in which it is found how high the object stands


@dataclass(frozen=True, slots=True)
class Rotation:
    """What was found of each pixel, and how.

    ``independent_sigma`` is the predicted errors, radians, that normals would have without registration: that
    makes errors smaller but correlates those of neighbours, and means over many pixels are no better.
    ``systematic`` are standard errors that a calibration adds to the normals', alike for neighbours.
    """

    normals: Normals
    independent_sigma: NDArray[np.float32]
    edges: NDArray[np.uint8]
    device: Device
    process: dict[str, ProcessValue] = field(default_factory=dict)
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
    size, no heights. Heights are relative: the mean of each component is 0.

    Where the source has a tilt of each frame, or two phases half a turn apart, its frames are at any known
    poses: see `mirrorskin.engine.PoseEstimator`. Rocking tells a slope and no heights.

    Parameters
    ----------
    source : Source
        Of axial motion. It is rewound first, if it can be.
    method : {"exact", "paper"}
        See `mirrorskin.engine.estimate_normals`.
    tilt : float or "estimate", optional
        Half-angle of the precession, radians; by default the source's own. It is estimated from the first
        turn on request only: where the pivot is far from the object's surface, that is wrong.
    gain, offset : array_like, scalar or (H, W), optional
        Counts per radian of zenith, and counts at zenith 0, instead of the source's own and of a calibrated
        response; an unknown offset is 0.
    noise : float, optional
        Standard deviation of a sample, counts; by default estimated from the first turn.
    per_turn : bool
        Whether to return each turn alone, in maps with a leading axis, instead of the mean over turns.
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
        Called with the number of frames so far.

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
        _check_method(source, method)
        if per_turn or heights is not None:
            option = "turns of their own" if per_turn else "use for heights"
            raise InputError(
                f"{source.name} has no zenith gain, so no normals, and no {option}: give the gain"
            )
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
    result, pixel_size = rotation_maps(found), source.header.pixel_size
    if result.slope is not None:
        return attach_provenance(result, source, found.device, found.process)
    if pixel_size is None:
        return attach_provenance(result, source, found.device, found.process | {"height": _NO_PIXEL_SIZE})
    with naming(source):
        surface = integrate_normals(
            found.normals, found.independent_sigma, pixel_size, robust=robust, device=found.device
        )
    result = result.assign(
        height=surface.height,
        height_sigma=surface.height_sigma,
        component=surface.component,
        offset_unknown=surface.offset_unknown,
        edges=found.edges if surface.edges is None else found.edges | surface.edges,
    )
    return attach_provenance(result, source, found.device, {**found.process, **surface.process})


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
    """Find the normals of a rotation whose zenith gain is known; see `reconstruct_rotation`."""
    _check_method(source, method)
    header = _header(source, tilt, gain, offset)
    wall = wall_response_of(source) if gain is None else None
    passes = _Passes(source, header, open_device(device), method, noise, per_turn, memory_limit, progress)
    if at_poses(source, tilt):
        return passes.at_poses(heights)
    if heights is not None and tilt == "estimate":
        raise InputError(f"{source.name}: frames are registered by a tilt that is known: give it")
    if wall is None:
        found = passes.linear(heights)
        scale: dict[str, ProcessValue] = {
            "zenith_gain": parameter_origin(gain, source.header.zenith_gain, "none"),
            "zenith_offset": parameter_origin(offset, source.header.zenith_offset, "0"),
            "low": level_origin(source, "dark"),
            "high": level_origin(source, "bright"),
            "heights": "none" if heights is None else "given",
        }
        found = replace(found, process=scale)
    else:
        found = passes.calibrated(wall, heights)
    normals = found.normals
    process: dict[str, ProcessValue] = {
        "method": method,
        "tilt": normals.tilt,
        "tilt_from": "estimate" if tilt == "estimate" else "given" if tilt is not None else "recording",
        "noise": normals.noise,
        "shot_noise": normals.shot,
        "turns": normals.turns,
        "frames": normals.frames,
        "per_turn": per_turn,
    }
    return replace(found, process=process | found.process)


def correlate_source(
    source: Source,
    *,
    harmonic: int = 1,
    frequency: float | Literal["estimate"] | None = None,
    frame_rate: float | None = None,
    dither: bool = False,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Fit mean, cosine and sine of the phase to each pixel's brightness, over all frames of a source.

    Parameters
    ----------
    source : Source
        It is rewound first, if it can be.
    harmonic : int
        As for `mirrorskin.engine.correlate`.
    frequency : float or "estimate", optional
        Hertz: the phase is 2 pi times that and the time since the first frame, not the source's own. An
        estimate takes a source that can be rewound; see `mirrorskin.engine.estimate_frequency`.
    frame_rate : float, optional
        Frames a second, instead of the times that the source knows.
    dither : bool
        Whether the phase is that of a dithering press, by its travel; what it tells of the contact's growth
        is added. See `mirrorskin.engine.find_growth`.
    memory_limit, device, progress
        As for `reconstruct_rotation`.

    Raises
    ------
    mirrorskin.io.InputError
        The phases do not determine the fit, times are unknown, or no frequency can be estimated.
    """
    opened = open_device(device)
    limit = min(memory_limit, 2 * math.prod(source.shape) * source.dtype.itemsize)
    process: dict[str, ProcessValue] = {"method": "correlation"}
    if harmonic != 1:
        process["harmonic"] = harmonic
    with naming(source):
        frames = source
        if frequency is not None:
            time = _times_of(source, frame_rate)
            found = frequency_of(source, time) if frequency == "estimate" else Frequency(frequency, math.nan)
            process |= {"frequency": found.hertz}
            if frequency == "estimate":
                process["frequency_sigma"] = found.sigma
            frames = _Edited(source, partial(_rephased, 2 * math.pi * found.hertz * (time - time[0])))
        if dither:
            travel = travel_wave(getattr(source, "travel", None), source.shape[0])
            frames = _Edited(source, partial(_rephased, travel.phase))
        correlator = Correlator(
            source.shape[1:], source.dtype, harmonic=harmonic, device=opened, memory_limit=limit
        )
        feed(frames, correlator, range(source.shape[0]), progress, long=True)
        wave = correlator.result()
    names = "azimuth", "mean", "cosine", "sine", "modulation", "residual"
    result = Result(**{name: getattr(wave, name) for name in names})
    if dither:
        header = source.header
        grown = Growth.of(wave, travel, header.dark, header.bright, source.dtype, header.pixel_size)
        result = result.assign(growth=grown.growth, growth_sigma=grown.sigma)
        process |= {"travel": grown.travel, "travel_amplitude": grown.amplitude}
        if grown.area is not None and grown.area_sigma is not None:
            process |= {"area_growth": grown.area, "area_growth_sigma": grown.area_sigma}
    return attach_provenance(result, source, opened, process | {"frames": wave.frames, "zenith": _NO_GAIN})


def _times_of(source: Source, frame_rate: float | None) -> Doubles:
    """Return when each frame was taken, s, by the frame rate or else as the source says."""
    if frame_rate is not None:
        if not 0 < frame_rate < math.inf:
            raise InputError(f"frame rate {frame_rate}: frames a second, above 0, are needed")
        return np.arange(source.shape[0]) / frame_rate
    time: Doubles | None = getattr(source, "time", None)
    if time is None or not np.isfinite(time).all():
        raise InputError("the time of each frame is unknown: give the frame rate")
    return time


def _rephased(phase: Doubles, block: Block) -> Block:
    return replace(block, phase=phase[block.index : block.index + len(block.frames)])


def rotation_maps(rotation: Rotation) -> Result:
    """Return the maps of a rotation, but heights."""
    normals, systematic = rotation.normals, rotation.systematic
    result = Result(
        normals=normals.vectors,
        zenith=normals.zenith,
        azimuth=normals.azimuth,
        normals_sigma=normals.sigma if systematic is None else np.hypot(normals.sigma, systematic),
        mean=normals.mean,
        modulation=normals.modulation,
        residual=normals.residual,
        edges=rotation.edges,
        contact=normals.contact,
    )
    if not isinstance(normals, PoseNormals):
        return result
    result = result.assign(
        status=normals.status,
        slope=normals.slope,
        slope_sigma=normals.slope_sigma,
        declarations={"status": status_of(PoseStatus)},
    )
    if normals.direction is None:
        return result
    return result.assign(normals=None, azimuth=None, normals_sigma=None, edges=None)


def at_poses(source: Source, tilt: float | Literal["estimate"] | None = None) -> bool:
    """Tell whether the frames of a source are at any known poses, not on whole turns of one tilt.

    A source that does not know its positions beforehand is asked for its first frame, if it can be rewound.
    """
    if tilt is not None or source.motion != "axial":
        return False
    phase = getattr(source, "phase", None)
    if phase is not None:
        each: NDArray[np.float64] | None = getattr(source, "tilt", None)
        return each is not None if source.header.tilt is None else rocks(phase)
    if source.header.tilt is not None or not source.rewindable:
        return False
    source.rewind()
    first = source.read()
    source.rewind()
    return first is not None and first.tilt is not None


def rotation_at_poses(normals: Normals, device: Device) -> Rotation:
    """Return the edges that belong to normals, or slopes, of any known poses, and how they came about."""
    process: dict[str, ProcessValue] = {
        "method": "exact",
        "tilt": normals.tilt,
        "tilt_from": "each frame: this is their root mean square",
        "frames": normals.frames,
        "noise": normals.noise,
    }
    if isinstance(normals, PoseNormals) and normals.direction is not None:
        process["slope_direction"] = normals.direction
    return Rotation(normals, normals.sigma, _edges_of(normals, device), device, process)


def _edges_of(normals: Normals, device: Device) -> NDArray[np.uint8]:
    maps: list[NDArray[Any]] = [normals.vectors, normals.sigma, normals.contact]
    if normals.contact.ndim == 3:
        return np.stack([find_edges(*turn, device=device) for turn in zip(*maps, strict=True)])
    return find_edges(*maps, device=device)


def _check_method(source: Source, method: str) -> None:
    if method not in NORMAL_METHODS:
        known = ", ".join(NORMAL_METHODS)
        raise InputError(f"{source.name} is a rotation, which method {method!r} cannot do: take {known}")


def _header(
    source: Source,
    tilt: float | Literal["estimate"] | None,
    gain: ArrayLike | None,
    offset: ArrayLike | None,
) -> Header:
    """Return the source's header with what is given instead; a tilt of None is one to estimate."""
    header = source.header
    if at_poses(source, tilt):
        tilt = "estimate"  # each frame has its own
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


@dataclass(frozen=True, slots=True)
class _Passes:
    """The passes over a source's frames; ``header`` counts instead of the source's own."""

    source: Source
    header: Header
    device: Device
    method: NormalMethod
    noise: float | None
    per_turn: bool
    memory_limit: int
    progress: Progress | None

    def linear(self, heights: ArrayLike | None) -> Rotation:
        """Find the normals of pixels that are linear in the zenith; registered, if there are heights."""
        frames: Source = self.source
        if heights is not None:
            frames = Registered(self.source, heights, device=self.device, header=self.header)
        return self._rotation(frames, None)

    def calibrated(self, wall: WallResponse, heights: ArrayLike | None) -> Rotation:
        """Find the normals under a wall, with frames registered where the pivot is known."""
        response = initial_response(wall, self.source, self.header)
        if heights is not None:
            known = check_heights(heights, self.source.shape[1:])
            origin, heights = "given", fill_with_nearest(known).astype(np.float64)
        elif self.source.rewindable:
            origin, heights = "found in the first turn", self._first_heights(response)
        else:
            origin, heights = "half the press: the source cannot be read twice", self._half_way()
        frames, response = self._placed_at(self.source, response, np.asarray(heights))
        process: dict[str, ProcessValue] = {
            "zenith": "calibrated",
            "zenith_error": wall.error,
            "heights": origin,
            "registered": isinstance(frames, Registered),
        }
        return replace(self._rotation(frames, response), process=process, systematic=response.sigma)

    def at_poses(self, heights: ArrayLike | None) -> Rotation:
        """Find normals, or slopes, from frames at any known poses."""
        name = self.source.name
        if heights is not None or self.method != "exact":
            what = "registering frames with heights" if heights is not None else f"method {self.method!r}"
            raise InputError(f"{name}: {what} needs one tilt for all frames: leave it out")
        count, size = self.source.shape[0], math.prod(self.source.shape) * self.source.dtype.itemsize
        options = options_from(self.header, self.method, self.noise, None, self.device)
        with naming(self.source):
            estimator = PoseEstimator(
                self.source.shape[1:],
                self.source.dtype,
                longest=even_windows(count),
                per_turn=self.per_turn,
                memory_limit=min(self.memory_limit, 2 * size),
                **options,
            )
            frames = _Edited(self.source, partial(_with_tilts, self.source.header.tilt))
            feed(frames, estimator, range(count), self.progress)
            normals = estimator.result()
        return rotation_at_poses(normals, self.device)

    def _first_heights(self, response: Response) -> Doubles:
        """Find from the first turn how high the object is, less the press, (H, W), mm."""
        pixel_size, press = self.header.pixel_size, self._press
        assert pixel_size is not None
        once = replace(self, per_turn=False, progress=None)
        turn, heights = FirstTurn(self.source), self._half_way()
        for _ in range(_ROUNDS):
            frames, response = self._placed_at(turn, response, heights)
            normals = once._normals(frames, response)
            too_level = response.too_level(normals.mean)
            stand = coarse_heights(
                normals.vectors, normals.contact, too_level, pixel_size, press, self.device
            )
            heights = stand - press
        return heights

    def _half_way(self) -> Doubles:
        """Return the height of an object before the first estimate, less the press, (H, W), mm."""
        return np.full(self.source.shape[1:], -HALF_WAY * self._press)

    @property
    def _press(self) -> float:
        assert self.header.press is not None  # or there is no response
        return self.header.press

    def _placed_at(self, source: Source, response: Response, heights: Doubles) -> tuple[Source, Response]:
        """Return frames that follow an object of known heights, mm, if they can, and the response to them."""
        follows = self.header.pivot is not None and self.header.tilt is not None
        response = response.at(self._press + heights, follows)
        if not follows:
            return source, response
        offset, per_count = response.planes[:2]  # counts without light, and for full light, as a scale
        header = replace(self.header, zenith_offset=offset, zenith_gain=1 / per_count)
        sight = response.sight
        return Registered(source, heights, device=self.device, header=header, sight=sight), response

    def _normals(self, frames: Source, response: Response | None) -> Normals:
        """Feed the frames through an estimator."""
        phase: NDArray[np.float64] | None = getattr(frames, "phase", None)
        size = math.prod(frames.shape) * frames.dtype.itemsize
        with naming(self.source):
            estimator = NormalEstimator(
                frames.shape[1:],
                frames.dtype,
                longest=LONGEST if phase is None else longest_turn(phase),
                per_turn=self.per_turn,
                memory_limit=min(self.memory_limit, 2 * size),
                **options_from(self.header, self.method, self.noise, response, self.device),
            )
            feed(frames, estimator, range(frames.shape[0]), self.progress)
            return estimator.result()

    def _rotation(self, frames: Source, response: Response | None) -> Rotation:
        """Find normals and edges, and account for a registration."""
        found = self._with_edges(self._normals(frames, response))
        if not isinstance(frames, Registered):
            return found
        given, gain = self.noise is not None, frames.noise_gain
        independent = found.independent_sigma if given else found.independent_sigma / gain
        normals = _account_for_registration(found.normals, gain if given else None)
        return replace(found, normals=normals, independent_sigma=independent)

    def _with_edges(self, normals: Normals) -> Rotation:
        return Rotation(normals, normals.sigma, _edges_of(normals, self.device), self.device)


class _Edited(Closing):
    """A source whose blocks are edited as they go by."""

    def __init__(self, source: Source, edit: Callable[[Block], Block]) -> None:
        self._source, self._edit = source, edit
        self.name, self.header, self.shape = source.name, source.header, source.shape
        self.dtype, self.motion, self.rewindable = source.dtype, source.motion, source.rewindable

    def rewind(self) -> None:
        """Go back to the first frame."""
        self._source.rewind()

    def read(self, out: NDArray[Any] | None = None, /) -> Block | None:
        """Read the source's next frames."""
        block = self._source.read(out)
        return block and self._edit(block)


def _with_tilts(tilt: float | None, block: Block) -> Block:
    """Give each frame the tilt of all, if there is one."""
    return block if tilt is None else replace(block, tilt=np.full(len(block.frames), tilt))


def _account_for_registration(normals: Normals, noise_gain: NDArray[np.float32] | None) -> Normals:
    """Account for what interpolation did to a pixel's noise, and where it reached beyond the contact.

    Noise that was estimated from the frames themselves has the former in it: no ``noise_gain``. Samples are
    made of 4 x 4, of which two on either side may have lost contact.
    """
    from scipy import ndimage

    reach = np.ones((1,) * (normals.contact.ndim - 2) + (_REACH, _REACH), bool)
    lost = np.isfinite(normals.sigma) & (normals.contact == 0)
    inside = normals.contact * ~ndimage.binary_dilation(lost, reach)
    sigma = normals.sigma if noise_gain is None else normals.sigma * noise_gain
    return replace(normals, sigma=sigma, contact=inside)


class FirstTurn(FrameSequence):
    """The frames of a source's first turn, up to the first of the second and 64 at most, kept in memory."""

    def __init__(self, source: Source) -> None:
        frames: list[NDArray[Any]] = []
        phase = np.empty(0)
        source.rewind()
        while len(frames) < LONGEST and (block := source.read()) is not None:
            more = check_phase(block.phase, len(block.frames), f"{source.name}: phase")
            phase = np.concatenate([phase, more])
            if len(cut_into_turns(phase)) > 1:
                break
            frames.extend(block.frames.copy())
        self._frames = np.stack(frames) if frames else np.empty((0, *source.shape[1:]), source.dtype)
        self.phase: NDArray[np.float64] = phase[: len(frames)]
        super().__init__(source.name, source.header, self._frames.shape, source.dtype, phase=self.phase)

    def _fill(self, start: int, out: NDArray[Any]) -> None:
        out[:] = self._frames[start : start + len(out)]
