"""The stages and cameras that rig files can name. Each is declared once, in its own module.

A module of ``hw/stages`` or ``hw/cameras`` declares its driver as ``NAME = Driver(...)`` with literal
arguments. Packages name theirs by entry points in the groups `STAGES` and `CAMERAS`: a class, or a `Driver`.
A rig file may also name a class itself.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from mirrorskin.io.base import declarations
from mirrorskin.io.base.own_class import installed_names, load_class
from mirrorskin.io.base.types import InputError

CAMERAS, STAGES = "mirrorskin.cameras", "mirrorskin.stages"
"""Groups of entry points by which packages give names to their cameras and stages."""

_CLASS = re.compile(r"(.*\.py|[^\W\d]\w*(\.[^\W\d]\w*)*):[^\W\d]\w*")
_HERE = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """A stage or a camera that rig files can name.

    Attributes
    ----------
    name : str
        The value of ``stage.firmware``, or what ``camera.source`` starts with before a colon; "" for the
        camera of all other sources.
    title : str
        Name in messages, such as "GRBL".
    help : str
        What it drives, for the documentation.
    loads : str or class
        Name of the class, in the module of the declaration. Its argument is the ``StageSettings`` or the
        ``CameraSettings``, and by name those of ``takes``.
    takes : tuple of str
        Which of "clock" and "unlock" the class takes.
    motion : str
        Of a stage: "steps" if sweeps and precessions are refused; "continuous" if the axes of the rig file
        determine which are possible; "" if the open stage decides.
    outputs : bool
        Whether a stage may have outputs, which trigger a camera.
    formats, formats_help : str
        Pattern of the values of ``camera.fourcc`` that fit, and a description of them.
    extra : str
        Extra of mirrorskin that it needs.
    module : str
        Module of the declaration; it is set when the driver is found.
    """

    name: str
    loads: str | type
    title: str = ""
    help: str = ""
    takes: tuple[str, ...] = ()
    motion: str = ""
    outputs: bool = True
    formats: str = ""
    formats_help: str = ""
    extra: str = ""
    module: str = ""

    def load(self) -> Callable[..., Any]:
        """Return the class."""
        if not self.module:
            return load_class(self.loads)
        kind: Callable[..., Any] = getattr(import_module(self.module), str(self.loads))
        return kind

    def __str__(self) -> str:
        if not isinstance(self.loads, str):
            return self.loads.__name__
        return f"{self.module}:{self.loads}" if self.module else self.loads


@functools.cache
def built_in(group: str) -> tuple[Driver, ...]:
    """Return the drivers of a group that mirrorskin contains."""
    folder = _HERE / group.rpartition(".")[2]
    return declarations.declared(Driver, sorted(folder.glob("*.py")), "mirrorskin.hw")


def driver_names(group: str) -> list[str]:
    """Return the names of all drivers of a group."""
    return [*(driver.name for driver in built_in(group) if driver.name), *installed_names(group)]


def named_driver(group: str, name: str) -> Driver | None:
    """Return the driver with a name; packages are only asked if none is built in."""
    for driver in built_in(group):
        if driver.name == name:
            return driver
    for point, value in declarations.installed(group, group.rpartition(".")[2].removesuffix("s"), name=name):
        driver = value if isinstance(value, Driver) else Driver(name=name, loads=point.attr)
        return replace(driver, module=point.module)
    return None


def stage_driver(firmware: str | type) -> Driver:
    """Return the driver of a stage from ``stage.firmware``."""
    name = firmware if isinstance(firmware, str) and firmware.isidentifier() else ""
    return (named_driver(STAGES, name) if name else None) or Driver(name="", loads=firmware)


def camera_driver(source: int | str) -> Driver:
    """Return the driver of a camera from ``camera.source``."""
    name, colon, rest = str(source).partition(":")
    driver = named_driver(CAMERAS, name) if name.isidentifier() and not rest.startswith("//") else None
    if driver is None and colon and is_class(str(source)):
        return Driver(name="", loads=str(source))
    driver = driver or named_driver(CAMERAS, "")
    if driver is None:
        raise InputError(f"camera.source is {source}, and there is no camera for it; reinstall mirrorskin")
    return driver


def is_class(name: str) -> bool:
    """Return whether a name has the form FILE.py:CLASS or MODULE:CLASS."""
    return _CLASS.fullmatch(name) is not None
