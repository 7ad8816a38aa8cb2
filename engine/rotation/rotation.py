"""Normals, contact, edges and heights from an axial rotation, or its correlation only.

Frames are read once if brightness is linear in the zenith. Under a calibrated wall, brightness also depends
on the height of the surface: unless given, it is estimated from the first turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.inputs import as_result
from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.provenance import level_origin, parameter_origin
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.base.running import Run
from mirrorskin.engine.base.sources import EditedSource
from mirrorskin.engine.base.steps import Step
from mirrorskin.engine.correlation.correlation import Correlate
from mirrorskin.engine.correlation.design_matrix import LONGEST, check_turning, split_into_turns
from mirrorskin.engine.diagnosis.registration import Registered, check_heights
from mirrorskin.engine.rotation.coarse_height import coarse_heights
from mirrorskin.engine.rotation.last_turn import LastTurn
from mirrorskin.engine.rotation.moving_normals import MovingNormals
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.normals_kernel import NormalMethod
from mirrorskin.engine.rotation.poses import even_windows, rocks
from mirrorskin.engine.rotation.response import HALF_WAY, Response, initial_response, wall_response_of
from mirrorskin.engine.rotation.steps import Edges, Integration, SlopeMaps
from mirrorskin.io import Block, Calibrated, Header, InputError, Recording, Source, WallResponse, open_heights
from mirrorskin.io.base.findings import carried
from mirrorskin.io.base.types import exclusive_use
from mirrorskin.io.files.arrays import ArrayRecording
from mirrorskin.io.files.opening import is_result
from mirrorskin.io.files.result_file import open_process
from mirrorskin.io.model.positions import check_phase
from mirrorskin.io.model.result import absolute_heights
from mirrorskin.kernels.array_types import Doubles

if TYPE_CHECKING:
    from mirrorskin.io.base.types import ProcessValue

_NO_GAIN = "none: the recording has no zenith gain"
_HEIGHT_ITERATIONS = 2  # iterations of the height of the object
_OMIT = ("cosine", "sine")  # redundant: they follow from azimuth and modulation


class Rotation(Method):
    """Normals of an axial rotation of one turn or more, and the heights that fit them.

    Brightness follows the zenith response of the source's calibration (see `mirrorskin.io.Calibrated`).
    Without one, it is assumed to be linear in the zenith between the source's dark and bright references, if
    it has them. Without a zenith gain, the result has azimuth, mean, cosine, sine, modulation and residual
    only; without a pixel size, no heights. Heights are relative: the mean of each component is 0.

    If the source has a tilt of each frame, or two phases half a turn apart, its frames are at given poses;
    see `mirrorskin.engine.rotation.MovingNormals`. Rocking determines a slope, but no heights.

    `run` returns ``normals``, ``zenith`` and ``azimuth``, ``normals_sigma``, ``contact``, ``mean``,
    ``modulation``, ``residual`` and ``edges``; with a pixel size also ``height``, ``height_sigma``,
    ``component`` and ``offset_unknown``.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> from mirrorskin.twin import Axial, Twin
    >>> movement = Axial(np.pi / 4 * np.arange(8), tilt=0.05, press=1.0)
    >>> turn = Twin(
    ...     object="sphere", shape=(40, 40), pixel_size=0.26, movement=movement, pattern="linear"
    ... )
    >>> result = engine.Rotation().run(turn)
    >>> bool(np.nanmax(np.abs(result.zenith - turn.truth.zenith)) < 0.01)  # radians
    True
    >>> result.height.shape
    (40, 40)
    """

    motions = ("axial",)

    method: NormalMethod = Normals.method
    tilt: float | Literal["estimate"] | None = Normals.tilt
    heights: Any = option(
        default=None,
        file="RES.h5",
        help="heights of the surface, mm, to register frames for the shift of the pivot; with a calibrated"
        " response, the default is to estimate them in a first pass over the source",
    )
    window_frames: int | None = Normals.window_frames
    longest: int | None = Normals.longest
    per_turn: bool = Normals.per_turn
    zenith_gain: ArrayLike | None = Normals.zenith_gain
    zenith_offset: ArrayLike | None = Normals.zenith_offset
    dark: ArrayLike | None = Normals.dark
    bright: ArrayLike | None = Normals.bright
    noise: float | None = Normals.noise
    blur: float | None = Normals.blur
    robust: bool = Integration.robust

    def check_options(self) -> None:
        """Raise InputError if options do not fit together or cannot be those of a rotation."""
        if self.heights is not None and self.tilt == "estimate":
            raise InputError("heights register frames, which needs a tilt: give it instead of 'estimate'")
        self.configure(Normals)

    def plan(self, source: Source) -> Plan:
        """Return the operation for a source, depending on the poses and on the response."""
        phase = getattr(source, "phase", None)
        if phase is not None:
            check_turning(phase)
        wall = self._wall_of(source)
        if self.zenith_gain is None and source.header.zenith_gain is None and wall is None:
            return self._correlation(source)
        if at_poses(source, self.tilt):
            return self._poses(source)
        header = self._header(source)
        heights = _heights_of(self.heights, source)
        plan = (
            self._linear(source, header, heights)
            if wall is None
            else self._calibrated(source, header, wall, heights)
        )
        inherited = carried({}, heights=_process_of(self.heights))
        return replace(plan, process={**plan.process, **inherited})

    def slope_plan(self, source: Source) -> Plan:
        """Return the plan with slopes instead of heights; see `mirrorskin.engine.rotation.steps`."""
        return replace(self.plan(source), steps=[Edges(), SlopeMaps()])

    def live_plan(self, source: Source) -> Plan:
        """Return the normals of the last turn, without registration, or what the source determines."""
        wall = self._wall_of(source)
        no_gain = self.zenith_gain is None and source.header.zenith_gain is None
        if self.tilt is None and source.header.tilt is None:
            if no_gain:
                raise InputError(
                    f"{source.name} has no zenith gain, so no slopes. Set zenith_gain in the rig file"
                )
            return self._poses(source)
        if no_gain and wall is None:
            return self._correlation(source)
        operation = self.configure(LastTurn).configured_for(source)
        brightness = self._brightness(source) if wall is None else {"zenith": "calibrated"}
        process = {**self._process(), **brightness, "window_frames": operation.window_frames}
        return Plan(operation, self._steps(), process)

    def _wall_of(self, source: Source) -> WallResponse | None:
        return wall_response_of(source) if self.zenith_gain is None else None

    def _correlation(self, source: Source) -> Plan:
        if self.per_turn or self.heights is not None:
            what = "turns of their own" if self.per_turn else "use for heights"
            raise InputError(
                f"{source.name} has no zenith gain, so no normals, and no {what}: give zenith_gain"
            )
        return Plan(self.configure(Correlate), process={"method": "correlation", "zenith": _NO_GAIN})

    def _poses(self, source: Source) -> Plan:
        if self.heights is not None or self.method != "exact":
            what = f"method {self.method!r}" if self.heights is None else "registering frames with heights"
            raise InputError(f"{source.name}: {what} needs one tilt for all frames: leave it out")
        longest = even_windows(source.shape[0])
        operation = self.configure(MovingNormals, longest=longest).configured_for(source)
        process = {"method": "exact", "tilt_from": "each frame: this is their root mean square"}
        tilt = source.header.tilt

        def with_tilts(block: Block) -> Block:
            return replace(block, tilt=np.full(len(block.frames), tilt))

        stream = None if tilt is None else EditedSource(source, with_tilts)
        return Plan(operation, self._steps(), process, omit=_OMIT, stream=stream)

    def _linear(self, source: Source, header: Header, heights: ArrayLike | None) -> Plan:
        """Return the plan for brightness that is linear in the zenith."""
        stream = source
        if heights is not None:
            stream = Registered(source, heights, device=self.device, header=header)
        process = self._process() | self._brightness(source)
        process["heights"] = "none" if heights is None else "given"
        return Plan(self._turns(stream, header, None), self._steps(), process, None, _OMIT, stream)

    def _calibrated(
        self, source: Source, header: Header, wall: WallResponse, heights: ArrayLike | None
    ) -> Plan:
        """Return the plan for a calibrated wall; frames are registered if there is a pivot."""
        response = initial_response(wall, source, header)
        assert header.press is not None  # `initial_response` needs it
        if heights is not None:
            values = check_heights(heights, source.shape[1:])
            origin, heights = "given", fill_with_nearest(values).astype(np.float64)
        elif source.rewindable:
            origin, heights = "found in the first turn", self._first_heights(source, header, response)
        else:
            origin = "half the press: the source cannot be read twice"
            heights = _half_way(source, header.press)
        stream, response = self._placed(source, header, response, np.asarray(heights))
        process: dict[str, ProcessValue] = {
            "zenith": "calibrated",
            "zenith_error": wall.error,
            "heights": origin,
            "registered": isinstance(stream, Registered),
        }
        operation = self._turns(stream, header, response)
        return Plan(operation, self._steps(), self._process() | process, None, _OMIT, stream)

    def _first_heights(self, source: Source, header: Header, response: Response) -> Doubles:
        """Return the height of the object less the press, (H, W), mm, from the first turn."""
        pixel_size, press = header.pixel_size, header.press
        assert pixel_size is not None
        assert press is not None
        turn, heights = first_turn(source), _half_way(source, press)
        for _ in range(_HEIGHT_ITERATIONS):
            stream, response = self._placed(turn, header, response, heights)
            operation = self._turns(stream, header, response).with_options(per_turn=False)
            maps = Run(Plan(operation, checked=False), stream).complete()
            top = coarse_heights(
                maps.normals, maps.contact, response.too_level(maps.mean), pixel_size, press, self.device
            )
            heights = top - press
        return heights

    def _placed(
        self, source: Source, header: Header, response: Response, heights: Doubles
    ) -> tuple[Source, Response]:
        """Return frames registered with heights, mm, if possible, and the response for them."""
        assert header.press is not None
        follows = header.pivot is not None and header.tilt is not None
        response = response.at(header.press + heights, follows)
        if not follows:
            return source, response
        offset, per_count = response.planes[:2]  # as a scale from no light to full light
        header = replace(header, zenith_offset=offset, zenith_gain=1 / per_count)
        return Registered(source, heights, device=self.device, header=header, sight=response.sight), response

    def _turns(self, stream: Source, header: Header, response: Response | None) -> Normals:
        """Return the operation for turns of a source or of registered frames."""
        operation: Normals = self.configure(
            Normals,
            tilt="estimate" if header.tilt is None else header.tilt,
            response=response,
        )
        return operation.configured_for(stream)

    def _header(self, source: Source) -> Header:
        """Return the source's header, with options in place of its values; a tilt of None is estimated."""
        header = source.header
        tilt = header.tilt if self.tilt is None else None if self.tilt == "estimate" else self.tilt
        if tilt is None and self.tilt != "estimate":
            raise InputError(
                f"{source.name} has no tilt: give it, such as 2.5deg, or estimate it from the first turn"
            )
        gain = header.zenith_gain if self.zenith_gain is None else np.asarray(self.zenith_gain, np.float64)
        offset = header.zenith_offset if self.zenith_offset is None else self.zenith_offset
        return replace(
            header,
            tilt=tilt,
            zenith_gain=gain,
            zenith_offset=np.asarray(0.0 if offset is None else offset, np.float64),
        )

    def _steps(self) -> list[Step]:
        return [Edges(), self.configure(Integration)]

    def _process(self) -> dict[str, ProcessValue]:
        origin = "estimate" if self.tilt == "estimate" else "recording" if self.tilt is None else "given"
        return {"method": self.method, "tilt_from": origin, "per_turn": self.per_turn}

    def _brightness(self, source: Source) -> dict[str, ProcessValue]:
        """Return the origins of the parameters of a linear response."""
        header = source.header
        return {
            "zenith_gain": parameter_origin(self.zenith_gain, header.zenith_gain, "none"),
            "zenith_offset": parameter_origin(self.zenith_offset, header.zenith_offset, "0"),
            "dark": level_origin(source, "dark", self.dark),
            "bright": level_origin(source, "bright", self.bright),
        }


