"""What a result says of how it came about."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.errors import NotConverged
from mirrorskin.io import Calibrated, InputError, ProcessValue, Recording, Result, Source, pixel_axes
from mirrorskin.kernels.device import Device

Floats = NDArray[np.float64]


@functools.cache
def program_version() -> str:
    """Return the version of the installed package; to look it up takes a millisecond, so only once."""
    return version("mirrorskin")


def signature() -> dict[str, str]:
    """Return what everything that is made says of its maker: program, version and date."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"program": "mirrorskin", "version": program_version(), "date": date}


def sign(result: Result, source: Source, device: Device, process: dict[str, ProcessValue]) -> Result:
    """Add where the pixels are, and how the maps came about; and the calibration, if there is one."""
    x = y = None
    own = source.source if isinstance(source, Calibrated) else source
    if source.header.pixel_size is not None:
        x, y = _places(own, source.header.pixel_size)
    origin: dict[str, ProcessValue] = {"source": source.name}
    if isinstance(own, Recording):
        origin |= {
            "dataset": own.dataset,
            "source_fingerprint": own.fingerprint(),
            "source_modified": own.modified,
            "source_region": own.region.text,
            "source_frames": own.which,
        }
    if isinstance(source, Calibrated):
        origin |= {"calibration": source.whole.name, "calibration_parts": source.whole.contents}
        result = replace(result, calibration=source.whole)
    made: dict[str, ProcessValue] = {
        **signature(),
        "device": device.info.title,
        "driver": device.info.driver,
    }
    return replace(result, x=x, y=y, process=made | origin | process)


def _places(source: Source, pixel_size: tuple[float, float]) -> tuple[Floats, Floats]:
    """Place the pixels from the centre of the whole picture, of which a recording may give a part."""
    if not isinstance(source, Recording):
        return pixel_axes(source.shape[1:], pixel_size)
    (row, column), (_, rows, columns) = source.origin, source.shape
    x, y = pixel_axes(source.full_shape[1:], pixel_size)
    return x[column : column + columns], y[row : row + rows]


def told_level(
    source: Source, name: Literal["dark", "bright"], given: ArrayLike | None = None
) -> ProcessValue:
    """Say in a word where the level of dark or bright pixels came from."""
    references = source.calibration.references if isinstance(source, Calibrated) else None
    whose = "recording" if references is None else "calibration"
    return told(given, getattr(source.header, name), "range of the type", whose)


def told(
    given: ArrayLike | None, own: ArrayLike | None, otherwise: str, whose: str = "recording"
) -> ProcessValue:
    """Say in a word where a number or a map came from."""
    if given is not None:
        return float(given) if np.ndim(given) == 0 else "map given"  # type: ignore[arg-type]
    if own is None:
        return otherwise
    return f"map of the {whose}" if np.ndim(own) else float(np.asarray(own))


@contextmanager
def naming(source: Source) -> Iterator[None]:
    """Name the source in complaints about what it holds."""
    try:
        yield
    except InputError as error:
        message = str(error)
        raise (error if source.name in message else InputError(f"{source.name}: {message}")) from error
    except NotConverged as error:
        raise NotConverged(f"{source.name}: {error}") from error
