"""The embedded OpenCL device: PoCL from its wheel, which needs no GPU, no driver and no root access.

Conditions under which PoCL would end the process are corrected or reported here.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import hashlib
import importlib.util
import logging
import mmap
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import platformdirs
import pyopencl as cl

from mirrorskin.kernels.disk_cache import keep, recall
from mirrorskin.kernels.errors import DeviceError
from mirrorskin.kernels.processor_name import NAME_FUNCTION, PATCHABLE, VARIABLE, ensure_name, look_up
from mirrorskin.processors import POCL_THREADS, usable_cores

_log = logging.getLogger("mirrorskin.kernels")

_SCHEME = 2  # version of the results on disk
_TIMEOUT = 120  # seconds, for a cold disk
# Processors of LLVM 14 with AVX-512; it takes a newer one of AMD, which has it, for znver3, which has not.
_AVX512 = "avx512", "lake-", "tigerlake", "rocketlake", "cannonlake", "cascadelake", "cooperlake", "rapids"
_RAN = "PoCL ran a kernel"
_SOURCE = "kernel void probe(global float *x) { const int i = get_global_id(0); x[i] = 2 * x[i] + i; }"

_lock = threading.Lock()
_processor: str | None = None  # name of the processor for which it compiles, once prepared
_patched = False


def prepare() -> None:
    """Prepare PoCL's environment; call it before OpenCL's platforms are listed.

    It sets the cache folders of PoCL, and the name of this processor for its compiler.

    Raises
    ------
    DeviceError
        The address space is too small: PoCL would end the process.
    """
    global _processor, _patched
    with _lock:
        library = find_library() if _processor is None else None
        if library is None:
            return
        _check_address_space()
        _check_threads()
        _provide_caches()
        try:
            _processor, _patched = ensure_name(library)
        except OSError as error:
            _processor = "unknown"
            _log.info("PoCL is not patched, and may not recognise this processor: %s", error)


def compiler() -> object:
    """Return the processor and settings on which PoCL's programs depend, once prepared."""
    settings = [item for item in os.environ.items() if item[0].startswith("POCL_")]
    return _processor, sorted(item for item in settings if item[0] not in ("POCL_CACHE_DIR", POCL_THREADS))


def vector_width(device: cl.Device) -> int:
    """Return the floats in a register of the processor for which a device compiles."""
    width: int = device.native_vector_width_float  # of this processor, whatever PoCL compiles for
    if _processor in (None, "unknown") or any(name in str(_processor) for name in _AVX512):
        return width
    return min(width, 8)


def note(driver: str, threads: int = 1) -> str:
    """Return a note for users of the embedded device, from the driver's version and threads; mostly empty."""
    notes = []
    if threads > (cores := usable_cores()):
        allowed = f"{cores} processor{'s' if cores > 1 else ''}"
        notes.append(
            f"has {threads} threads, and this process may use {allowed}: set {POCL_THREADS}={cores} before"
            " the first use of OpenCL"
        )
    if _patched and driver.startswith(PATCHABLE):
        notes.append(f"compiles for {_processor}: its function {NAME_FUNCTION} is patched in memory")
    return "; ".join(notes)


@functools.cache
def verify(device: cl.Device) -> None:
    """Check that PoCL can run a kernel; call it before the first kernel, which could end the process.

    A child process runs a kernel with the system's linker, and then with the linker of the package
    ``ziglang``. Success is cached in the user's cache folder, for this PoCL, processor, linker and Python.

    Raises
    ------
    DeviceError
        It cannot run kernels here; the message names the packages to install.
    """
    circumstances = _circumstances(device)
    cached = recall("pocl", circumstances)
    if cached == b"system" or (cached == b"ziglang" and provide_linker()):
        return
    answer, problem = b"system", _probe(device.platform)
    if problem is not None and provide_linker():
        answer, problem = b"ziglang", _probe(device.platform)
    if problem is not None:
        raise DeviceError(problem)
    keep("pocl", circumstances, answer)


