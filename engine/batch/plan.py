"""What a batch does with every recording."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mirrorskin.engine.press.press import reconstruct_press
from mirrorskin.engine.provenance import program_version
from mirrorskin.engine.rotation.rotation import reconstruct_rotation
from mirrorskin.engine.tiling import MEMORY_LIMIT
from mirrorskin.io import Motion, Result

# These change how a result is made, not what it says.
_NO_MATTER = {"source", "memory_limit", "device", "progress", "threads"}
# What only one motion reads of what is said of a stack.
_OF_MOTION = {"travel": "vertical", "phase": "axial", "tilt": "axial"}


@dataclass(frozen=True, slots=True)
class Plan:
    """What is done with every recording of a batch. It can be pickled.

    Attributes
    ----------
    opening : mapping
        Keywords of `mirrorskin.io.open_recording`, for all recordings.
    press, rotation : mapping
        Keywords of `mirrorskin.engine.reconstruct` for those of vertical and of axial motion.
    memory_limit : int
        Bytes of host memory for frames on the move, of each device.
    """

    opening: Mapping[str, Any] = field(default_factory=dict)
    press: Mapping[str, Any] = field(default_factory=dict)
    rotation: Mapping[str, Any] = field(default_factory=dict)
    memory_limit: int = MEMORY_LIMIT

    def options(self, motion: Motion) -> Mapping[str, Any]:
        """Return the keywords of `mirrorskin.engine.reconstruct` for a motion."""
        chosen = {"vertical": self.press, "axial": self.rotation}.get(motion, {})
        return {**chosen, "memory_limit": self.memory_limit}

    def key(self, motion: Motion) -> str:
        """Write down, always in the same words, everything of the plan that changes a motion's results.

        Defaults are told as well: a parameter that is given with its default's value changes nothing.

        Parameters
        ----------
        motion : {"vertical", "axial", "horizontal", "twist"}

        Returns
        -------
        str
            JSON.
        """
        said = {
            name: value
            for name, value in self.opening.items()
            if value is not None and name not in _NO_MATTER and _OF_MOTION.get(name, motion) == motion
        }
        used: dict[str, Any] = {"version": program_version(), "opening": said}
        if motion == "vertical":
            used["press"] = {**_defaults(reconstruct_press), **self.press}
        if motion == "axial":
            used["rotation"] = {**_defaults(reconstruct_rotation), **self.rotation}
        return json.dumps(_plain(used), sort_keys=True)

    def digest(self, motion: Motion) -> str:
        """Return the SHA-256 of ``key``, in hexadecimal."""
        return hashlib.sha256(self.key(motion).encode()).hexdigest()


@functools.cache
def _defaults(function: Callable[..., Result]) -> Mapping[str, Any]:
    parameters = inspect.signature(function).parameters.items()
    return {name: parameter.default for name, parameter in parameters if name not in _NO_MATTER}


def _plain(value: Any) -> Any:
    """Turn a value into what JSON can tell."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {one.name: _plain(getattr(value, one.name)) for one in dataclasses.fields(value)}
        return {type(value).__name__: fields}
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    return str(value) if isinstance(value, Path) else value
