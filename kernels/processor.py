"""The name under which PoCL compiles for this processor.

The wheel of PoCL 3.0 holds LLVM 14. A processor newer than that is "generic" to it, a name that its own
compiler then refuses, and no option overrides it (docs/decisions/0003).
"""

from __future__ import annotations

import ctypes
import logging
import mmap
from collections.abc import Set
from pathlib import Path
from typing import Any

_log = logging.getLogger("mirrorskin.kernels")

# PoCL's builds of its own library, by the processor they are for. Each needs what the ones before it need
# and what stands beside it: the instructions that a compiler uses unasked, in the words of /proc/cpuinfo.
_LEVELS = (
    ("core2", {"pni", "ssse3", "cx16", "lahf_lm"}),
    ("penryn", {"sse4_1"}),
    ("sandybridge", {"sse4_2", "popcnt", "xsave", "avx"}),
    ("ivybridge", {"f16c"}),
    ("haswell", {"avx2", "bmi1", "bmi2", "fma", "abm", "movbe"}),
    ("skylake-avx512", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
)
_given_names: list[ctypes.Array[ctypes.c_char]] = []  # the machine code below points at them


def choose_name(flags: Set[str]) -> str:
    """Return the best processor of PoCL's that has no instruction which this one lacks.

    Parameters
    ----------
    flags : set of str
        The processor's features as ``/proc/cpuinfo`` spells them.
    """
    name = "x86-64"
    for better, needs in _LEVELS:
        if not needs <= flags:
            break
        name = better
    return name


def read_flags() -> frozenset[str]:
    """Return the features of this machine's processor; none where ``/proc`` cannot be read."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return frozenset()
    found = (line.partition(":")[2].split() for line in lines if line.startswith("flags"))
    return frozenset(next(found, ()))


def ensure_name(library: Path) -> str:
    """Make PoCL compile for a processor that its LLVM knows, and return that processor's name.

    Parameters
    ----------
    library : Path
        PoCL's shared library. It must not have been asked for its devices yet.

    Raises
    ------
    OSError
        The library cannot be loaded, or the system forbids changing code in memory.
    """
    ask = ctypes.CDLL(str(library)).pocl_get_llvm_cpu_name
    ask.restype = ctypes.c_void_p
    known = _take_string(ask())
    if known != "generic":
        return known
    name = choose_name(read_flags())
    _answer_with(_address(ask), name)
    _log.info("PoCL does not know this processor; it compiles for %s", name)
    return name


def _take_string(address: int) -> str:
    text = ctypes.string_at(address).decode()
    free = ctypes.CDLL(None).free
    free.argtypes = [ctypes.c_void_p]
    free(address)
    return text


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def _answer_with(start: int, name: str) -> None:
    """Overwrite a ``char *function(void)`` with ``return strdup(name)``; its callers free the copy."""
    text = ctypes.create_string_buffer(name.encode())
    _given_names.append(text)
    strdup = _address(ctypes.CDLL(None).strdup)
    code = (
        b"\x48\xbf" + ctypes.addressof(text).to_bytes(8, "little")  # mov rdi, text
        + b"\x48\xb8" + strdup.to_bytes(8, "little")  # mov rax, strdup
        + b"\xff\xe0"  # jmp rax
    )  # fmt: skip
    _protect(start, len(code), mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    ctypes.memmove(start, code, len(code))
    _protect(start, len(code), mmap.PROT_READ | mmap.PROT_EXEC)


def _protect(start: int, length: int, mode: int) -> None:
    page = start - start % mmap.PAGESIZE
    mprotect = ctypes.CDLL(None, use_errno=True).mprotect
    mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    if mprotect(page, start + length - page, mode) != 0:
        raise OSError(ctypes.get_errno(), "mprotect refused to open PoCL's code for writing")