def why_no_device() -> str | None:
    """Return in one line why OpenCL shows no device, or not the requested one; None if unknown."""
    choice = os.environ.get("POCL_DEVICES")
    if choice is not None and not _shows_pocl():
        return f"POCL_DEVICES is {choice!r}, which makes PoCL show no device; unset it"
    vendors = os.environ.get("OCL_ICD_VENDORS")
    place = Path(vendors or "/etc/OpenCL/vendors")
    if vendors and not place.exists():
        return f"OCL_ICD_VENDORS names {vendors}, which does not exist; unset it"
    files = sorted(place.glob("*.icd")) if place.is_dir() else [place] if vendors else []
    libraries = [_named_in(file) if file.suffix == ".icd" else str(file) for file in files]
    packaged = find_library()
    for library in libraries if packaged is None else [*libraries, str(packaged)]:
        try:
            ctypes.CDLL(library)
        except OSError as error:
            named = "; OCL_ICD_VENDORS names it" if vendors and library in libraries else ""
            return f"OpenCL's library {library} cannot be loaded: {error}{named}"
    return None if packaged is None else _why_no_cache()


def why_no_kernel(is_pocl: bool) -> str | None:
    """Return the environment variable that may prevent a kernel from compiling, in one line."""
    problem = _why_no_cache() if is_pocl else None
    names = ("PYOPENCL_BUILD_OPTIONS", *(("POCL_EXTRA_BUILD_FLAGS", VARIABLE) if is_pocl else ()))
    set_variables = [f"{name} is {os.environ[name]!r}" for name in names if os.environ.get(name)]
    return problem or ("; ".join(set_variables) or None)


def _shows_pocl() -> bool:
    """Return whether OpenCL shows a device of PoCL."""
    try:
        platforms = [
            platform for platform in cl.get_platforms() if "Portable Computing Language" in platform.name
        ]
        return any(platform.get_devices() for platform in platforms)
    except (cl.LogicError, cl.RuntimeError):
        return False


def _check_threads() -> None:
    """Raise DeviceError for a number of threads with which PoCL would end the process."""
    threads = os.environ.get(POCL_THREADS, "1")
    if not threads.isdecimal() or int(threads) < 1:
        raise DeviceError(f"{POCL_THREADS} is {threads!r}: a whole number above 0 is needed; unset it")


def _named_in(list_: Path) -> str:
    """Return the library named in a file of OpenCL's loader."""
    try:
        return list_.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return str(list_)


def find_library() -> Path | None:
    """Return PoCL's shared library if its wheel is installed, without importing pyopencl."""
    spec = importlib.util.find_spec("pyopencl")
    if spec is None or spec.origin is None:
        return None
    return next(Path(spec.origin).parent.glob(".libs/libpocl-*.so"), None)


# --- The linker ----------------------------------------------------------------------------------------
#
# PoCL links each kernel with the system's `ld` and the development files of libgcc and libc. The package
# `ziglang` contains LLVM's linker. A wrapper named `ld` omits those files, which kernels do not need.

_LD = """\
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
    """Return the program of the package ``ziglang``, or None if it is not installed."""
    spec = importlib.util.find_spec("ziglang")
    if spec is None or spec.origin is None:
        return None
    program = Path(spec.origin).with_name("zig")
    return program if program.is_file() else None


def write_linker(cache: Path, command: Sequence[str]) -> Path:
    """Write an ``ld`` that calls a linker, once for each command; return its folder."""
    script = _LD.format(command=shlex.join(command))
    folder = cache / f"linker-{hashlib.sha256(script.encode()).hexdigest()[:16]}"
    if not (folder / "ld").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(script)
        Path(name).chmod(0o755)
        Path(name).replace(folder / "ld")  # another process may be writing it as well
    return folder


def provide_linker() -> bool:
    """Put a linker first on this process's ``PATH``; return whether there is one."""
    zig = find_zig()
    if zig is None:
        return False
    command = [str(zig), "ld.lld"]
    try:
        folder = write_linker(platformdirs.user_cache_path("mirrorskin"), command)
    except OSError:
        private = tempfile.mkdtemp(prefix="mirrorskin-")
        atexit.register(shutil.rmtree, private, ignore_errors=True)
        folder = write_linker(Path(private), command)
    os.environ["PATH"] = os.pathsep.join([str(folder), os.environ.get("PATH", os.defpath)])
    _log.info("linking OpenCL kernels with %s", zig)
    return True


def _circumstances(device: cl.Device) -> object:
    """Return the circumstances of a result: this PoCL, processor, linker and Python."""
    # Every OpenCL object starts with a pointer to the functions of its library.
    functions = ctypes.cast(device.int_ptr, ctypes.POINTER(ctypes.POINTER(ctypes.c_void_p)))[0]
    files = [look_up(functions[1])[0], shutil.which("ld")]
    states = [(file, Path(file).stat()) for file in files if file is not None]
    stamps = [(str(file), state.st_size, state.st_mtime_ns) for file, state in states]
    names = device.platform.version, device.driver_version, device.name
    return _SCHEME, names, compiler(), sys.executable, stamps


