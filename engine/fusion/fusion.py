"""One surface from absolute heights and normals, such as those of a press and of a rotation."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.device_arrays import device_of_maps
from mirrorskin.engine.base.inputs import Maps, pixel_size_of, required_maps
from mirrorskin.engine.base.method import Method
from mirrorskin.engine.base.provenance import naming
from mirrorskin.engine.base.reconstruction import calibrated
from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.base.running import Progress, Run, run_over
from mirrorskin.engine.base.steps import Context, Step, undistorted
from mirrorskin.engine.base.tiling import MEMORY_LIMIT
from mirrorskin.engine.diagnosis.footprint import PIXEL
from mirrorskin.engine.fusion.common_height import PressSteps
from mirrorskin.engine.fusion.solver import AbsoluteHeights, FusionSolver
from mirrorskin.engine.integration.normals_to_height import (
    Slopes,
    describe_integration,
    separate_errors,
    slopes_of,
)
from mirrorskin.engine.press.intervals import heights_as_intervals, stored_heights_as_intervals
from mirrorskin.engine.press.nuisances import Edges, Nuisances, footprint_of
from mirrorskin.engine.press.press import Press
from mirrorskin.engine.rotation.response import wall_response_of
from mirrorskin.engine.rotation.rotation import Rotation, at_poses
from mirrorskin.engine.rotation.steps import take_slopes
from mirrorskin.io import InputError, Motion, Result, Source, open_recording, open_result, pixel_axes
from mirrorskin.io.base.arguments import as_array_or_number, check_count, check_flag, checked, in_unit
from mirrorskin.io.base.findings import Finding, carried, in_process, warn
from mirrorskin.io.base.types import ProcessValue, exclusive_use
from mirrorskin.io.base.url import path_of
from mirrorskin.io.files.opening import is_result
from mirrorskin.io.formats.registry import is_of_others
from mirrorskin.io.model.fitted import taken_from
from mirrorskin.io.model.result import absolute_heights
from mirrorskin.kernels.device import Choice, open_devices

Mask = NDArray[np.bool_]

_SIZE_TOLERANCE = 1e-6  # largest relative difference of pixel sizes
_PASSES = 3  # over the axial frames, at most
_MAX_MOVEMENT = 0.02  # pixels that points may move between the last two passes
_MIN_SIGMA = 1e-4  # radians: smallest standard deviation of normals; neighbours at a curve contradict by more
_FROM_RESULTS = Finding(
    "fused results",
    "the surface is that of two results. If these are of a press and a rotation, engine.fuse of both"
    " recordings, or 'mirrorskin fuse', registers the rotation with the fused heights and is more accurate",
    False,
)


@checked(
    pixel_size=in_unit("mm"),
    mask=as_array_or_number,
    robust=check_flag,
    register=check_flag,
    memory_limit=check_count,
)
def fuse(
    heights: Source | Maps,
    normals: Source | Maps,
    pixel_size: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
    robust: bool = False,
    register: bool = True,
    press: Press | Mapping[str, Any] | None = None,
    rotation: Rotation | Mapping[str, Any] | None = None,
    memory_limit: int = MEMORY_LIMIT,
    device: Choice = None,
    progress: Progress | None = None,
) -> Result:
    """Join heights and normals of the same pixels to one surface in absolute millimetres.

    Give the recordings of a press and of a rotation, or two results. Recordings are more accurate: the frames
    of the rotation are registered for the shift of the pivot with the heights of the press, then with those
    of the joined surface, until points move by less than a fiftieth of a pixel, at most three times. A source
    that cannot be read twice is registered once. The heights of results are those of a press, a focus stack,
    or of any operation; their normals are those of a rotation, of photometric stereo, or of any operation.

    The surface is the one that fits the slopes of the normals and the heights best, weighted by inverse
    variance; see `mirrorskin.engine.integrate`. After a first solution, each height is treated as an
    interval, such as that between two frames of a press: only heights near the ends of their intervals have a
    weight in the final solution; see `mirrorskin.engine.press.intervals`.

    Where there is a height but no normal, the surface has that height; near normals it has the slope of a
    smooth surface fitted to the surrounding heights, if one fits. Where there is a normal but no height,
    slopes determine the surface. Components without any height are marked in ``offset_unknown``. Holes that
    have neither are filled, and marked so (`mirrorskin.engine.fill_holes`); filled pixels have no standard
    deviation.

    Parameters
    ----------
    heights : Source, Result, mapping, xarray.Dataset or path
        A press, as an open recording, its path or another source, such as `mirrorskin.io.ArrayRecording` for
        frames in an array. Or a result, with ``height`` and ``height_sigma``, (H, W), mm; NaN where unknown.
        Maps that are on a device are copied to the host once, and the surface is computed on that device. A
        map that is declared with the quantity "height" serves as well. Heights of components whose offset is
        unknown are not used.
    normals : Source, Result, mapping, xarray.Dataset or path
        A rotation, likewise, if ``heights`` is a press. Or a result, with ``normals``, (H, W, 3), and
        ``normals_sigma``, (H, W), radians; NaN where unknown. If there is ``contact``, (H, W), normals where
        it is 0 are not used. With a ``tilt``, radians, the normals are those of a precession,
        whose errors depend on the direction.
    pixel_size : float or (float, float), optional
        For results: millimetres along x and y; by default that of the heights.
    mask : array_like, (H, W), optional
        For results: nonzero where heights are wanted; by default everywhere.
    robust : bool
        Whether the surface may break, at discontinuities that are found in it.
    register : bool
        For recordings: whether the frames of the rotation follow the object; they must not where the pivot is
        unknown.
    press, rotation : Press and Rotation, or mappings of their options, optional
        For recordings: how to reconstruct them. Holes of the press are not filled.
    memory_limit : int
        For recordings: bytes of host memory for frames that are read ahead.
    device : str, Device or sequence of them, optional
        See ``mirrorskin.kernels.device.open_devices``.
    progress : callable, optional
        For recordings: called with the number of frames so far. A rotation is read up to three times.

    Returns
    -------
    Result
        ``height``, ``height_sigma``, ``component``, ``offset_unknown`` and ``filled``; ``edges`` if robust.
        Of recordings, also ``status`` of the press and the maps of the rotation. Their process values begin
        with ``vertical_`` or ``axial_``.

    Raises
    ------
    mirrorskin.io.InputError
        A recording and a result; other motions; pixels or maps of different sizes; a missing map; no height
        and no normal at all; a pixel size that is not possible; or what `Press` and `Rotation` refuse.
    mirrorskin.engine.NotConverged
        The surface was not found.

    Notes
    -----
    Errors of normals are assumed to be independent and normally distributed. Each height is assumed to be
    within sqrt(3) ``height_sigma`` of the surface, with equal probability everywhere in this interval. A
    height that is rounded to multiples of a step fits this with step / sqrt(12) as its sigma. Heights of a
    press are moved to the middles of the intervals between its frames; those of a result only if at least a
    quarter are there already, because it may have been changed. Without the travel of the frames, heights
    that several pixels share are the middles.

    If normals are those of a rotation whose frames were not registered, the differences between heights and
    surface are part of ``height_sigma``.

    All heights of a component have an error in common, which normals cannot reduce. The steps of a press
    show it: at each, the pixels in contact must be the highest ones. A clear error is removed, and the
    standard deviation of the common height is part of ``height_sigma``. If the surface of a component rises
    by less than one step, ``height_sigma`` is at least that of a single height. The frames of heights from
    other sources are unknown; ``height_sigma`` then contains only a part: add step / sqrt(12) in quadrature.

    Examples
    --------
    >>> from mirrorskin import engine
    >>> from mirrorskin.twin import Axial, Twin, Vertical
    >>> ball = {"object": "sphere", "shape": (50, 50), "pixel_size": 0.1}
    >>> press = Twin(movement=Vertical(0.1 * np.arange(1, 31)), **ball)
    >>> eighths = np.pi / 4 * np.arange(8)
    >>> turn = Twin(movement=Axial(eighths, tilt=0.05, press=1.5), pattern="linear", **ball)
    >>> surface = engine.fuse(press, turn)
    >>> error = engine.score(surface, turn.truth).height
    >>> error.rms < 0.005  # mm
    True

    Of results, or other maps:

    >>> heights = {"height": np.array([[1.0, np.nan]]), "height_sigma": np.array([[0.01, np.nan]])}
    >>> upright = np.array([[[0.0, 0.0, 1.0]] * 2])
    >>> normals = {"normals": upright, "normals_sigma": np.full((1, 2), 0.01)}
    >>> engine.fuse(heights, normals, 0.1).height.tolist()
    [[1.0, 1.0]]
    """
    with ExitStack() as opening:
        first, second = (
            _opened(name, value, memory_limit, opening)
            for name, value in (("heights", heights), ("normals", normals))
        )
        sources = _is_source(first)
        if sources != _is_source(second):
            recording, result = ("heights", "normals") if sources else ("normals", "heights")
            raise InputError(
                f"{recording} is a recording, but {result} is a result: give two recordings, or two results"
                " (engine.reconstruct)"
            )
        for_results: dict[str, Any] = {"pixel_size": pixel_size, "mask": mask}
        for_recordings: dict[str, Any] = {"press": press, "rotation": rotation}
        for name, value in (for_results if sources else for_recordings).items():
            if value is not None:
                kind, others = ("results", "recordings") if sources else ("recordings", "results")
                raise InputError(f"{name} is for {kind}, but {others} are fused. Remove it")
        if not sources:
            return _fuse_maps(first, second, pixel_size, mask, robust, device)
        options: dict[str, Any] = {"memory_limit": memory_limit, "device": device, "progress": progress}
        return fuse_sources(first, second, **for_recordings, register=register, robust=robust, **options)


def _is_source(value: Any) -> bool:
    return hasattr(value, "header") and hasattr(value, "motion")


def _opened(name: str, value: Any, memory_limit: int, opening: ExitStack) -> Any:
    """Return a source, or maps; a file is opened as what it is."""
    if isinstance(value, str | os.PathLike):
        path = path_of(os.fspath(value))
        if not is_of_others(path) and is_result(path):
            return open_result(path)
        return opening.enter_context(open_recording(path, memory_limit=memory_limit))
    if getattr(value, "ndim", None) == 3 and (name == "heights" or value.shape[-1] != 3):
        raise InputError(
            f"{name} is an array of shape {tuple(value.shape)}: give frames as io.ArrayRecording(frames,"
            " {'travel': travel}, {'pixel_size': (0.03, 0.03)}), a rotation with 'phase' and its tilt, press"
            " and pivot"
        )
    return value


def _fuse_maps(
    heights: Maps,
    normals: Maps,
    pixel_size: ArrayLike | None,
    mask: ArrayLike | None,
    robust: bool,
    device: Choice,
) -> Result:
    """Return the surface of heights and normals."""
    height_maps = required_maps("heights", heights, "height", "height_sigma")
    normal_maps = required_maps("normals", normals, "normals", "normals_sigma")
    selected = _check_shapes(height_maps, normal_maps, mask)
    size = pixel_size_of(height_maps, "heights", pixel_size)
    height = absolute_heights(height_maps)
    assert height is not None
    values, sigma = (np.asarray(map_, np.float64) for map_ in (height, height_maps.height_sigma))
    travel = height_maps.fitted.frame_travel
    intervals = stored_heights_as_intervals(values, sigma, None if travel is None else np.array(travel))
    absolute = AbsoluteHeights.of(*intervals, selected)
    tilt = normal_maps.fitted.tilt
    moved = 0.0  # pixels that points move in frames that were not registered
    if tilt is not None and not normal_maps.fitted.registered:
        moved = (
            math.sin(tilt)
            * float(np.max(np.abs(absolute.height), initial=0, where=absolute.defined))
            / min(size)
        )
    slopes = _slopes_of_maps(normal_maps, selected, moved)
    opened = device_of_maps(device, height_maps, normal_maps)
    footprint = max(height_maps.fitted.footprint or PIXEL, normal_maps.fitted.footprint or PIXEL)
    steps = None
    if travel is not None and intervals.middle is not values:  # heights were not changed since
        steps = PressSteps.of(values, values, absolute.sigma, np.array(travel))
    solver = FusionSolver(absolute, size, robust, opened, footprint, moved > 0, steps)
    solver.modes = normal_maps.fitted.common_errors or ()
    surface = solver.filled(solver.surface(slopes))
    x, y = pixel_axes(selected.shape, size)
    if height_maps.x is not None and height_maps.y is not None:
        x, y = height_maps.x, height_maps.y
    process = describe_integration([surface]) | solver.process
    warn("fuse", process)
    if tilt is not None:
        process |= in_process([_FROM_RESULTS], process)
    process |= carried(process, heights=height_maps.process, normals=normal_maps.process)
    fitted = normal_maps.fitted.place | height_maps.fitted.place | taken_from(process)
    return surface.assign(x=x, y=y, process=process, fitted=fitted)


def _slopes_of_maps(normals: Result, selected: Mask, moved: float) -> Slopes:
    """Return the slopes of a result's normals, in frames whose points moved by some pixels.

    Where the contact ends, but not at single pixels without it, a pixel shows points outside of the contact
    in some frames: such normals are not used. If frames were registered, which interpolates them, the errors
    of neighbours are correlated.
    """
    contact = np.ones(selected.shape, np.uint8)
    if normals.contact is not None:
        contact = (np.asarray(normals.contact) != 0).astype(np.uint8)
    if moved > 0:
        border = math.ceil(moved) + 1
        whole = cv2.morphologyEx(contact, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        inner = cv2.erode(whole, np.ones((2 * border + 1, 2 * border + 1), np.uint8), borderValue=1)
        contact[inner == 0] = 0
    contact[~selected] = 0
    sigma = np.asarray(normals.normals_sigma, np.float32)
    sigma = np.where((sigma >= 0) & (sigma < _MIN_SIGMA), np.float32(_MIN_SIGMA), sigma)
    return slopes_of(*separate_errors(normals.assign(normals_sigma=sigma)), contact)


def _check_shapes(heights: Result, normals: Result, mask: ArrayLike | None) -> Mask:
    """Return the mask of wanted heights; raise InputError unless all maps have one size."""
    shapes = {
        "height": np.shape(heights.height),
        "height_sigma": np.shape(heights.height_sigma),
        "normals": np.shape(normals.normals)[:2],
        "normals_sigma": np.shape(normals.normals_sigma),
    }
    if normals.contact is not None:
        shapes["contact"] = np.shape(normals.contact)
    if mask is not None:
        shapes["mask"] = np.shape(mask)
    rows, columns = size = shapes["height"] if len(shapes["height"]) == 2 else (0, 0)
    if 0 in size or any(shape != size for shape in shapes.values()):
        sizes = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise InputError(f"maps of one size (H, W) are needed, there are: {sizes}")
    return np.ones((rows, columns), bool) if mask is None else np.asarray(mask) != 0


def fuse_sources(
    vertical: Source,
    axial: Source,
    *,
    press: Press | Mapping[str, Any] | None = None,
    rotation: Rotation | Mapping[str, Any] | None = None,
    register: bool = True,
    robust: bool = False,
    memory_limit: int = MEMORY_LIMIT,
    device: Choice = None,
    progress: Progress | None = None,
    evidence: tuple[Result, PressEvidence] | None = None,
) -> Result:
    """Reconstruct a press and a rotation, and return the surface of both; see `fuse`.

    ``evidence`` is that of `press_evidence` of the press, if it was computed before.
    """
    vertical, axial = calibrated(vertical), calibrated(axial)
    pixel_size = _check_sources(vertical, axial)
    opened = open_devices(device)
    common: dict[str, Any] = {"memory_limit": memory_limit, "device": opened}
    turn = Rotation(**{**_options_of(rotation), **common})
    _check_rotation(axial, turn)
    pressed, taken = evidence or press_evidence(vertical, {**_options_of(press), **common}, progress)
    if not np.isfinite(pressed.height).any():
        raise InputError(f"{vertical.name}: no pixel turned light, so no height is known to fuse")
    before = fill_with_nearest(pressed.height)
    solver = FusionSolver(taken.heights, pixel_size, robust, opened[0], taken.footprint, steps=taken.steps)
    passes = _passes(axial, register)
    for number in range(passes):
        registered = turn.with_options(heights=before) if register else turn
        processed = vertical.shape[0] + number * axial.shape[0]
        turned, slopes = _rotate(registered, axial, _after(progress, processed))
        solver.footprint = max(taken.footprint, turned.fitted.footprint or PIXEL)
        solver.modes = turned.fitted.common_errors or ()
        # The first of several surfaces is rarely the last one, so its sigma is not needed.
        surface = solver.surface(slopes, sigma=number > 0 or passes == 1)
        assert turned.fitted.tilt is not None
        change = np.where(slopes.defined, surface.height - before, np.nan)
        moved = _moved(change, turned.fitted.tilt, pixel_size)
        if moved <= _MAX_MOVEMENT:
            break
        before = fill_with_nearest(surface.height)
    if surface.height_sigma is None:
        surface = solver.surface(slopes)
    surface = solver.filled(surface)
    warn(axial.name, turned.process)
    warn(f"{vertical.name} and {axial.name}", solver.process)
    if progress:
        progress(frames_to_read(vertical, axial, register))
    joined = describe_integration([surface]) | solver.process
    process = _both(pressed.process, turned.process) | joined | {"heights": "none"}
    if register:
        process |= {"heights": "fused", "registrations": number + 1, "last_move_in_pixels": moved}
    if surface.edges is not None:
        surface = surface.assign(edges=turned.edges | surface.edges)
    result = turned.assign(
        surface,
        status=pressed.status,
        x=pressed.x,
        y=pressed.y,
        process=process,
        fitted=turned.fitted | taken_from(joined),
        declarations={"status": pressed.declaration("status")},
    )
    return undistorted(result, axial)


def frames_to_read(vertical: Source, axial: Source, register: bool = True) -> int:
    """Return the largest number of frames that `fuse` reads from recordings of a press and a rotation."""
    return vertical.shape[0] + _passes(axial, register) * axial.shape[0]


def _passes(axial: Source, register: bool) -> int:
    return _PASSES if register and axial.rewindable else 1


def _options_of(method: Method | Mapping[str, Any] | None) -> Mapping[str, Any]:
    """Return the options of a method, or a mapping of options."""
    return method.option_values() if isinstance(method, Method) else method or {}


def press_evidence(
    vertical: Source, options: Mapping[str, Any], progress: Progress | None = None
) -> tuple[Result, PressEvidence]:
    """Return the maps of a press by options of `Press`, without filled holes, and its evidence."""
    taken = PressEvidence(blur=options.get("blur"))
    method = Press(**{**options, "fill": False, "blur": 0.0})
    return run_over(vertical, method, progress, [taken]), taken


class PressEvidence(Step):
    """Take what the solver needs from a press: heights as intervals, and the area that a pixel sees.

    Slopes determine how far a lens that blurs has moved each height, but they are blurred as well.
    """

    blur: float | None = Nuisances.blur

    def apply(self, result: Result, context: Context) -> Result:
        """Return the result unchanged."""
        height, sigma = (
            np.asarray(context.computed[name], np.float64) for name in ("height", "height_sigma")
        )
        middle, between = heights_as_intervals(height, sigma, context.positions("travel"))
        # Checks and steps, such as the correction for the elastomer, move heights and change their sigma.
        larger = result.height_sigma * (between / sigma)
        self.heights = AbsoluteHeights.of(result.height + (middle - height), larger)
        corrected = np.asarray(result.height, np.float64)
        travel, travel_sigma = context.positions("travel"), getattr(context.operation, "travel_sigma", None)
        self.deepest = float(np.max(travel))
        self.steps = PressSteps.of(height, corrected, self.heights.sigma, travel, travel_sigma)
        footprint = footprint_of(Edges.of(result, context), context.source.header, self.blur)
        self.footprint = footprint.variance if footprint.clear else PIXEL
        return result


def _rotate(method: Rotation, axial: Source, progress: Progress | None) -> tuple[Result, Slopes]:
    """Return the normals of a rotation, and the slopes that are integrated."""
    with exclusive_use(axial), naming(axial):
        return take_slopes(Run(method.slope_plan(axial), axial).complete(progress))


def _check_sources(vertical: Source, axial: Source) -> tuple[float, float]:
    """Return the pixel size that both sources have, or raise InputError."""
    if (vertical.motion, axial.motion) == ("axial", "vertical"):
        raise InputError(f"{vertical.name} is the rotation and {axial.name} the press: give the press first")
    by_motion: dict[Motion, Source] = {"vertical": vertical, "axial": axial}
    for motion, source in by_motion.items():
        if source.motion != motion:
            raise InputError(
                f"{source.name} has {source.motion} motion: a vertical one and an axial one are needed"
            )
        if source.header.pixel_size is None:
            raise InputError(f"{source.name} has no pixel size, which a fusion needs: give it")
    sizes = [(source.shape[2], source.shape[1]) for source in (vertical, axial)]
    pixels = [source.header.pixel_size or (0.0, 0.0) for source in (vertical, axial)]
    differences = []
    if sizes[0] != sizes[1]:
        differences.append(" and ".join(f"{width} x {height} pixels" for width, height in sizes))
    origins = [getattr(source, "origin", (0, 0)) for source in (vertical, axial)]
    if origins[0] != origins[1]:
        differences.append(
            " and ".join(f"regions from column {column}, row {row}" for row, column in origins)
        )
    if not np.allclose(pixels[0], pixels[1], rtol=_SIZE_TOLERANCE, atol=0):
        differences.append(" and ".join(f"pixels of {width:g} x {height:g} mm" for width, height in pixels))
    if differences:
        differ = "; ".join(differences)
        raise InputError(
            f"{vertical.name} and {axial.name} differ: {differ}: record both with the same camera and crop"
        )
    return pixels[0]


def _check_rotation(axial: Source, rotation: Rotation) -> None:
    """Raise InputError unless a rotation has the normals of one picture."""
    has_gain = axial.header.zenith_gain is not None or wall_response_of(axial) is not None
    if not has_gain and rotation.zenith_gain is None:
        raise InputError(
            f"{axial.name} has no zenith gain, so no normals to fuse: give the gain, or a calibration"
        )
    if at_poses(axial, rotation.tilt):
        raise InputError(f"{axial.name} has a tilt of each frame: a fusion needs turns of one tilt")
    if rotation.per_turn:
        raise InputError(f"{axial.name}: all turns make one surface: leave per_turn out")
    if rotation.heights is not None:
        raise InputError(f"{axial.name}: frames are registered with the heights of the press: give no others")


def _moved(change: NDArray[np.floating], tilt: float, pixel_size: tuple[float, float]) -> float:
    """Return the 99th percentile of the shift of points, pixels, by a change of their heights."""
    change = np.abs(change[np.isfinite(change)])
    return float(np.percentile(change, 99) * np.sin(tilt) / min(pixel_size)) if change.size else 0.0


def _after(progress: Progress | None, processed: int) -> Progress | None:
    """Return a progress that starts at a number of frames."""
    return None if progress is None else lambda count: progress(processed + count)


def _both(vertical: Mapping[str, ProcessValue], axial: Mapping[str, ProcessValue]) -> dict[str, ProcessValue]:
    """Merge two processes: common values once, others prefixed with the motion."""
    shared = {name: axial[name] for name in ("program", "version", "date", "device", "driver")}
    process = shared | {"source": f"{vertical['source']}, {axial['source']}", "method": "fusion"}
    for motion, values in ("vertical", vertical), ("axial", axial):
        process |= {f"{motion}_{name}": value for name, value in values.items() if name not in shared}
    return process
