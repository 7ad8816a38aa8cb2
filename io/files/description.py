"""Summaries of the contents of files, for printing."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.findings import Finding
from mirrorskin.io.base.text import course
from mirrorskin.io.base.types import PROPERTIES, InputError
from mirrorskin.io.base.url import is_zarr, path_of
from mirrorskin.io.files.arrays import list_arrays
from mirrorskin.io.files.opening import open_recording
from mirrorskin.io.files.recording import Recording
from mirrorskin.io.files.result_file import open_result
from mirrorskin.io.formats.registry import format_of_frames, format_of_surface, holds_arrays, open_reader
from mirrorskin.io.model.calibration import PARTS, Calibration
from mirrorskin.io.model.frames import FrameReader
from mirrorskin.io.model.result import Result
from mirrorskin.io.storage.calibration_file import MARK as CALIBRATION_MARK
from mirrorskin.io.storage.calibration_file import open_calibration
from mirrorskin.io.storage.hdf5 import Hdf5File
from mirrorskin.io.storage.layout import MARK, RESULT_MARK
from mirrorskin.io.storage.zarr import open_file


def describe(path: str | Path, *, dataset: str | None = None, channel: int | None = None) -> dict[str, str]:
    """Describe a file: a recording, a result, a calibration, or frames or a surface of another program.

    ``dataset`` and ``channel`` choose frames as in ``open_recording``.

    Returns
    -------
    dict of str
        Names and values to print.

    Raises
    ------
    InputError
        The file cannot be read, or is damaged.

    Examples
    --------
    >>> describe("press.h5")["motion"]  # doctest: +SKIP
    'vertical'
    """
    path = path_of(path)
    form = format_of_frames(path)
    surface = None if form else format_of_surface(path)
    if (dataset, channel) != (None, None) and form is None:
        raise InputError(f"{path}: all stacks of such a file are listed: leave --dataset and --channel out")
    if holds_arrays(path):
        return {"kind": "NumPy array", **list_arrays(path)}
    if form is not None:
        with open_reader(path, form, dataset=dataset, channel=channel, verify=False) as frames:
            return _frames(form.name, frames)
    if surface is not None:
        return _result(open_result(path)) | {"kind": f"surface, {surface.name}"}
    with open_file(path) as file:
        ours, result = file.marked(MARK), file.marked(RESULT_MARK)
        calibration = file.marked(CALIBRATION_MARK)
        stacks = {} if ours or result or calibration else file.stacks() or _linked(file)
    if calibration:
        return {"kind": "calibration", **_calibration(open_calibration(path))}
    if ours:
        with open_recording(path) as recording:
            return _recording(recording)
    if result:
        return _result(open_result(path))
    container = "Zarr" if is_zarr(path) else "HDF5 file"
    return {"kind": f"{container} of another layout", "stacks": str(len(stacks)), **stacks}


def _linked(file: Hdf5File) -> dict[str, str]:
    """Return the stacks that links of a file lead to, with their sizes and types."""
    linked = file.linked_stacks().items()
    return {name: f"{' x '.join(map(str, node.shape))} {node.dtype} (a link)" for name, node in linked}


def _frames(kind: str, frames: FrameReader) -> dict[str, str]:
    """Describe the frames of a file or folder of another program."""
    count, rows, columns = frames.shape
    facts = {"kind": kind}
    facts |= {"frames": f"{count} of {columns} x {rows}, {frames.dtype.name}", "storage": frames.how}
    facts |= _range("time", frames.time, "s")
    for name, unit in (("travel", "mm"), ("phase", "rad"), ("twist", "rad")):
        facts |= _range(name, frames.positions.get(name), unit)
    if frames.lost is not None:
        facts["dropped"] = f"{np.sum(frames.lost)} frames"
    if frames.left_out:
        facts["left out"] = ", ".join(frames.left_out)
    return facts | _findings(frames.findings)


def _findings(findings: Iterable[Finding]) -> dict[str, str]:
    return {f"finding: {finding.kind}": finding.text for finding in findings}


def _recording(recording: Recording) -> dict[str, str]:
    header = recording.header
    count, rows, columns = recording.shape
    facts = {
        "kind": "recording",
        "title": header.title,
        "start": header.start_time,
        "motion": recording.motion,
        "frames": f"{count} of {columns} x {rows}, {recording.dtype}",
        "storage": recording.storage,
    }
    if recording.used is not None:
        facts["state"] = recording.state
        facts["used"] = f"{np.count_nonzero(recording.used)} of {count} frames"
    if recording.dropped is not None:
        facts["dropped"] = f"{np.sum(recording.dropped)} frames"
    if header.pixel_size is not None:
        x, y = header.pixel_size
        facts["pixel size"] = f"{x:g} x {y:g} mm, field {x * columns:g} x {y * rows:g} mm"
    facts |= _range("travel", recording.travel, "mm")
    facts |= _range("phase", None if recording.phase is None else np.degrees(recording.phase), "deg")
    facts |= _range("twist", None if recording.twist is None else np.degrees(recording.twist), "deg")
    if recording.displacement is not None:
        along_x, along_y = recording.displacement.T
        facts |= _range("displacement x", along_x, "mm") | _range("displacement y", along_y, "mm")
    if header.press is not None:
        facts["press"] = f"{header.press:g} mm"
    if header.tilt is not None:
        facts["tilt"] = f"{np.degrees(header.tilt):g} deg"
    facts |= _range("tilt", None if recording.tilt is None else np.degrees(recording.tilt), "deg")
    facts |= {
        name.replace("_", " "): f"{value:g} {prop.unit}"
        for name, prop in PROPERTIES.items()
        if (value := getattr(header, name)) is not None
    }
    if recording.motion == "axial":
        facts["zenith gain"] = _counts(header.zenith_gain, "counts/rad")
        facts["zenith offset"] = _counts(header.zenith_offset, "counts")
    if header.camera:
        facts["camera"] = header.camera
    facts |= _carried(recording.carried)
    for name in ("dark", "bright"):
        facts[f"{name} reference"] = _counts(getattr(header, name), "counts")
    facts["truth"] = ", ".join(recording.truth_maps) or "none"
    return facts | _findings(recording.findings)


def _counts(values: NDArray[np.floating] | None, unit: str) -> str:
    """Return a number, or the median of a map, as text."""
    if values is None:
        return "none"
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "no valid pixel"
    return f"{np.median(finite):g} {unit}{' (median)' if np.ndim(values) else ''}"


def _range(name: str, values: NDArray[np.float64] | None, unit: str) -> dict[str, str]:
    if values is None:
        return {}
    return {name: f"{' to '.join(f'{value:g}' for value in course(values.tolist()))} {unit}"}


def _result(result: Result) -> dict[str, str]:
    facts = {"kind": "result"}
    for name, values in result.maps().items():
        unit = result.declaration(name).unit
        facts[f"map {name}"] = f"{' x '.join(map(str, values.shape))} {values.dtype} {unit}".rstrip()
    for name, value in result.numbers().items():
        facts[name] = f"{value:.4g} {result.declaration(name).unit}".rstrip()
    if result.filled is not None:
        facts["filled"] = f"{np.count_nonzero(result.filled)} pixels"
    if result.offset_unknown is not None:
        count, unknown = result.offset_unknown.size, np.count_nonzero(result.offset_unknown)
        facts["components"] = f"{count}, {unknown} with an unknown offset"
    facts |= {name: str(value) for name, value in result.process.items()}
    return facts | _carried(result.calibration)


def _carried(calibration: Calibration | None) -> dict[str, str]:
    """Return a calibration copied into a file in one line."""
    if calibration is None:
        return {}
    return {"carried calibration": f"{calibration.contents} of camera {calibration.camera}"}


def _calibration(calibration: Calibration) -> dict[str, str]:
    facts = {"camera": str(calibration.camera)}
    for name, kind in PARTS.items():
        part = calibration.parts().get(name)
        if part is None and name in ("stiffness", "response"):
            continue  # shown only where they exist, which is rare
        if part is None:
            facts[kind.command] = "none"
        else:
            facts |= {f"{row.part}.{row.what}": row.text for row in part.rows()}
    return facts | {
        name: f"{value:.4g}" if isinstance(value, float) else str(value)
        for name, value in calibration.process.items()
    }
