"""What a slide or a twist tells: where the skin sticks, where and when it slips, and how far it moves."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin import io
from mirrorskin.engine.errors import NotConverged
from mirrorskin.engine.provenance import attach_provenance, naming
from mirrorskin.engine.slip.displacement import STEP
from mirrorskin.engine.slip.search import MOTIONS, WINDOW, SlipSearch, check_contact
from mirrorskin.engine.streaming import Progress, feed
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import InputError, Result
from mirrorskin.io.maps import TWIST, SlipStatus, status_of
from mirrorskin.io.types import UNDISTORTED

if TYPE_CHECKING:
    from mirrorskin.io import Source
    from mirrorskin.io.types import ProcessValue
    from mirrorskin.kernels.device import Device


def reconstruct_slip(
    source: Source,
    *,
    contact: Result | str | Path | ArrayLike | None = None,
    per_frame: bool = False,
    window: int = WINDOW,
    step: int = STEP,
    noise: float | None = None,
    modulus: float | None = None,
    memory_limit: int = MEMORY_LIMIT,
    device: str | Device | None = None,
    progress: Progress | None = None,
) -> Result:
    """Reconstruct displacement and slip from a slide or a twist, by `SlipSearch`.

    Parameters
    ----------
    source : Source
        Of horizontal motion or a twist, with a known pixel size. It is rewound first, if it can be.
    contact : Result, path or array_like, (H, W), optional
        Where the skin touches the object in the first frame: a press's result, its file, or a map that is not
        0 there. Heights alone tell where light is, which runs ahead of an elastic contact (the process says
        so); a pressure tells contact. Without it, contact is estimated, and comes out too wide.
    per_frame : bool
        Whether the displacement is that of each frame, and not of the last alone.
    window, step, noise
        As for `mirrorskin.engine.find_displacement`.
    modulus : float, optional
        Young's, MPa, for ``traction`` and the force along the sheet; by default that of the calibration.
    memory_limit : int
        Bytes of host memory for frames on the move.
    device : str or Device, optional
        See ``mirrorskin.kernels.device.open_device``.
    progress : callable, optional
        Called with the number of frames so far.

    Returns
    -------
    Result
        ``displacement``, ``displacement_sigma``, ``slip_onset``, ``slip_onset_sigma``, ``status``,
        ``contact``, ``way`` and ``stick_ratio``; with a modulus ``traction``, ``force_x`` and ``force_y``, if
        the frames begin before any load along the sheet; of a twist the process has ``angle``, ``centre_x``
        and ``centre_y`` of the skin that sticks.

    Raises
    ------
    mirrorskin.io.InputError
        The input cannot be used: no pixel size, a body that does not move, a sheet without texture, or a
        contact of another size.
    """
    search, told = slip_search(
        source,
        contact=contact,
        per_frame=per_frame,
        window=window,
        step=step,
        noise=noise,
        memory_limit=memory_limit,
        device=device,
    )
    feed(source, search, range(source.shape[0]), progress)
    return slip_result(source, search, contact=told, modulus=modulus)


def slip_search(
    source: Source,
    *,
    contact: Result | str | Path | ArrayLike | None,
    per_frame: bool,
    window: int,
    step: int,
    noise: float | None,
    memory_limit: int,
    device: str | Device | None,
) -> tuple[SlipSearch, str]:
    """Make the estimator for a source, and say where its contact is from; see `reconstruct_slip`."""
    if source.motion not in MOTIONS:
        raise InputError(f"{source.name} is of {source.motion} motion: slip is of {' and '.join(MOTIONS)}")
    if source.header.pixel_size is None:
        raise InputError(f"{source.name} has no pixel size, which slip takes: give --pixel-size")
    right, up = _off_centre(source)
    there, told = _read_contact(contact, (source.shape[1], source.shape[2]))
    search = SlipSearch(
        (source.shape[1], source.shape[2]),
        source.dtype,
        source.header.pixel_size,
        motion="twist" if source.motion == "twist" else "horizontal",
        contact=there,
        centre=(-right, -up),
        window=window,
        step=step,
        noise=noise,
        per_frame=per_frame,
        memory_limit=memory_limit,
        device=device,
    )
    return search, told


def slip_result(source: Source, search: SlipSearch, *, contact: str, modulus: float | None = None) -> Result:
    """Return the maps as a result, with how they came about, and where the contact is from."""
    with naming(source):
        found = search.result()
    process: dict[str, ProcessValue] = {
        "motion": source.motion,
        "frames": len(found.way),
        "window": search.window,
        "step": search.step,
        "noise": found.noise,
        "contact": contact,
    }
    if found.centre is not None and found.angle is not None:
        (right, up), (x, y) = _off_centre(source), found.centre
        process |= {"angle": found.angle, "centre_x": x + right, "centre_y": y + up}
    twist = source.motion == "twist"
    result = Result(
        displacement=found.displacement,
        displacement_sigma=found.displacement_sigma,
        slip_onset=found.slip_onset,
        slip_onset_sigma=found.slip_onset_sigma,
        status=found.status,
        contact=found.contact,
        stick_ratio=found.stick_ratio,
        slide_distance=None if twist else found.way,
        twist_angle=found.way if twist else None,
        declarations={"status": status_of(SlipStatus), **(TWIST if twist else {})},
    )
    result, said = _with_force(result, source, search, modulus)
    return attach_provenance(result, source, search.device, process | said)


def _with_force(
    result: Result, source: Source, search: SlipSearch, modulus: float | None
) -> tuple[Result, dict[str, ProcessValue]]:
    """Add traction and force, where the modulus is known; what was done is for the process."""
    known = source.calibration.stiffness if isinstance(source, io.Calibrated) and modulus is None else None
    young = known.modulus if known is not None else modulus
    if young is None:
        return result, {}
    from mirrorskin.engine.force.tangential import find_tangential_force

    assert result.displacement is not None
    assert source.header.pixel_size is not None
    moved = result.displacement
    try:
        found = find_tangential_force(
            moved if moved.ndim == 3 else moved[-1],
            source.header.pixel_size,
            young,
            contact=result.contact,
            sigma=result.displacement_sigma,
            window=search.window,
            modulus_sigma=0.0 if known is None else math.sqrt(known.covariance[0, 0]),
        )
    except (InputError, NotConverged) as error:
        return result, {"force": f"none: {error}"}
    result = result.assign(
        traction=found.traction,
        force_x=float(found.force[0]),
        force_x_sigma=float(found.sigma[0]),
        force_y=float(found.force[1]),
        force_y_sigma=float(found.sigma[1]),
    )
    whose = "given" if known is None else "of the calibration"
    return result, {"modulus": f"{young:.4g} MPa, {whose}"}


def _off_centre(source: Source) -> tuple[float, float]:
    """Return where the middle of the frames is, mm from the whole picture's centre."""
    own = source.source if isinstance(source, io.Calibrated) else source
    if not isinstance(own, io.Recording) or source.header.pixel_size is None:
        return 0.0, 0.0
    _, rows, columns = own.full_shape
    return own.region.centre((rows, columns), source.header.pixel_size)


def _read_contact(
    contact: Result | str | Path | ArrayLike | None, shape: tuple[int, int]
) -> tuple[NDArray[np.bool_] | None, str]:
    """Return where the skin touches, if that is given, and what the process says of it."""
    if contact is None:
        return None, "estimated"
    if isinstance(contact, str | Path):
        try:
            return _read_contact(io.open_result(contact), shape)
        except InputError as error:
            raise (error if str(contact) in str(error) else InputError(f"{contact}: {error}")) from error
    if not isinstance(contact, Result):
        return check_contact(contact, shape), "given"
    if contact.process.get(UNDISTORTED):
        raise InputError("the contact is undistorted, and the frames are not: make it without a lens")
    if contact.pressure is not None:
        return check_contact(contact.pressure > 0, shape), "given"
    if contact.contact is not None:
        return check_contact(contact.contact, shape), "given"
    if contact.height is None:
        raise InputError("the contact's result has neither contact nor heights: give that of a press")
    return check_contact(np.isfinite(contact.height), shape), "given, by light"
