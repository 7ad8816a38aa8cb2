"""One surface from absolute heights and normals, such as those of a press and of a rotation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.device_arrays import device_of_maps
from mirrorskin.engine.fusion_solver import AbsoluteHeights, FusionSolver
from mirrorskin.engine.inputs import Maps, as_result, pixel_size_of
from mirrorskin.engine.method import Context, Method, undistorted
from mirrorskin.engine.nearest_fill import fill_with_nearest
from mirrorskin.engine.press.blur import PIXEL, LensBlur
from mirrorskin.engine.press.intervals import heights_as_intervals
from mirrorskin.engine.press.press import Press
from mirrorskin.engine.provenance import attach_provenance, naming
from mirrorskin.engine.reconstruction import calibrated
from mirrorskin.engine.rotation.normals_to_height import Slopes, describe_integration, slopes_of
from mirrorskin.engine.rotation.response import wall_response_of
from mirrorskin.engine.rotation.rotation import Rotation, at_poses
from mirrorskin.engine.rotation.steps import Integration
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Motion, Result, Source, pixel_axes
from mirrorskin.io.arguments import as_array_or_number, check_count, check_flag, checked, in_unit
from mirrorskin.io.findings import in_process, warn
from mirrorskin.io.result import absolute_heights
from mirrorskin.io.types import ProcessValue, exclusive_use
from mirrorskin.kernels.device import Choice, Device, open_devices

Mask = NDArray[np.bool_]

_SAME = 1e-6  # largest relative difference of pixel sizes
_PASSES = 3  # over the axial frames, at most
_STILL = 0.02  # pixels that points may move between the last two passes


@checked(pixel_size=in_unit("mm"), mask=as_array_or_number, robust=check_flag)
def fuse(
    heights: Maps,
    normals: Maps,
    pixel_size: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
    robust: bool = False,
    device: str | Device | None = None,
) -> Result:
    """Join heights and normals of the same pixels to one surface in absolute millimetres.

    Heights are those of a press, a focus stack, or of any operation; normals are those of a rotation, of
    photometric stereo, or of any operation. The surface is the one that fits the slopes of the normals and
    the heights best, weighted by inverse variance; see `mirrorskin.engine.integrate`. After a first solution,
    each height is treated as an interval, such as that between two frames of a press: only heights near the
    ends of their intervals have a weight in the final solution; see `mirrorskin.engine.press.intervals`.

    Where there is a height but no normal, the surface has that height; near normals it has the slope of a
    smooth surface fitted to the surrounding heights, if one fits. Where there is a normal but no height,
    slopes determine the surface. Components without any height are marked in ``offset_unknown``. Holes that
    have neither are filled, and marked so (`mirrorskin.engine.fill_holes`); filled pixels have no standard
    deviation.

    Parameters
    ----------
    heights : Result, mapping, xarray.Dataset or path
        With ``height`` and ``height_sigma``, (H, W), mm; NaN where unknown. Maps that are on a device are
        copied to the host once, and the surface is computed on that device. A map that is declared with the
        quantity "height" serves as well. Heights of components whose offset is unknown are not used.
    normals : Result, mapping, xarray.Dataset or path
        With ``normals``, (H, W, 3), and ``normals_sigma``, (H, W), radians; NaN where unknown. If there is
        ``contact``, (H, W), normals where it is 0 are not used. If its process has a ``tilt``, radians, the
        normals are those of a precession, whose errors depend on the direction.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the heights.
    mask : array_like, (H, W), optional
        Nonzero where heights are wanted; by default everywhere.
    robust : bool
        Whether the surface may break, at discontinuities that are found in it.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Result
        ``height``, ``height_sigma``, ``component``, ``offset_unknown`` and ``filled``; ``edges`` if robust.

    Raises
    ------
    mirrorskin.io.InputError
        A map is missing, maps have different sizes, there is no height and no normal at all, or the pixel
        size is not possible.
    mirrorskin.engine.NotConverged
        The surface was not found.

    Notes
    -----
    Errors of normals are assumed to be independent and normally distributed. Each height is assumed to be
    within sqrt(3) ``height_sigma`` of the surface, with equal probability everywhere in this interval. A
    height that is rounded to multiples of a step fits this with step / sqrt(12) as its sigma.

    If the surface of a component rises by less than one step, all of its heights have nearly the same error,
    which normals cannot reduce. The returned ``height_sigma`` contains only a part of it: add
    step / sqrt(12) in quadrature.

    Examples
    --------
    >>> heights = {"height": np.array([[1.0, np.nan]]), "height_sigma": np.array([[0.01, np.nan]])}
    >>> upright = np.array([[[0.0, 0.0, 1.0]] * 2])
    >>> normals = {"normals": upright, "normals_sigma": np.full((1, 2), 0.01)}
    >>> fuse(heights, normals, 0.1).height.tolist()
    [[1.0, 1.0]]
    """
    height_maps = _maps_of("heights", heights, "height", "height_sigma")
    normal_maps = _maps_of("normals", normals, "normals", "normals_sigma")
    wanted = _check_shapes(height_maps, normal_maps, mask)
    contact = 1 if normal_maps.contact is None else normal_maps.contact
    slopes = slopes_of(normal_maps, contact=np.where(wanted, contact, 0).astype(np.uint8))
    height = absolute_heights(height_maps)
    assert height is not None
    known = AbsoluteHeights.of(height, height_maps.height_sigma, wanted)
    size = pixel_size_of(height_maps, "heights", pixel_size)
    solver = FusionSolver(known, size, robust, device_of_maps(device, height_maps, normal_maps))
    surface = solver.filled(solver.surface(slopes))
    x, y = pixel_axes(wanted.shape, size)
    if height_maps.x is not None and height_maps.y is not None:
        x, y = height_maps.x, height_maps.y
    process = describe_integration([surface]) | solver.process
    warn("fuse", process)
    return surface.assign(x=x, y=y, process=process)


def _maps_of(name: str, maps: Maps, *needed: str) -> Result:
    """Return maps as a result; InputError if it lacks a required map."""
    result = as_result(maps, name, quantity=needed[0])
    missing = [one for one in needed if result.name_of(one) is None]
    if missing:
        has = ", ".join(result) or "no maps"
        raise InputError(f"{name} has no map {missing[0]}: it has {has}")
    return result


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


@checked(register=check_flag, robust=check_flag, memory_limit=check_count)
def fuse_recordings(
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
) -> Result:
    """Reconstruct a press and a rotation on the same object, and join them to one surface.

    The axial frames are registered for the pivot's shift with the heights of the press, then with those of
    the joined surface, until points move by less than a fiftieth of a pixel; at most three times. A source
    that cannot be read twice is registered once.

    Parameters
    ----------
    vertical, axial : Source
        On the same pixels. They are rewound first, if they can be, and are read with the calibrations that
        they carry.
    press, rotation : Press and Rotation, or mappings of their options, optional
        How to reconstruct the one and the other. Holes of the press are not filled.
    register : bool
        Whether frames follow the object; they must not where the pivot is unknown.
    robust : bool
        As for `fuse`.
    memory_limit : int
        Bytes of host memory for frames that are read ahead.
    device : str, Device or sequence of them, optional
        See ``mirrorskin.kernels.device.open_devices``.
    progress : callable, optional
        Called with the number of frames so far, of ``frames_to_read(vertical, axial, register)``.

    Returns
    -------
    Result
        Heights and normals. Process values of one source alone begin with ``vertical_`` or ``axial_``.

    Raises
    ------
    mirrorskin.io.InputError
        Other motions, pixels that differ, no height at all, or what `Press`, `Rotation` and `Registered`
        refuse.
    mirrorskin.engine.NotConverged
        The surface was not found.
    """
    vertical, axial = calibrated(vertical), calibrated(axial)
    pixel_size = _check_sources(vertical, axial)
    opened = open_devices(device)
    common: dict[str, Any] = {"memory_limit": memory_limit, "device": opened}
    turn = Rotation(**{**_options_of(rotation), **common})
    _check_rotation(axial, turn)
    pressed, known, footprint = _press({**_options_of(press), **common, "fill": False}, vertical, progress)
    if not np.isfinite(pressed.height).any():
        raise InputError(f"{vertical.name}: no pixel turned light, so no height is known to fuse")
    before = fill_with_nearest(pressed.height)
    solver = FusionSolver(known, pixel_size, robust, opened[0], footprint)
    passes = _passes(axial, register)
    for number in range(passes):
        method = turn.with_options(heights=before) if register else turn
        done = vertical.shape[0] + number * axial.shape[0]
        turned, slopes = _rotate(method, axial, _after(progress, done))
        # The first of several surfaces is rarely the last one, so its sigma is not needed.
        surface = solver.surface(slopes, sigma=number > 0 or passes == 1)
        moved = _moved(before, surface.height, float(turned.process["tilt"]), pixel_size)
        if moved <= _STILL:
            break
        before = fill_with_nearest(surface.height)
    if surface.height_sigma is None:
        surface = solver.surface(slopes)
    surface = solver.filled(surface)
    warn(axial.name, turned.process)
    warn(f"{vertical.name} and {axial.name}", solver.process)
    if progress:
        progress(frames_to_read(vertical, axial, register))
    signed = attach_provenance(Result(), axial, opened, dict(turned.process))
    process = (
        _both(pressed.process, signed.process)
        | describe_integration([surface])
        | solver.process
        | {"heights": "none"}
    )
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
        calibration=signed.calibration,
        declarations={"status": pressed.declaration("status")},
    )
    return undistorted(result, axial)


def frames_to_read(vertical: Source, axial: Source, register: bool = True) -> int:
    """Return the largest number of frames that `fuse_recordings` reads."""
    return vertical.shape[0] + _passes(axial, register) * axial.shape[0]


def _passes(axial: Source, register: bool) -> int:
    return _PASSES if register and axial.rewindable else 1


def _options_of(method: Method | Mapping[str, Any] | None) -> Mapping[str, Any]:
    """Return the options of a method, or a mapping of options."""
    return method.chosen() if isinstance(method, Method) else method or {}


def _press(
    options: Mapping[str, Any], vertical: Source, progress: Progress | None
) -> tuple[Result, AbsoluteHeights, float]:
    """Return the maps of a press, its heights as intervals between frames, and the area that a pixel sees.

    Slopes determine how far a lens that blurs has moved each height, but they are blurred as well.
    """
    lens, method = LensBlur(blur=options.get("blur")), Press(**{**options, "blur": 0.0})
    with exclusive_use(vertical), naming(vertical):
        plan = method.plan(vertical)
        found = feed(vertical, plan.operation, plan.frames, progress)
        onsets = plan.operation.finish()
        result = plan.finish(onsets, vertical)
    result = result.assign(process={**result.process, **in_process(found, result.process)})
    warn(vertical.name, result.process)
    height, sigma = (np.asarray(onsets[name], np.float64) for name in ("height", "height_sigma"))
    middle, between = heights_as_intervals(height, sigma, plan.operation.pushed("travel"))
    # Steps, such as the correction for the elastomer, move heights and change their sigma.
    sigma = result.height_sigma * (between / sigma)
    footprint = lens.footprint(result, Context(vertical, plan.operation, plan.stream or vertical))
    variance = footprint.variance if footprint is not None and footprint.clear else PIXEL
    return result, AbsoluteHeights.of(result.height + (middle - height), sigma), variance


def _rotate(method: Rotation, axial: Source, progress: Progress | None) -> tuple[Result, Slopes]:
    """Return the normals of a rotation, and the slopes that are integrated."""
    with exclusive_use(axial), naming(axial):
        plan = method.plan(axial)
        stream = plan.stream or axial
        found = feed(stream, plan.operation, plan.frames, progress)
        result = plan.operation.finish()
    context = Context(axial, plan.operation, stream)
    result = result.assign(
        dict.fromkeys(plan.omit), process={**plan.process, **result.process, **in_process(found, {})}
    )
    slopes = None
    for step in plan.steps:
        if isinstance(step, Integration):
            slopes = step.slopes(result, context)
        else:
            result = step.apply(result, context)
    assert slopes is not None
    return result, slopes


def _check_sources(vertical: Source, axial: Source) -> tuple[float, float]:
    """Return the pixel size that both sources have, or raise InputError."""
    if (vertical.motion, axial.motion) == ("axial", "vertical"):
        raise InputError(f"{vertical.name} is the rotation and {axial.name} the press: give the press first")
    wanted: dict[Motion, Source] = {"vertical": vertical, "axial": axial}
    for motion, source in wanted.items():
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
    if not np.allclose(pixels[0], pixels[1], rtol=_SAME, atol=0):
        differences.append(" and ".join(f"pixels of {width:g} x {height:g} mm" for width, height in pixels))
    if differences:
        differ = "; ".join(differences)
        raise InputError(
            f"{vertical.name} and {axial.name} differ: {differ}: record both with the same camera and crop"
        )
    return pixels[0]


def _check_rotation(axial: Source, rotation: Rotation) -> None:
    """Raise InputError unless a rotation has the normals of one picture."""
    known = axial.header.zenith_gain is not None or wall_response_of(axial) is not None
    if not known and rotation.zenith_gain is None:
        raise InputError(
            f"{axial.name} has no zenith gain, so no normals to fuse: give the gain, or a calibration"
        )
    if at_poses(axial, rotation.tilt):
        raise InputError(f"{axial.name} has a tilt of each frame: a fusion needs turns of one tilt")
    if rotation.per_turn:
        raise InputError(f"{axial.name}: all turns make one surface: leave per_turn out")
    if rotation.heights is not None:
        raise InputError(f"{axial.name}: frames are registered with the heights of the press: give no others")


def _moved(
    before: NDArray[np.float32], after: NDArray[np.float32], tilt: float, pixel_size: tuple[float, float]
) -> float:
    """Return the 99th percentile of the shift of points, pixels, by a change of their heights."""
    change = np.abs(before - after)[np.isfinite(after)]
    return float(np.percentile(change, 99) * np.sin(tilt) / min(pixel_size)) if change.size else 0.0


def _after(progress: Progress | None, done: int) -> Progress | None:
    """Return a progress that starts at a number of frames."""
    return None if progress is None else lambda count: progress(done + count)


def _both(vertical: Mapping[str, ProcessValue], axial: Mapping[str, ProcessValue]) -> dict[str, ProcessValue]:
    """Merge two processes: common values once, others prefixed with the motion."""
    shared = {name: axial[name] for name in ("program", "version", "date", "device", "driver")}
    process = shared | {"source": f"{vertical['source']}, {axial['source']}", "method": "fusion"}
    for motion, values in ("vertical", vertical), ("axial", axial):
        process |= {f"{motion}_{name}": value for name, value in values.items() if name not in shared}
    return process
