"""One surface of both movements: absolute heights of a press, and the normals of a rotation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.fusion_solver import FusionSolver, PressHeights
from mirrorskin.engine.integration.surface import Surface
from mirrorskin.engine.nearest_fill import fill_with_nearest
from mirrorskin.engine.press.onset import Onset
from mirrorskin.engine.press.press import reconstruct_press
from mirrorskin.engine.provenance import attach_provenance
from mirrorskin.engine.reconstruction import calibrated, undistorted
from mirrorskin.engine.rotation.normals import Normals
from mirrorskin.engine.rotation.normals_to_height import Slopes, describe_integration, find_slopes
from mirrorskin.engine.rotation.response import wall_response_of
from mirrorskin.engine.rotation.rotation import Rotation, at_poses, estimate_rotation, rotation_maps
from mirrorskin.engine.streaming import Progress
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Motion, Result, Source
from mirrorskin.io.arguments import check_has, checked
from mirrorskin.io.types import ProcessValue
from mirrorskin.kernels.device import Device, open_device

Mask = NDArray[np.bool_]

_SAME = 1e-6  # share by which pixel sizes may differ
_PASSES = 3  # over the axial frames, at most
_STILL = 0.02  # of a pixel, by which points may move between passes


@checked
def fuse(
    onset: Onset,
    normals: Normals,
    pixel_size: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    robust: bool = False,
    device: str | Device | None = None,
) -> Surface:
    """Join the heights of a press and the normals of a rotation to one surface in absolute millimetres.

    The surface is the one that fits the slopes of the normals and the known heights best, weighted by inverse
    variance; see ``mirrorskin.engine.integrate``. A height lies in the interval between two frames, which is
    more than its standard deviation says: once a first surface is there, heights inside their intervals pull
    no more, and those at the ends do; see `mirrorskin.engine.press.intervals`.

    Where there is a height but no normal, the height is the press's own; near normals it gets the slope of
    the smooth surface that fits the heights around, if one does. Where there is a normal but no height,
    slopes lead there. Components without any known height are marked in ``offset_unknown``. Holes that have
    neither are filled, and marked so (`mirrorskin.engine.fill_holes`); filled pixels have no sigma.

    Parameters
    ----------
    onset : Onset
        Or anything with ``height`` and ``sigma``, (H, W), mm; NaN where unknown.
    normals : Normals
        Or anything with ``vectors``, (H, W, 3), ``sigma``, (H, W), radians, and ``contact``, (H, W). In the
        same pixels.
    pixel_size : float or (float, float)
        Millimetres along x and y.
    mask : array_like, (H, W), optional
        Nonzero where heights are wanted; by default everywhere.
    robust : bool
        Whether the surface may break, at discontinuities that are found in it.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.

    Returns
    -------
    Surface

    Raises
    ------
    mirrorskin.io.InputError
        Maps of different sizes, no height and no normal at all, or a pixel size that cannot be.
    mirrorskin.engine.NotConverged
        The surface was not found.

    Examples
    --------
    >>> from types import SimpleNamespace as Maps
    >>> onset = Maps(height=np.array([[1.0, np.nan]]), sigma=np.array([[0.01, np.nan]]))
    >>> upright = np.array([[[0.0, 0.0, 1.0]] * 2])
    >>> normals = Maps(vectors=upright, sigma=np.full((1, 2), 0.01), contact=np.ones((1, 2)))
    >>> fuse(onset, normals, 0.1).height.tolist()
    [[1.0, 1.0]]
    """
    check_has("onset", onset, "height", "sigma")
    check_has("normals", normals, "vectors", "sigma", "contact")
    wanted = _check_shapes(onset, normals, mask)
    slopes = find_slopes(
        normals.vectors,
        normals.sigma,
        np.where(wanted, normals.contact, 0).astype(np.uint8),
        getattr(normals, "tilt", None),
        getattr(normals, "turns", 1),
    )
    press = PressHeights.of(onset.height, onset.sigma, wanted)
    solver = FusionSolver(press, pixel_size, robust, open_device(device))
    return solver.filled(solver.surface(slopes))


def _check_shapes(onset: Onset, normals: Normals, mask: ArrayLike | None) -> Mask:
    """Return where heights are wanted, if all maps are of one size."""
    shapes = {
        "heights": np.shape(onset.height),
        "their sigmas": np.shape(onset.sigma),
        "normals": np.shape(normals.vectors)[:2],
        "their sigmas ": np.shape(normals.sigma),
        "contact": np.shape(normals.contact),
    }
    if mask is not None:
        shapes["the mask"] = np.shape(mask)
    size = shapes["heights"]
    if len(size) != 2 or 0 in size or any(shape != size for shape in shapes.values()):
        found = ", ".join(f"{name.strip()} {shape}" for name, shape in shapes.items())
        raise InputError(f"maps of one size (H, W) are needed, there are: {found}")
    return np.ones(size, bool) if mask is None else np.asarray(mask) != 0


def fuse_sources(
    vertical: Source,
    axial: Source,
    *,
    press: Mapping[str, Any] | None = None,
    rotation: Mapping[str, Any] | None = None,
    register: bool = True,
    robust: bool = False,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Reconstruct a press and a rotation on the same object, and join them to one surface.

    The axial frames are registered for the pivot's shift with the press's heights, then again with those of
    the joined surface, until points move by less than a fiftieth of a pixel; at most three times. A source
    that cannot be read twice is registered once.

    Parameters
    ----------
    vertical, axial : Source
        On the same pixels. They are rewound first, if they can be, and are read as the calibrations that
        they carry say.
    press, rotation : mapping, optional
        Further options of `reconstruct_press` and `reconstruct_rotation`: how to read the one and the other.
    register : bool
        Whether frames follow the object; they must not where the pivot is unknown.
    robust : bool
        As for `fuse`.
    memory_limit : int
        Bytes of host memory for frames on the move.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    progress : callable, optional
        Called with the number of frames so far, of ``frames_to_read(vertical, axial, register)``.

    Returns
    -------
    Result
        Heights and normals. Process values of one source alone begin with ``vertical_`` or ``axial_``.

    Raises
    ------
    mirrorskin.io.InputError
        Other motions, pixels that differ, no height at all, or what `reconstruct_press`,
        `reconstruct_rotation` and `Registered` refuse.
    mirrorskin.engine.NotConverged
        The surface was not found.
    """
    vertical, axial = calibrated(vertical), calibrated(axial)
    pixel_size = _check_sources(vertical, axial)
    rotation = rotation or {}
    _check_rotation(axial, rotation)
    opened = open_device(device)
    common: dict[str, Any] = {"memory_limit": memory_limit, "device": opened}
    heights = reconstruct_press(vertical, **(press or {}), fill=False, progress=progress, **common)
    assert heights.height is not None
    assert heights.height_sigma is not None
    if not np.isfinite(heights.height).any():
        raise InputError(f"{vertical.name}: no pixel turned light, so no height is known to fuse")
    onset = PressHeights.of(heights.height, heights.height_sigma)
    before = fill_with_nearest(heights.height)
    solver, passes = FusionSolver(onset, pixel_size, robust, opened), _passes(axial, register)
    for number in range(passes):
        found = estimate_rotation(
            axial,
            **rotation,
            heights=before if register else None,
            progress=_after(progress, vertical.shape[0] + number * axial.shape[0]),
            **common,
        )
        # The first of several surfaces is hardly ever the last.
        surface = solver.surface(_slopes_of(found), sigma=number > 0 or passes == 1)
        moved = _moved(before, surface.height, found.normals.tilt, pixel_size)
        if moved <= _STILL:
            break
        before = fill_with_nearest(surface.height)
    if surface.sigma is None:
        surface = solver.surface(_slopes_of(found))
    surface = solver.filled(surface)
    if progress:
        progress(frames_to_read(vertical, axial, register))
    turned = attach_provenance(Result(), axial, opened, found.process)
    process = _both(heights.process, turned.process) | describe_integration([surface]) | {"heights": "none"}
    if register:
        process |= {"heights": "fused", "registrations": number + 1, "last_move_in_pixels": moved}
    together = _put_together(heights, found, surface)
    return undistorted(together.assign(process=process, calibration=turned.calibration), axial)


