"""What a result says of how it came about."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.errors import NotConverged
from mirrorskin.io import InputError, ProcessValue, Recording, Result, Source, pixel_axes
from mirrorskin.kernels.device import Device


def sign(result: Result, source: Source, device: Device, process: dict[str, ProcessValue]) -> Result:
    """Add where the pixels are, and how the maps came about."""
    x = y = None
    if source.header.pixel_size is not None:
        x, y = pixel_axes(source.shape[1:], source.header.pixel_size)
    origin: dict[str, ProcessValue] = {"source": source.name}
    if isinstance(source, Recording):
        origin |= {"dataset": source.dataset, "source_sha256": source.sha256()}
    made: dict[str, ProcessValue] = {
        "program": "mirrorskin",
        "version": version("mirrorskin"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": device.info.title,
        "driver": device.info.driver,
    }
    return replace(result, x=x, y=y, process=made | origin | process)


def told(given: ArrayLike | None, own: ArrayLike | None, otherwise: str) -> ProcessValue:
    """Say in a word where a number or a map came from."""
    if given is not None:
        return float(given) if np.ndim(given) == 0 else "map given"  # type: ignore[arg-type]
    if own is None:
        return otherwise
    return "map of the recording" if np.ndim(own) else float(np.asarray(own))


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
