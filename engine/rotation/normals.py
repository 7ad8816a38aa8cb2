"""Maximum-likelihood surface normals from an axial rotation (paper, section 4)."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import AnyArray, on_host
from mirrorskin.engine.base.frames import thinned, typical_value
from mirrorskin.engine.base.operation import Operation
from mirrorskin.engine.base.options import option
from mirrorskin.engine.correlation.design_matrix import (
    LONGEST,
    TurnFit,
    check_phases,
    check_turning,
    check_weights,
    longest_turn,
    split_into_turns,
    turn_fit,
)
from mirrorskin.engine.diagnosis.footprint import LEAST_BLUR, PIXEL
from mirrorskin.engine.diagnosis.normals_uncertainty import (
    NuisanceUncertainty,
    PhaseUncertainty,
    RegistrationUncertainty,
    ResponseUncertainty,
    SystematicUncertainty,
)
from mirrorskin.engine.diagnosis.turn_nuisances import Grid, Scale, TurnNuisances, find_nuisances, shift_of
from mirrorskin.engine.rotation.normals_kernel import (
    MAPS,
    NormalKernel,
    NormalMethod,
    SensorOptions,
    TurnModel,
)
from mirrorskin.engine.rotation.normals_window import NormalWindow
from mirrorskin.engine.rotation.poses import PoseFit
from mirrorskin.engine.rotation.response import Response, initial_response, wall_response_of
from mirrorskin.engine.rotation.scale import check_gain
from mirrorskin.engine.rotation.tilt import check_tilt
from mirrorskin.io import Header, InputError, Result
from mirrorskin.io.base.types import FRAME_DTYPES, ProcessValue
from mirrorskin.io.model.maps import TABLE
from mirrorskin.io.model.positions import check_phase
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.correlation import WINDOW
from mirrorskin.kernels.rotation.normals import azimuth_of, zenith_of

if TYPE_CHECKING:
    from mirrorskin.io import Source


class NormalsOperation(SensorOptions, Operation):
    """Base of operations that estimate normals from groups of frames, such as turns.

    Frames are kept until their group is complete, at most 64 of them. The device keeps the mean of the
    normals of complete groups, weighted by inverse variance.
    """

    motions = ("axial",)
    dtypes = FRAME_DTYPES
    for_device = True

    longest: int | None = option(
        default=None,
        unit="frames",
        within=(1, LONGEST),
        help=f"number of frames of the longest turn, up to {LONGEST}, for which memory is reserved",
        shown_default=f"that of the recording, otherwise {LONGEST}",
        python_only=True,
    )
    per_turn: bool = option(
        default=False,
        help="return each turn alone, in maps with a leading axis, instead of the mean over turns",
    )

    blur: float | None = option(
        default=None,
        within=(0, 100),
        help="standard deviation of the lens's point spread, pixels, which makes normals of bent surfaces"
        " less certain; 0 adds nothing",
        shown_default="0.3, and what the recording states of it",
    )
    header: Header | None = option(
        default=None,
        help="uncertainties of camera and stage",
        shown_default="that of the recording",
        python_only=True,
    )

    normals = TABLE["normals"]
    zenith = TABLE["zenith"]
    azimuth = TABLE["azimuth"]
    normals_sigma = TABLE["normals_sigma"]
    contact = TABLE["contact"]
    mean = TABLE["mean"]
    cosine = TABLE["cosine"]
    sine = TABLE["sine"]
    modulation = TABLE["modulation"]
    residual = TABLE["residual"]

    _kernel_maps: tuple[str, ...] = MAPS
    _width = 0  # components of a frame's position; 0 for a scalar

    def check_options(self) -> None:
        """Raise InputError if the zenith's gain is 0."""
        if self.zenith_gain is not None:
            check_gain(self.zenith_gain)

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's values of options that are not given."""
        names = "zenith_gain", "zenith_offset", "dark", "bright"
        return self.with_options(
            header=source.header if self.header is None else self.header,
            **{name: getattr(source.header, name) for name in names if getattr(self, name) is None},
        )

    def _make_kernel(self, shape: tuple[int, int]) -> NormalKernel:
        raise NotImplementedError

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        self._longest = LONGEST if self.longest is None else self.longest
        self._kernel = self._make_kernel(shape)
        self._maps = self._kernel.picture(self, self._longest + 1)
        self._model = self._kernel.model
        self._stack: AnyArray | None = None  # all frames, if they stay valid: they are used without a copy
        self._phase = np.empty((0, self._width) if self._width else 0)  # phases of the frames in the buffer
        self._weights = np.empty(0)
        self._turns = self._frames = 0  # numbers of turns and frames in the maps
        self._each: list[list[NDArray[Any]]] = []

    @property
    def _buffer(self) -> NDArray[Any]:
        """Buffer with the frames of the current turn, and space for more."""
        return self._maps.staging_buffer

    @property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        self._copy_stack()
        return self._buffer[len(self._phase) :]

    def _push(self, frames: AnyArray, where: Doubles, frame_weights: ArrayLike | None) -> None:
        """Process frames and the position of each."""
        weights = check_weights(frame_weights, len(frames))
        # Missing frames would be moved in the memory of the caller.
        if self._stay_valid and self.count == 0 and np.all(weights > 0):
            self._cut(where)
            self._stack, self._phase, self._weights = frames, where, weights
            return
        self._copy_stack()
        self._take_parts(on_host(frames), where, weights)

    def _copy_stack(self) -> None:
        """Copy a whole stack, if there is one, to the buffer, since other frames follow."""
        if self._stack is not None:
            frames, where, weights = self._stack, self._phase, self._weights
            self._stack, self._phase, self._weights = None, where[:0], weights[:0]
            self._take_parts(on_host(frames), where, weights)

    def _take_parts(self, frames: NDArray[Any], where: Doubles, weights: Doubles) -> None:
        """Process frames part by part as the buffer has space for them."""
        start = 0
        while start < len(frames):
            part = slice(start, start + len(self._buffer) - len(self._phase))
            self._take(frames[part], where[part], weights[part])
            start = part.stop

    @property
    def _open(self) -> AnyArray:
        """Memory that starts with the frames of the open turn."""
        return self._buffer if self._stack is None else self._stack

    def result(self) -> Result:
        """Return the maps of all turns; the last turn ends with the last frame."""
        if self.ended:
            return self._complete()
        state = self._model, self._turns, self._frames, self._phase.copy(), self._weights.copy()
        frames = self._open[: len(self._phase)].copy() if np.any(self._weights == 0) else None
        closed = self._maps.read(*self._kernel_maps) if self._turns and not self.per_turn else []
        try:
            return self._complete()
        finally:  # more frames may follow: open the last turn again
            self._model, self._turns, self._frames, self._phase, self._weights = state
            del self._each[self._turns :]
            for name, values in zip(self._kernel_maps, closed, strict=False):
                self._maps.fill(name, values)
            if frames is not None:
                self._buffer[: len(frames)] = frames

    def _complete(self) -> Result:
        """Close the open turn, and return the maps."""
        where, weights = self._phase.copy(), self._weights.copy()
        self._estimate(self._turns_in(self._phase))
        if self._turns == 0:
            check_turning(self.positions_so_far("phase"))
            self._explain(where, weights)
        if self._model is None:
            raise InputError("no turn of these phases has three frames or more: turn more slowly")
        if self.per_turn:
            maps = [np.stack(turns) for turns in zip(*self._each, strict=True)]
        else:
            maps = self._maps.take(*self._kernel_maps, on_host=self._stack is None)
        return self._as_result(maps, self._model)

    @property
    def footprint(self) -> float:
        """Variance of the area that a pixel sees, square pixels; 0 if it adds nothing."""
        if self.blur is not None:
            return float(self.blur**2 + PIXEL) if self.blur else 0.0
        return PIXEL + LEAST_BLUR**2 + self.stated.prior("blur_sigma") ** 2

    @property
    def stated(self) -> Header:
        """What is stated of camera and stage."""
        return Header("axial") if self.header is None else self.header

    def nuisances_of(self, samples: FrameSamples | None) -> TurnNuisances | None:
        """Return what may be wrong with the brightness of all pixels; None if nothing is known of it."""
        return None

    def _as_result(self, maps: list[NDArray[Any]], model: TurnModel) -> Result:
        return normals_result(maps, model, self._turns, self._frames)

    def _turns_in(self, where: Doubles) -> list[slice]:
        """Return the groups of frames that are fitted together, from the positions of the body."""
        return split_into_turns(where)

    def _fit_of(self, where: Doubles, weights: Doubles, first: bool) -> TurnFit | PoseFit | None:
        """Return the fit to a group of frames, or None if they do not determine one."""
        fit = turn_fit(where, weights)
        return fit if fit is not None and (fit.goes_round or first) else None

    def _explain(self, where: Doubles, weights: Doubles) -> None:
        """Raise an InputError with the reason why frames do not determine a fit."""
        check_phases(where, weights)

    def _take(self, frames: NDArray[Any], phase: Doubles, weights: Doubles) -> None:
        """Process frames that fit into the buffer, and estimate the turns that are complete."""
        turns = self._cut(np.concatenate([self._phase, phase]))
        here = self._buffer[len(self._phase) :][: len(frames)]
        if frames.ctypes.data != here.ctypes.data or not frames.flags.c_contiguous:
            here[:] = frames
        self._phase = np.concatenate([self._phase, phase])
        self._weights = np.concatenate([self._weights, weights])
        if len(turns) > 1:
            self._estimate(turns[:-1])
            end, frame_count = turns[-1].start, len(self._phase)
            self._buffer[: frame_count - end] = self._buffer[end:frame_count].copy()
            self._phase, self._weights = self._phase[end:], self._weights[end:]

    def _cut(self, phase: Doubles) -> list[slice]:
        """Return the frames of each turn; InputError if a turn is too long."""
        turns = self._turns_in(phase)
        longest = max(turn.stop - turn.start for turn in turns)
        if longest > self._longest:
            raise InputError(
                f"a turn of {longest} frames or more: normals take {self._longest} at most; leave some out,"
                " or use 'mirrorskin correlate'"
            )
        return turns

    def _estimate(self, turns: list[slice]) -> None:
        """Estimate the normals of turns in the buffer.

        The first turn that determines a normal is used, and later ones if their phases go all round.
        """
        for turn in turns:
            turn = self._without_missing(turn)
            fit = self._fit_of(self._phase[turn], self._weights[turn], first=not self._turns)
            if fit is not None:
                self._estimate_turn(turn, fit)

    def _without_missing(self, turn: slice) -> slice:
        """Move the frames of a turn with weights above 0 to its start, and return their slice."""
        places = turn.start + np.flatnonzero(self._weights[turn] > 0)
        present = slice(turn.start, turn.start + len(places))
        if present != turn:
            for values in (self._open, self._phase, self._weights):
                values[present] = values[places]
        return present

    def _estimate_turn(self, turn: slice, fit: TurnFit | PoseFit) -> None:
        """Add a turn to the maps."""
        frames = self._open[turn]
        if self._model is None:
            self._model = self._kernel.estimate_model(thinned(frames)[0], fit)
        self._turns += 1
        self._frames += len(frames)
        self._kernel.run(self._maps, frames, fit, self._model, 1 if self.per_turn else self._turns)
        if self.per_turn:
            self._each.append(self._maps.read(*self._kernel_maps))