def frames_to_read(vertical: Source, axial: Source, register: bool = True) -> int:
    """Return how many frames `fuse_sources` reads at most."""
    return vertical.shape[0] + _passes(axial, register) * axial.shape[0]


def _passes(axial: Source, register: bool) -> int:
    return _PASSES if register and axial.rewindable else 1


def _check_sources(vertical: Source, axial: Source) -> tuple[float, float]:
    """Return the pixel size that both sources have, or raise InputError."""
    if (vertical.motion, axial.motion) == ("axial", "vertical"):
        raise InputError(f"{vertical.name} is the rotation and {axial.name} the press: give the press first")
    wanted: dict[Motion, Source] = {"vertical": vertical, "axial": axial}
    for motion, source in wanted.items():
        if source.motion != motion:
            raise InputError(
                f"{source.name} is of {source.motion} motion: a vertical one and an axial one are needed"
            )
        if source.header.pixel_size is None:
            raise InputError(f"{source.name} does not say its pixel size, which fusion needs: give it")
    sizes = [(source.shape[2], source.shape[1]) for source in (vertical, axial)]
    pixels = [source.header.pixel_size or (0.0, 0.0) for source in (vertical, axial)]
    ways = []
    if sizes[0] != sizes[1]:
        ways.append(" and ".join(f"{width} x {height} pixels" for width, height in sizes))
    origins = [getattr(source, "origin", (0, 0)) for source in (vertical, axial)]
    if origins[0] != origins[1]:
        ways.append(" and ".join(f"regions from column {column}, row {row}" for row, column in origins))
    if not np.allclose(pixels[0], pixels[1], rtol=_SAME, atol=0):
        ways.append(" and ".join(f"pixels of {width:g} x {height:g} mm" for width, height in pixels))
    if ways:
        differ = "; ".join(ways)
        raise InputError(
            f"{vertical.name} and {axial.name} differ: {differ}: record both with the same camera and crop"
        )
    return pixels[0]