def _probe(platform: cl.Platform) -> str | None:
    """Run one kernel in a child process; return None, or in one line the error and the remedy."""
    problem = _why_no_cache()
    if problem is not None:
        return problem
    number = str(cl.get_platforms().index(platform))
    command = [sys.executable, "-P", "-m", "mirrorskin.kernels.embedded", number]
    # A separate cache: a kernel that was linked before would hide that none can be linked now.
    with tempfile.TemporaryDirectory(dir=kernel_cache()) as cache:
        environment = {**os.environ, "POCL_CACHE_DIR": cache}
        try:
            child = subprocess.run(
                command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=_TIMEOUT
            )
        except subprocess.TimeoutExpired:
            return f"PoCL did not finish a small kernel within {_TIMEOUT} s; choose another device"
        except OSError as error:
            return f"PoCL cannot be tested, since {sys.executable} does not start ({error.strerror})"
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
    if cause := why_no_kernel(is_pocl=True):
        return f"PoCL cannot run kernels here: {cause}; unset it"
    return f"PoCL cannot run kernels here ({complaint}); choose another device"


# --- The caches ----------------------------------------------------------------------------------------


def kernel_cache() -> Path:
    """Return the folder in which PoCL 3.0 caches compiled kernels."""
    folder = os.environ.get("POCL_CACHE_DIR")
    if folder is not None:
        return Path(folder)
    home = os.environ.get("HOME")
    caches = os.environ.get("XDG_CACHE_HOME") or ("/tmp" if home is None else f"{home}/.cache")
    return Path(caches, "pocl", "kcache")


def _why_no_cache() -> str | None:
    """Return why PoCL or pyopencl cannot write its cache folder, and the remedy; None if both can."""
    variable = "POCL_CACHE_DIR" if "POCL_CACHE_DIR" in os.environ else "XDG_CACHE_HOME"
    needed = [("PoCL", kernel_cache(), variable)]
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


def _provide_caches() -> None:
    """Let PoCL and pyopencl write to a temporary folder if they cannot write to their own."""
    problem = _why_no_cache()
    if problem is None:
        return
    try:
        folder = tempfile.mkdtemp(prefix="mirrorskin-cache-")
    except OSError:
        return  # no device is found then, and its message names the problem
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ.update(XDG_CACHE_HOME=folder, POCL_CACHE_DIR=str(Path(folder, "pocl")))
    _log.warning("%s; until then kernels are compiled again by every command", problem)


# --- The address space -----------------------------------------------------------------------------------
#
# PoCL aborts, or its LLVM crashes, if threads or memory exceed the limit of the address space ('ulimit -v').
# A command with PoCL 3.0 uses 0.84 GB of address space on two cores.

_PLACE, _PLACE_PER_CORE = 800 << 20, 80 << 20  # bytes; a thread has a stack (8 MB) and a heap (64 MB)


def _check_address_space() -> None:
    """Raise DeviceError if a limit to the address space is too low for PoCL."""
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * mmap.PAGESIZE
    needed = used + _PLACE + _PLACE_PER_CORE * (os.cpu_count() or 1)
    if limit < needed:
        raise DeviceError(
            f"the address space is limited to {limit >> 20} MB, and PoCL needs {needed >> 20} MB:"
            " raise or remove the limit (ulimit -v)"
        )


def _run_probe(number: int) -> None:
    """Run one kernel on each device of a platform, in the child process."""
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    prepare()
    for device in cl.get_platforms()[number].get_devices():
        context = cl.Context([device])
        queue = cl.CommandQueue(context)
        kernel = cl.Program(context, _SOURCE).build().probe
        x = np.ones(64, np.float32)
        buffer = cl.Buffer(context, cl.mem_flags.COPY_HOST_PTR, hostbuf=x)
        kernel.set_args(buffer)
        cl.enqueue_nd_range_kernel(queue, kernel, x.shape, None)
        cl.enqueue_copy(queue, x, buffer)
        if not np.array_equal(x, 2 + np.arange(64)):
            raise SystemExit("error: wrong results")
    print(_RAN)


if __name__ == "__main__":
    _run_probe(int(sys.argv[1]))
