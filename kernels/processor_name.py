"""A correction of PoCL 3.0: the name of the processor for which it compiles, patched in memory.

The wheel of PoCL 3.0 contains LLVM 14. It calls a newer processor "generic", a name that its own compiler
refuses, and no option overrides it. Here the function that returns the name is patched to return the best
older processor without instructions that this one lacks. Only the function of that wheel, identified by its
code, is called and patched, because in another library the same name may mean anything. Any other PoCL is
unchanged.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import mmap
import os
from collections.abc import Set
from pathlib import Path
from typing import Any

_log = logging.getLogger("mirrorskin.kernels")

PATCHABLE = "3.0"
"""Version of the wheel whose function was examined."""

NAME_FUNCTION = "pocl_get_llvm_cpu_name"
"""The function that is patched."""

VARIABLE = "MIRRORSKIN_PROCESSOR"
"""Environment variable with another name, for tests of code for an older processor."""

_NAME_FUNCTION_SIZE = 83  # bytes, in that wheel
_NAME_FUNCTION_SHA256 = "fd587da3800019b6c70376351f2227b8fea5f15daff803329977ee54951655b6"  # of its code

# PoCL's builds of its own library, by processor. Each needs the instructions of the preceding ones and those
# listed with it: the instructions that a compiler uses by default, as named in /proc/cpuinfo.
_LEVELS = (
    ("core2", {"pni", "ssse3", "cx16", "lahf_lm"}),
    ("penryn", {"sse4_1"}),
    ("sandybridge", {"sse4_2", "popcnt", "xsave", "avx"}),
    ("ivybridge", {"f16c"}),
    ("haswell", {"avx2", "bmi1", "bmi2", "fma", "abm", "movbe"}),
    ("skylake-avx512", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
)


def ensure_name(library: Path) -> tuple[str, bool]:
    """Make PoCL compile for a processor that its LLVM knows; return its name, and whether it was patched.

    Raises OSError if the library is not the expected one, or the system forbids changing code.
    """
    try:
        ask = getattr(ctypes.CDLL(str(library)), NAME_FUNCTION)
    except AttributeError:
        raise OSError(f"{library} has no function {NAME_FUNCTION}") from None
    start = _address(ask)
    if look_up(start)[1] != _NAME_FUNCTION_SIZE or _digest(start) != _NAME_FUNCTION_SHA256:
        raise OSError(f"{NAME_FUNCTION} in {library} is not that of PoCL {PATCHABLE}")
    ask.restype = ctypes.c_void_p
    recognised, target = _take_string(ask()), os.environ.get(VARIABLE)
    if recognised != "generic" and not target:
        return recognised, False
    name = target or choose_name(_read_flags())
    _answer_with(start, name)
    _log.info("PoCL calls this processor %s; it compiles for %s", recognised, name)
    return name, True


def _digest(start: int) -> str:
    """Return the SHA-256 of the code of the function that names the processor."""
    return hashlib.sha256(ctypes.string_at(start, _NAME_FUNCTION_SIZE)).hexdigest()


def choose_name(flags: Set[str]) -> str:
    """Return the best of PoCL's processors without an instruction that is not among these flags."""
    name = "x86-64"
    for better, needs in _LEVELS:
        if not needs <= flags:
            break
        name = better
    return name


def _read_flags() -> frozenset[str]:
    """Return the features of this machine's processor; none where ``/proc`` cannot be read."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return frozenset()
    flags = (line.partition(":")[2].split() for line in lines if line.startswith("flags"))
    return frozenset(next(flags, ()))


class _Symbol(ctypes.Structure):
    """An entry of an ELF symbol table (Elf64_Sym)."""

    _fields_ = (
        ("name", ctypes.c_uint32), ("info", ctypes.c_uint8), ("other", ctypes.c_uint8),
        ("section", ctypes.c_uint16), ("value", ctypes.c_uint64), ("size", ctypes.c_uint64),
    )  # fmt: skip


class _SymbolInfo(ctypes.Structure):
    """Information of the dynamic linker about an address (Dl_info)."""

    _fields_ = (
        ("file", ctypes.c_char_p), ("base", ctypes.c_void_p), ("name", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )  # fmt: skip


def look_up(address: int | None) -> tuple[Path | None, int]:
    """Return the library that contains an address, and the size of its function there, 0 if unknown."""
    description, symbol = _SymbolInfo(), ctypes.POINTER(_Symbol)()
    search = getattr(ctypes.CDLL(None), "dladdr1", None)
    if search is None or not search(
        ctypes.c_void_p(address), ctypes.byref(description), ctypes.byref(symbol), 1
    ):
        return None, 0
    return Path(os.fsdecode(description.file)), int(symbol.contents.size) if symbol else 0


def _take_string(address: int) -> str:
    text = ctypes.string_at(address).decode()
    free = ctypes.CDLL(None).free
    free.argtypes = [ctypes.c_void_p]
    free(address)
    return text


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


@functools.cache
def _c_string(text: str) -> ctypes.Array[ctypes.c_char]:
    """Return a string that stays in memory, because the machine code below points to it."""
    return ctypes.create_string_buffer(text.encode())


def _answer_with(start: int, name: str) -> None:
    """Overwrite a ``char *function(void)`` with ``return strdup(name)``; its callers free the copy."""
    text, strdup = ctypes.addressof(_c_string(name)), _address(ctypes.CDLL(None).strdup)
    code = (
        b"\x48\xbf" + text.to_bytes(8, "little")  # mov rdi, text
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
