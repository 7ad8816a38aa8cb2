"""PoCL, the OpenCL device that comes as a wheel and needs no GPU, driver or root.

What stands in its way is put right or told here, before PoCL can end the process (docs/decisions/0003).
"""

from __future__ import annotations

import ctypes
import importlib.util
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import platformdirs

from mirrorskin.kernels import linker, processor
from mirrorskin.kernels.disk_cache import keep, recall
from mirrorskin.kernels.errors import DeviceError

_log = logging.getLogger("mirrorskin.kernels")

_SCHEME = 1  # counts the ways in which answers were kept
_TIMEOUT = 120  # seconds, for a cold disk
_RAN = "PoCL ran a kernel"
_SOURCE = "kernel void probe(global float *x) { const int i = get_global_id(0); x[i] = 2 * x[i] + i; }"

_lock = threading.RLock()
_processor: str | None = None  # the name it compiles for, once prepared
_verified = False


def prepare() -> None:
    """Let PoCL's compiler know this processor; call it before the first look at OpenCL's platforms."""
    global _processor
    with _lock:
        library = find_library() if _processor is None else None
        if library is None:
            return
        try:
            _processor = processor.ensure_name(library)
        except OSError as error:
            _processor = "generic"
            _log.warning("PoCL was left as it is: %s", error)


def verify() -> None:
    """Make sure that PoCL can run a kernel; call it before the first one, which else may end the process.

    A child process tries, with the system's linker and then with the package ``ziglang``'s. A good answer
    is kept in the user's cache folder.

    Raises
    ------
    DeviceError
        No kernel can run here; the message says what to install.
    """
    global _verified
    with _lock:
        library = find_library()
        if library is not None and not _verified:
            prepare()
            _find_working_linker(library)
        _verified = True


def why_no_device() -> str | None:
    """Return in one line why OpenCL shows no device, or None where that cannot be told."""
    vendors = os.environ.get("OCL_ICD_VENDORS")
    if vendors and not Path(vendors).exists():
        return f"OCL_ICD_VENDORS names {vendors}, which does not exist; unset it"
    library = find_library()
    if library is None:
        return None
    try:
        ctypes.CDLL(str(library))
    except OSError as error:
        return f"PoCL cannot be loaded: {error}"
    return _why_no_cache()


def find_library() -> Path | None:
    """Return PoCL's shared library where its wheel is installed, without importing pyopencl."""
    spec = importlib.util.find_spec("pyopencl")
    if spec is None or spec.origin is None:
        return None
    return next(Path(spec.origin).parent.glob(".libs/libpocl-*.so"), None)


def _find_working_linker(library: Path) -> None:
    circumstances = _circumstances(library)
    known = recall("pocl", circumstances)
    if known == "system" or (known == "ziglang" and linker.provide()):
        return
    answer, problem = "system", _probe()
    if problem is not None and linker.provide():
        answer, problem = "ziglang", _probe()
    if problem is not None:
        raise DeviceError(problem)
    keep("pocl", circumstances, answer)


def _circumstances(library: Path) -> object:
    """Return what the answer depends on: this PoCL, this processor, this linker and this Python."""
    ld = shutil.which("ld")
    files = [library, Path(ld).resolve()] if ld else [library]
    stamps = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    return _SCHEME, _processor, sys.executable, stamps


def _probe() -> str | None:
    """Run one kernel in a child process; return None, or in one line what went wrong and what to do."""
    problem = _why_no_cache()
    if problem is not None:
        return problem
    command = [sys.executable, "-P", "-m", "mirrorskin.kernels.pocl"]
    # A cache of its own: a kernel that was linked before would hide that none can be linked now.
    with tempfile.TemporaryDirectory(dir=_kernel_cache()) as cache:
        environment = {**os.environ, "POCL_CACHE_DIR": cache}
        try:
            child = subprocess.run(
                command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=_TIMEOUT
            )
        except subprocess.TimeoutExpired:
            return f"PoCL did not finish a small kernel within {_TIMEOUT} s; choose another device"
    if child.returncode == 0 and child.stdout.decode().startswith(_RAN):
        return None
    return _explain(child.returncode, child.stderr.decode(errors="replace"))


def _explain(status: int, complaints: str) -> str:
    lines = [line.strip() for line in complaints.splitlines() if line.strip()]
    if "Final linking" in complaints:
        return (
            f"PoCL cannot link kernels ({lines[0]}): install a linker and its libraries "
            "(Debian: apt install gcc libc6-dev), or pip install 'mirrorskin[linker]'"
        )
    lines.insert(0, f"its process ended with status {status}")
    complaint = next((line for line in lines if line.startswith("error:")), lines[-1])
    return f"PoCL cannot run kernels here ({complaint}); choose another device"


def _kernel_cache() -> Path:
    """Return the folder in which PoCL 3.0 keeps compiled kernels."""
    given = os.environ.get("POCL_CACHE_DIR")
    if given is not None:
        return Path(given)
    home = os.environ.get("HOME")
    caches = os.environ.get("XDG_CACHE_HOME") or ("/tmp" if home is None else f"{home}/.cache")
    return Path(caches, "pocl", "kcache")


def _why_no_cache() -> str | None:
    """Try the folders that PoCL and pyopencl must be able to write; return None where both can be."""
    variable = "POCL_CACHE_DIR" if "POCL_CACHE_DIR" in os.environ else "XDG_CACHE_HOME"
    needed = [("PoCL", _kernel_cache(), variable)]
    if "PYOPENCL_NO_CACHE" not in os.environ:
        needed.append(("pyopencl", platformdirs.user_cache_path(), "XDG_CACHE_HOME"))
    for owner, folder, remedy in needed:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            problem = f"{owner} cannot write its cache folder {folder} ({error.strerror})"
            return f"{problem}; set {remedy} to a writable folder"
    return None


def main() -> None:
    """Run one kernel on every PoCL there is: the child process of ``verify``."""
    import resource

    import numpy as np
    import pyopencl as cl

    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    prepare()
    platforms = [platform for platform in cl.get_platforms() if "Portable Computing" in platform.name]
    devices = [device for platform in platforms for device in platform.get_devices()]
    if not devices:
        raise SystemExit("error: it shows no device")
    for device in devices:
        context = cl.Context([device])
        queue = cl.CommandQueue(context)
        kernel = cl.Program(context, _SOURCE).build().probe
        x = np.ones(64, np.float32)
        buffer = cl.Buffer(context, cl.mem_flags.COPY_HOST_PTR, hostbuf=x)
        kernel.set_args(buffer)
        cl.enqueue_nd_range_kernel(queue, kernel, x.shape, None)
        cl.enqueue_copy(queue, x, buffer)
        if not np.array_equal(x, 2 + np.arange(64)):
            raise SystemExit("error: its numbers are wrong")
    print(_RAN)


if __name__ == "__main__":
    main()
