"""The user's own defaults, in ``~/.config/mirrorskin/config.toml``."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import platformdirs

if TYPE_CHECKING:
    from mirrorskin.io import Recording

_VARIABLE = "MIRRORSKIN_CONFIG"
_REMEDY = f'write lines such as device = "gpu" in it, or set {_VARIABLE} to another file'


def config_file() -> Path | None:
    """Return the path of the file, which need not exist; None if the variable for it is set to nothing."""
    path = os.environ.get(_VARIABLE, platformdirs.user_config_path("mirrorskin") / "config.toml")
    return Path(path) if path else None


def defaults() -> Mapping[str, str]:
    """Return the user's defaults; keys are device, rig, pixel-size and calibration.

    Raises
    ------
    mirrorskin.io.InputError
        The file has other keys or values, or does not exist although ``MIRRORSKIN_CONFIG`` names it.
    """
    path = config_file()
    if path is None or (_VARIABLE not in os.environ and not path.exists()):
        return {}
    return _read(path)


@functools.cache
def _read(path: Path) -> Mapping[str, str]:
    from msgspec import Meta, defstruct, structs

    from mirrorskin.io.base.settings_file import load_toml

    examples = {"device": "gpu", "rig": "rig.toml", "pixel_size": "0.03mm", "calibration": "cal.h5"}
    keys: list[Any] = []
    for key, example in examples.items():
        meta = Meta(min_length=1, description="a text in quotes", examples=[example])
        keys.append((key, Annotated[str, meta] | None, None))
    values = structs.asdict(load_toml(path, defstruct("Defaults", keys, rename="kebab"), _REMEDY))
    return {key.replace("_", "-"): value for key, value in values.items() if value is not None}


def option_defaults() -> dict[str, str]:
    """Return the defaults of options that have the same meaning in all commands, by their parameters."""
    parameters = {"device": "device", "rig": "rig_file"}
    return {parameters[key]: value for key, value in defaults().items() if key in parameters}


def with_pixel_size(recording: Recording) -> Recording:
    """Return a recording that has the user's pixel size if it has none of its own."""
    text = defaults().get("pixel-size")
    if text is None or recording.header.pixel_size is not None:
        return recording
    from mirrorskin.cli.quantity import lengths

    size = lengths(text, f"{config_file()}: pixel-size")
    recording.header = replace(recording.header, pixel_size=size)
    _note(recording, f"pixel size {text}")
    return recording


def calibration_of(recording: Recording, path_given: Path | None) -> Path | None:
    """Return the given calibration, or the user's own if there is none with the recording either."""
    path = defaults().get("calibration")
    if path_given is not None or path is None or recording.carried is not None:
        return path_given
    _note(recording, f"calibration {path}")
    return Path(path).expanduser()


def _note(recording: Recording, text: str) -> None:
    from mirrorskin.io.base.findings import Finding

    recording.findings += (Finding("defaults", f"{text} of {config_file()}", warning=False),)