def _heights_of(heights: Any, source: Source) -> ArrayLike | None:
    """Return heights from a map, a result, or the path of a result or a simulation."""
    if isinstance(heights, str | Path):
        recording = source.source if isinstance(source, Calibrated) else source
        return open_heights(heights, recording if isinstance(recording, Recording) else None)
    if isinstance(heights, Mapping):
        return absolute_heights(as_result(heights, "heights"))
    return cast("ArrayLike | None", heights)


def _process_of(heights: Any) -> Mapping[str, ProcessValue]:
    """Return the process of a result with heights, or of its file; empty for others."""
    if isinstance(heights, str | Path):
        return open_process(heights) if is_result(heights) else {}
    return as_result(heights, "heights").process if isinstance(heights, Mapping) else {}


def _half_way(source: Source, press: float) -> Doubles:
    """Return the initial height of the object less the press, (H, W), mm."""
    return np.full(source.shape[1:], -HALF_WAY * press)


def at_poses(source: Source, tilt: ArrayLike | None = None) -> bool:
    """Return whether the frames of a source are at given poses, not on whole turns of one tilt.

    The first frame is read if the source does not have its positions in advance and can be rewound.
    """
    if tilt is not None or source.motion != "axial":
        return False
    phase = getattr(source, "phase", None)
    if phase is not None:
        each: NDArray[np.float64] | None = getattr(source, "tilt", None)
        return each is not None if source.header.tilt is None else rocks(phase)
    if source.header.tilt is not None or not source.rewindable:
        return False
    with exclusive_use(source):
        source.rewind()
        first = source.read()
        source.rewind()
    return first is not None and first.tilt is not None


def first_turn(source: Source) -> Recording:
    """Read the frames of a source's first turn, at most 64, into memory."""
    frames: list[NDArray[Any]] = []
    phase = np.empty(0)
    source.rewind()
    while len(frames) < LONGEST and (block := source.read()) is not None:
        more = check_phase(block.phase, len(block.frames), f"{source.name}: phase")
        phase = np.concatenate([phase, more])
        if len(split_into_turns(phase)) > 1:
            break
        frames.extend(block.frames.copy())
    header = {
        field.name: getattr(source.header, field.name) for field in fields(Header) if field.name != "motion"
    }
    stack = np.stack(frames) if frames else np.empty((0, *source.shape[1:]), source.dtype)
    return ArrayRecording(stack, {"phase": phase[: len(frames)]}, header, name=source.name)