def _check_rotation(axial: Source, rotation: Mapping[str, Any]) -> None:
    """Refuse a rotation that gives no normals, or not those of one picture."""
    known = axial.header.zenith_gain is not None or wall_response_of(axial) is not None
    if not known and rotation.get("gain") is None:
        raise InputError(
            f"{axial.name} has no zenith gain, so no normals to fuse: give the gain, or a calibration"
        )
    if at_poses(axial, rotation.get("tilt")):
        raise InputError(f"{axial.name} has a tilt of each frame: a fusion needs turns of one tilt")
    if rotation.get("per_turn"):
        raise InputError(f"{axial.name}: all turns make one surface: do not ask for each turn's own")


def _slopes_of(rotation: Rotation) -> Slopes:
    normals = rotation.normals
    return find_slopes(
        normals.vectors,
        normals.sigma,
        normals.contact,
        normals.tilt,
        normals.turns,
        rotation.independent_sigma,
    )


def _put_together(heights: Result, rotation: Rotation, surface: Surface) -> Result:
    """Return the maps of a press, a rotation and the surface of both."""
    edges = rotation.edges if surface.edges is None else rotation.edges | surface.edges
    return rotation_maps(rotation).assign(
        height=surface.height,
        height_sigma=surface.sigma,
        status=heights.status,
        edges=edges,
        filled=surface.filled,
        component=surface.component,
        offset_unknown=surface.offset_unknown.astype(np.uint8),
        x=heights.x,
        y=heights.y,
        declarations={"status": heights.declaration("status")},
    )


def _moved(
    before: NDArray[np.float32], after: NDArray[np.float32], tilt: float, pixel_size: tuple[float, float]
) -> float:
    """Return by how many pixels nearly all points move when their heights become others."""
    change = np.abs(before - after)[np.isfinite(after)]
    return float(np.percentile(change, 99) * np.sin(tilt) / min(pixel_size)) if change.size else 0.0


def _after(progress: Progress | None, done: int) -> Progress | None:
    """Return a progress that counts on from so many frames."""
    return None if progress is None else lambda count: progress(done + count)


def _both(vertical: Mapping[str, ProcessValue], axial: Mapping[str, ProcessValue]) -> dict[str, ProcessValue]:
    """Join two processes: once what is the same of both, the rest under the movements' names."""
    shared = {name: axial[name] for name in ("program", "version", "date", "device", "driver")}
    made = shared | {"source": f"{vertical['source']}, {axial['source']}", "method": "fusion"}
    for motion, process in ("vertical", vertical), ("axial", axial):
        made |= {f"{motion}_{name}": value for name, value in process.items() if name not in shared}
    return made
