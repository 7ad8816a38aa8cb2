"""``mirrorskin doctor``: a description of an installation, for reports of faults."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
from importlib import metadata

from mirrorskin.cli import options
from mirrorskin.cli.defaults import config_file, defaults
from mirrorskin.cli.output import print_fields, print_json

_VARIABLES = re.compile(r"(OCL|POCL|PYOPENCL|XDG_CACHE|MIRRORSKIN)\w*$")
_DEVELOPMENT = ("bench", "browser", "dev", "docs", "ptxas")  # extras that users do not need
_REQUIREMENT = re.compile(r"\s*([\w.-]+)[^;]*(?:;.*\bextra\s*==\s*['\"]([\w-]+)['\"])?")
_PACKAGES = "numpy", "scipy", "h5py", "opencv-contrib-python-headless", "pyopencl"


def command(as_json: options.Json = False) -> None:
    """Show the device, versions, extras and caches of this installation, for reports of faults."""
    from mirrorskin.processors import usable_cores

    facts = {
        "mirrorskin": metadata.version("mirrorskin"),
        "Python": f"{platform.python_version()}, {sys.executable}",
        "system": platform.platform(),
        "processors": f"{usable_cores()}, {platform.machine()}",
        "device": _device(),
        "linker": shutil.which("ld")
        or "none; the embedded device needs one: pip install 'mirrorskin[linker]'",
        "kernel cache": _kernel_cache(),
        "defaults": ", ".join(
            [str(config_file() or "none"), *(f"{key} {value}" for key, value in defaults().items())]
        ),
        **{f"package {name}": _version(name) or "missing" for name in _PACKAGES},
        **{f"extra {name}": state for name, state in _extras().items()},
        **{name: value for name, value in sorted(os.environ.items()) if _VARIABLES.match(name)},
    }
    if as_json:
        print_json(facts)
    else:
        print_fields(facts)


def _device() -> str:
    """Return the default device and its driver, or why no device can be used."""
    from mirrorskin.kernels.device import open_device
    from mirrorskin.kernels.errors import DeviceError

    try:
        info = open_device().info
    except DeviceError as error:
        return f"none: {error}"
    return f"{info.title}, {info.driver}{f', {info.note}' if info.note else ''}"


def _kernel_cache() -> str:
    from mirrorskin.kernels.embedded import kernel_cache

    folder = kernel_cache()
    return f"{folder}{'' if os.access(folder, os.W_OK) else ', which cannot be written to'}"


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _extras() -> dict[str, str]:
    """Return for each extra whether its packages are installed, or which are missing."""
    missing: dict[str, list[str]] = {}
    for line in metadata.requires("mirrorskin") or ():
        match = _REQUIREMENT.match(line)
        if match is None or match[2] is None or match[2] in _DEVELOPMENT or match[1] == "mirrorskin":
            continue
        missing.setdefault(match[2], []).extend([] if _version(match[1]) else [match[1]])
    return {
        name: f"missing: {', '.join(names)}" if names else "installed"
        for name, names in sorted(missing.items())
    }