def normals_result(maps: list[Any], model: TurnModel, turns: int, frames: int) -> Result:
    """Return the maps of the kernel, in the order of `MAPS`, as a result."""
    normals, sigma, contact, mean, cosine, sine, residual = maps
    level = typical_value(mean) if model.noise.slope > 0 else 0.0
    process: dict[str, ProcessValue] = {
        "noise": float(model.noise.at(level)),
        "shot_noise": model.noise.slope,
        "tilt": model.tilt,
        "turns": turns,
        "frames": frames,
    }
    return Result(
        normals=normals,
        zenith=partial(zenith_of, normals),
        azimuth=partial(azimuth_of, normals),
        normals_sigma=sigma,
        contact=contact,
        mean=mean,
        cosine=cosine,
        sine=sine,
        modulation=partial(np.hypot, cosine, sine),
        residual=residual,
        process=process,
    )


class Normals(NormalsOperation):
    """Normals from turns of an axial rotation at a constant tilt.

    At each phase, the brightness of a pixel depends on the angle between its normal n and the body's axis a,
    cos theta' = n . a (equation 10); the normal is the maximum-likelihood estimate from all samples. See the
    documentation, "Normals from a rotation". Clipped samples (integers at the ends of their type) and NaN are
    ignored.

    ``process`` contains the standard deviation ``noise`` of a sample in the middle of the brightness, counts,
    the growth ``shot_noise`` of its square per count, the ``tilt``, radians, and the numbers of ``turns`` and
    ``frames``.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import engine
    >>> run = engine.Run(engine.Normals(tilt=0.05, zenith_gain=300, noise=1.0))
    >>> for phase in np.arange(8) * np.pi / 4:
    ...     run.push(np.full((1, 2, 3), 100 + 15 * np.cos(phase), np.uint8), phase=[phase])
    >>> run.result().process["turns"]
    1
    """

    checks = (
        RegistrationUncertainty,
        PhaseUncertainty,
        ResponseUncertainty,
        NuisanceUncertainty,
        SystematicUncertainty,
    )

    tilt: float | Literal["estimate"] | None = option(
        default=None,
        unit="rad",
        help="half-angle of the precession, or estimate it from the first turn; the estimate is wrong if the"
        " pivot is far from the surface",
        shown_default="that of the recording",
    )
    method: NormalMethod = option(
        default="exact", help="most likely normals, or the paper's equations 14 to 22"
    )
    response: Response | None = option(
        default=None,
        help="calibrated response of a sensor that is not linear, used instead of the zenith's gain and"
        " offset and of dark and bright; see mirrorskin.engine.rotation.response",
        python_only=True,
    )
    window_frames: int | None = option(
        default=None,
        unit="frames",
        within=(3, WINDOW),
        help=f"number of the last frames that are used, 3 to {WINDOW}: one turn of an endless rotation. Noise"
        " and tilt are estimated from the first of these turns",
        shown_default="all turns",
    )
    nuisances: TurnNuisances | None = option(
        default=None,
        help="what was wrong with the brightness of all frames, which are corrected for it",
        shown_default="found in all frames, which are then pushed again if it matters",
        python_only=True,
    )

    def check_options(self) -> None:
        """Raise InputError if the zenith's gain is 0, or the tilt is impossible."""
        super().check_options()
        if not isinstance(self.tilt, str | None):
            check_tilt(self.tilt)

    def configured_for(self, source: Source) -> Self:
        """Return the operation with the source's values of options that are not given."""
        header, changes = source.header, dict[str, Any]()
        if self.tilt is None:
            changes["tilt"] = header.tilt
        phase: Doubles | None = getattr(source, "phase", None)
        if self.longest is None and phase is not None:
            changes["longest"] = max(1, min(LONGEST, longest_turn(phase)))
        wall = wall_response_of(source) if self.zenith_gain is None else None
        if wall is not None and self.response is None:
            changes["response"] = initial_response(wall, source, header)
        return super().configured_for(source).with_options(**changes)

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Prepare for frames of a shape and type."""
        self._has_weights = False
        self._found: TurnNuisances | None = None
        if self.window_frames is None:
            super().start(shape, dtype)
        else:
            self._window = NormalWindow(self, self._make_kernel(shape), self.window_frames)

    def _make_kernel(self, shape: tuple[int, int]) -> NormalKernel:
        if self.tilt is None:
            raise InputError("tilt is missing: give the half-angle of the precession, such as 2.5deg")
        return NormalKernel(self, shape, tilt=self.tilt, method=self.method, response=self.response)

    @property
    def window(self) -> NormalWindow:
        """The window of the last frames on the device, if `window_frames` is given and frames were pushed."""
        return self._window

    @property
    def staging_buffer(self) -> NDArray[Any]:
        """Array in which the next frames may be written before they are pushed, (n, H, W)."""
        return super().staging_buffer if self.window_frames is None else self._window.maps.staging_buffer

    def after_last_frame(self, samples: FrameSamples) -> Self | None:
        """Return the operation that corrects what is wrong with the brightness, if that matters."""
        alone = self.per_turn or self.window_frames is not None
        if self._has_weights or alone or self.nuisances is not None:
            return None
        self._found = found = self._find_nuisances(samples)
        return self.with_options(nuisances=found) if found is not None and found.worth_removing else None

    def nuisances_of(self, samples: FrameSamples | None) -> TurnNuisances | None:
        """Return what was corrected, or what may be wrong with the brightness of the frames of a result."""
        if self.nuisances is not None or samples is None:
            return self.nuisances
        return self._find_nuisances(samples) if self._found is None else self._found

    def _find_nuisances(self, samples: FrameSamples) -> TurnNuisances | None:
        """Return the nuisances of the frames, or of one turn; None with a calibrated response."""
        known = self.response is None and self.zenith_gain is not None
        tilt = self._tilt_of_frames() if known else None
        if tilt is None:
            return None
        phase, part = self.positions_so_far("phase"), slice(None)
        if self.window_frames is not None:
            part = slice(len(phase) - self.window.length, None)
        elif self.per_turn:
            part = split_into_turns(phase)[0]
        maps = self.zenith_gain, self.zenith_offset, self.dark
        scale = [np.asarray(0.0 if values is None else values, np.float64) for values in maps]
        at_grid = [values if values.ndim == 0 else samples.of_map(values).ravel() for values in scale]
        full = None
        if self.bright is not None:
            full = float(np.nanmedian(np.asarray(self.bright, np.float64) - scale[2]))
        values = samples.values[part]
        return find_nuisances(
            values.reshape(len(values), -1),
            phase[part],
            tilt,
            Scale(at_grid[0], at_grid[1], at_grid[2], full),
            Grid(samples.rows, samples.columns, self.shape, shift_of(self.stated, tilt)),
            self.stated,
            informed=not self._has_weights,
        )

    def _as_result(self, maps: list[NDArray[Any]], model: TurnModel) -> Result:
        result = super()._as_result(maps, model)
        if self.nuisances is None:
            return result
        return result.assign(process={**result.process, **self.nuisances.process})

    def _tilt_of_frames(self) -> float | None:
        """Return the tilt, if it is given, or can be estimated from a turn that another one follows."""
        if self.window_frames is not None:
            return self.window.model.tilt
        if not isinstance(self.tilt, str):
            return None if self.tilt is None else float(np.asarray(self.tilt))
        if self._model is None and self._stack is not None:
            turn, *others = self._turns_in(self._phase)
            fit = self._fit_of(self._phase[turn], self._weights[turn], first=True)
            if fit is not None and others:
                self._model = self._kernel.estimate_model(thinned(self._stack[turn])[0], fit)
        return None if self._model is None else self._model.tilt

    @property
    def corrected_kinds(self) -> tuple[str, ...]:
        """Kinds of findings about frames that are corrected."""
        return () if self.nuisances is None else tuple(self.nuisances.process)

    def apply_correction(self, frames: NDArray[Any], first: int) -> NDArray[Any]:
        """Return frames without what is wrong with their brightness."""
        assert self.nuisances is not None
        base, dark = (0.0 if values is None else values for values in (self.zenith_offset, self.dark))
        return self.nuisances.remove(frames, first, dark, base)

    def push(self, frames: NDArray[Any], *, phase: ArrayLike, frame_weights: ArrayLike | None = None) -> None:
        """Process the next frames, (n, H, W), the phase of each, (n,) radians, and their weights, (n,)."""
        alpha = check_phase(phase, len(frames), "phase")
        self._has_weights |= frame_weights is not None
        if self.window_frames is None:
            self._push(frames, alpha, frame_weights)
        elif frame_weights is not None:
            raise InputError("frames in a window have no weights: leave frame_weights or window_frames out")
        else:
            self._window.push(on_host(frames), alpha)

    def result(self) -> Result:
        """Return the maps of the window, or of all turns; the last turn ends with the last frame."""
        if self.window_frames is None:
            return super().result()
        window = self._window
        window.estimate(bare=False)
        return normals_result(window.maps.read(*MAPS), window.model, 1, window.length)
