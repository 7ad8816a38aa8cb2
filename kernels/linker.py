"""A linker for PoCL on machines that have none, without root.

PoCL links each kernel with the system's ``ld`` and the development files of libgcc and libc. The PyPI
package ``ziglang`` holds LLVM's linker; a small ``ld`` in front of it leaves those files out, which
kernels do not need.
"""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import logging
import os
import shlex
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import platformdirs

_log = logging.getLogger("mirrorskin.kernels")

_SHIM = """\
#!/bin/sh
# mirrorskin's linker for OpenCL kernels: LLVM's, without the libraries that only compilers bring.
for arg do
    shift
    case $arg in
        -lgcc | -lgcc_s | -lgcc_eh | -lc | -lm | */crt*.o | crt*.o) ;;
        *) set -- "$@" "$arg" ;;
    esac
done
exec {command} "$@"
"""


def find_zig() -> Path | None:
    """Return the program of the package ``ziglang``, or None where it is not installed."""
    spec = importlib.util.find_spec("ziglang")
    if spec is None or spec.origin is None:
        return None
    program = Path(spec.origin).with_name("zig")
    return program if program.is_file() else None


def write_shim(cache: Path, command: Sequence[str]) -> Path:
    """Write the ``ld`` that calls a linker, once for each command.

    Parameters
    ----------
    cache : Path
        Where its folder goes.
    command : sequence of str
        The linker and its first arguments.

    Returns
    -------
    Path
        The folder that holds ``ld``.

    Raises
    ------
    OSError
        The folder cannot be written.
    """
    script = _SHIM.format(command=shlex.join(command))
    folder = cache / f"linker-{hashlib.sha256(script.encode()).hexdigest()[:16]}"
    if not (folder / "ld").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(script)
        Path(name).chmod(0o755)
        Path(name).replace(folder / "ld")  # another process may be writing it too
    return folder


def provide() -> bool:
    """Put a linker first on this process's ``PATH``; return whether there is one to put."""
    zig = find_zig()
    if zig is None:
        return False
    command = [str(zig), "ld.lld"]
    try:
        folder = write_shim(platformdirs.user_cache_path("mirrorskin"), command)
    except OSError:
        private = tempfile.mkdtemp(prefix="mirrorskin-")
        atexit.register(shutil.rmtree, private, ignore_errors=True)
        folder = write_shim(Path(private), command)
    os.environ["PATH"] = os.pathsep.join([str(folder), os.environ.get("PATH", os.defpath)])
    _log.info("linking OpenCL kernels with %s", zig)
    return True
