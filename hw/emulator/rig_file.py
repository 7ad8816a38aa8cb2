"""Writes what a rig is as a rig file, so that other processes can open it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.hw.settings import Axis, RigSettings
from mirrorskin.io.types import InputError

_FIRST = "# An emulated rig; it is there as long as the program that wrote this runs.\n"


def write_rig(settings: RigSettings, bright: NDArray[np.float32], folder: Path) -> Path:
    """Write ``rig.toml``, and the bright reference as ``bright.npy`` beside it.

    Parameters
    ----------
    settings : RigSettings
        What to write but the references; see ``docs/rig.md`` for the keys.
    bright : ndarray, (H, W), float32
        Counts in full light.
    folder : Path
        Made where it is missing. Files of an emulated rig that was there before are replaced.

    Returns
    -------
    Path
        The rig file.

    Raises
    ------
    InputError
        The folder cannot be written to, or has a rig file of someone else's.
    """
    path, picture = folder / "rig.toml", folder / "bright.npy"
    try:
        if path.exists() and not path.read_text(errors="replace").startswith(_FIRST):
            raise InputError(f"{path} is a rig file that someone else wrote: name another folder with -o")
        folder.mkdir(parents=True, exist_ok=True)
        np.save(picture, bright)
        camera = replace(settings.camera, bright=Path(picture.name))
        path.write_text(_FIRST + _text(replace(settings, camera=camera)))
    except OSError as error:
        raise InputError(f"{folder} cannot be written to: {error.strerror}; name another with -o") from None
    return path


def _text(settings: RigSettings) -> str:
    stage, camera = settings.stage, settings.camera
    tables: dict[str, dict[str, object]] = {
        "": {"name": settings.name},
        "stage": {
            "port": stage.port,
            "baud": stage.baud,
            "home": stage.home,
            "timeout": stage.timeout,
            "report_rate": stage.report_rate,
            "press": stage.press,
            "pivot": stage.pivot,
        },
        **{f"stage.{name}": _axis(axis) for name, axis in stage.axes.items()},
        "camera": {
            "name": camera.name,
            "source": camera.source,
            "size": camera.shape[::-1],
            "dtype": camera.dtype.name,
            "rate": camera.rate,
            "delay": camera.delay,
            "pixel_size": camera.pixel_size,
            "dark": camera.dark,
            "bright": camera.bright,
            "zenith_gain": None if camera.zenith_gain is None else camera.zenith_gain * math.radians(1.0),
            "zenith_offset": camera.zenith_offset,
        },
    }
    return "\n".join(
        (f"[{table}]\n" if table else "")
        + "".join(f"{key} = {_value(value)}\n" for key, value in said.items() if value is not None)
        for table, said in tables.items()
    )


def _axis(axis: Axis) -> dict[str, object]:
    """Tell an axis in its own unit."""
    scale = axis.scale
    return {
        "letter": axis.letter,
        "direction": axis.direction,
        "zero": axis.zero,
        "unit": axis.unit,
        "limits": (round(axis.low * scale, 9), round(axis.high * scale, 9)),
        "speed": round(axis.speed * scale, 9),
    }


def _value(value: object) -> str:
    """Write a value in TOML: what JSON writes of text, numbers and lists is TOML as well."""
    return json.dumps(str(value) if isinstance(value, Path) else value, ensure_ascii=False)
