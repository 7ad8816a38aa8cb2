import ctypes
import mmap
from pathlib import Path
from types import SimpleNamespace

import pytest

from mirrorskin.kernels import processor

CORE2 = {"sse2", "pni", "ssse3", "cx16", "lahf_lm"}
SANDYBRIDGE = CORE2 | {"sse4_1", "sse4_2", "popcnt", "xsave", "avx"}
HASWELL = SANDYBRIDGE | {"f16c", "avx2", "bmi1", "bmi2", "fma", "abm", "movbe"}
SKYLAKE = HASWELL | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (set(), "x86-64"),
        ({"sse2", "avx2", "avx512f"}, "x86-64"),
        (CORE2, "core2"),
        (CORE2 | {"sse4_1"}, "penryn"),
        (SANDYBRIDGE, "sandybridge"),
        (SANDYBRIDGE | {"f16c"}, "ivybridge"),
        (HASWELL, "haswell"),
        (HASWELL - {"movbe"}, "ivybridge"),
        (SKYLAKE, "skylake-avx512"),
        (SKYLAKE | {"avx512_vnni", "amx_tile"}, "skylake-avx512"),
        (SKYLAKE - {"avx512vl"}, "haswell"),
        (SKYLAKE - {"abm"}, "ivybridge"),
    ],
)
def test_the_best_name_without_an_instruction_that_is_lacking(flags: set[str], name: str) -> None:
    assert processor.choose_name(flags) == name


def test_flags_are_words_of_one_processor() -> None:
    flags = processor.read_flags()
    assert "sse2" in flags
    assert ":" not in flags


def test_no_flags_without_proc(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", refuse)
    assert processor.read_flags() == frozenset()


@pytest.mark.parametrize("offset", [0, mmap.PAGESIZE - 5], ids=["in a page", "across two pages"])
def test_a_function_is_made_to_answer_with_a_copy_of_the_name(offset: int) -> None:
    code = mmap.mmap(-1, 2 * mmap.PAGESIZE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(code)) + offset
    processor._answer_with(start, "haswell")
    function = ctypes.CFUNCTYPE(ctypes.c_void_p)(start)
    first, second = function(), function()
    assert first != second
    assert [processor._take_string(first), processor._take_string(second)] == ["haswell"] * 2


@pytest.mark.parametrize(("known", "name"), [("znver3", "znver3"), ("generic", "skylake-avx512")])
def test_only_an_unknown_processor_is_named(monkeypatch: pytest.MonkeyPatch, known: str, name: str) -> None:
    libc = ctypes.CDLL(None)
    libc.strdup.restype = ctypes.c_void_p
    ask = ctypes.CFUNCTYPE(ctypes.c_void_p)(lambda: libc.strdup(known.encode()))
    library = SimpleNamespace(pocl_get_llvm_cpu_name=ask)
    given: list[str] = []
    monkeypatch.setattr(ctypes, "CDLL", lambda name, **_: libc if name is None else library)
    monkeypatch.setattr(processor, "read_flags", lambda: SKYLAKE)
    monkeypatch.setattr(processor, "_answer_with", lambda _, name: given.append(name))
    assert processor.ensure_name(Path("libpocl.so")) == name
    assert given == ([name] if known == "generic" else [])
