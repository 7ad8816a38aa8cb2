"""Provenance: the values in a result's process."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin import io
from mirrorskin.engine.base.errors import NotConverged
from mirrorskin.engine.base.options import plain

if TYPE_CHECKING:
    from mirrorskin.engine.base.options import Configured
    from mirrorskin.io import Result, Source
    from mirrorskin.io.base.types import ProcessValue
    from mirrorskin.kernels.device import Device


_ASSUMED, _ESTIMATED = "range of the type", "estimated from the frames"  # of levels


@functools.cache
def program_version() -> str:
    """Return the version of the installed package; cached, because the look-up takes a millisecond."""
    return version("mirrorskin")


def signature() -> dict[str, str]:
    """Return program, version and date, which all written files contain."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"program": "mirrorskin", "version": program_version(), "date": date}


def attach_provenance(
    result: Result, source: Source, devices: Sequence[Device], process: dict[str, ProcessValue]
) -> Result:
    """Return a result with coordinates, provenance, and the calibration if any."""
    recording = source.source if isinstance(source, io.Calibrated) else source
    origin: dict[str, ProcessValue] = {**signature(), "source": source.name}
    if devices:
        origin["device"] = _listed([device.info.title for device in devices])
        origin["driver"] = "; ".join(dict.fromkeys(device.info.driver for device in devices))
    x = y = None
    if source.header.pixel_size is not None:  # from the centre of the whole picture
        shape = recording.full_shape if isinstance(recording, io.Recording) else recording.shape
        x, y = io.pixel_axes(shape[1:], source.header.pixel_size)
    if isinstance(recording, io.Recording):
        if x is not None and y is not None:
            (row, column), (_, rows, columns) = recording.origin, recording.shape
            x, y = x[column : column + columns], y[row : row + rows]
        origin |= {
            "dataset": recording.dataset,
            "source_fingerprint": recording.fingerprint(),
            "source_modified": recording.modified,
            "source_region": recording.region.text,
            "source_frames": recording.which,
        }
        frames = (
            None
            if recording.used_live
            else (recording.first_frame, recording.first_frame + recording.shape[0])
        )
        region = (*recording.region.rows, *recording.region.columns)
        result = result.assign(fitted=replace(result.fitted, source_frames=frames, source_region=region))
    if isinstance(source, io.Calibrated):
        origin |= {"calibration": source.whole.name, "calibration_parts": source.whole.contents}
        result = result.assign(calibration=source.whole)
    return result.assign(x=x, y=y).with_process(origin | process)


def _listed(names: Sequence[str]) -> str:
    """Return names in one line, those that occur more than once with their number."""
    counts = Counter(names)
    return "; ".join(name if count == 1 else f"{count} x {name}" for name, count in counts.items())


def describe(configured: Configured, source: Source | None = None) -> dict[str, ProcessValue]:
    """Return the name of an operation, step or method, and its options, for ``process``."""
    process: dict[str, ProcessValue] = {"operation": type(configured).__name__}
    for name, value in configured.option_values().items():
        if name in ("device", "memory_limit") or value is None or (isinstance(value, Sequence) and not value):
            continue
        if isinstance(text := plain(value), str | bool | int | float):
            process[name] = text
        elif isinstance(value, Sequence):
            process[name] = str(list(value))
        elif isinstance(value, np.ndarray) and value.ndim < 2:
            process[name] = str(value.tolist()) if value.ndim else float(value)
        elif isinstance(value, np.ndarray):
            from_header = source is not None and getattr(source.header, name, None) is value
            process[name] = "map of the recording" if from_header else "map given"
        else:
            process[name] = "given"
    return process


def level_origin(
    source: Source, name: Literal["dark", "bright"], option_value: ArrayLike | None = None
) -> ProcessValue:
    """Return the origin of the level of dark or bright pixels; see `parameter_origin`."""
    references = source.calibration.references if isinstance(source, io.Calibrated) else None
    whose = "recording" if references is None else "calibration"
    return parameter_origin(option_value, getattr(source.header, name), _ASSUMED, whose)


def estimated_level(counts: float) -> str:
    """Return the text for an estimated level in ``process``."""
    return f"{counts:.4g}, {_ESTIMATED}"


def parameter_origin(
    option_value: ArrayLike | None, stored: ArrayLike | None, otherwise: str, whose: str = "recording"
) -> ProcessValue:
    """Return a parameter's value, or its origin in words: given, of the source, or a default."""
    if option_value is not None:
        return float(option_value) if np.ndim(option_value) == 0 else "map given"  # type: ignore[arg-type]
    if stored is None:
        return otherwise
    return f"map of the {whose}" if np.ndim(stored) else float(np.asarray(stored))


@contextmanager
def naming(source: Source) -> Iterator[None]:
    """Prefix the messages of errors with the source's name, unless it is an argument."""
    try:
        yield
    except (io.InputError, NotConverged) as error:
        if source.name in str(error) or not getattr(source, "names_errors", True):
            raise
        raise type(error)(f"{source.name}: {error}") from None
