"""Preparations before PoCL's first kernel, each in a real child process."""

import ctypes
import hashlib
import mmap
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels import embedded, processor_name
from mirrorskin.kernels.device import open_device
from mirrorskin.kernels.errors import DeviceError, UnknownDeviceError

# What is asked of a device before it is opened.
_ASKED = [
    *("type", "name", "platform", "driver_version", "extensions", "host_unified_memory"),
    *("max_compute_units", "global_mem_size", "max_mem_alloc_size"),
]
CORE2 = {"sse2", "pni", "ssse3", "cx16", "lahf_lm"}
SANDYBRIDGE = CORE2 | {"sse4_1", "sse4_2", "popcnt", "xsave", "avx"}
HASWELL = SANDYBRIDGE | {"f16c", "avx2", "bmi1", "bmi2", "fma", "abm", "movbe"}
SKYLAKE = HASWELL | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


def script(file: Path, body: str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"#!/bin/sh\n{body}\n")
    file.chmod(0o755)
    return file


@pytest.fixture(autouse=True)
def start(tmp_path, monkeypatch):
    """Give the test caches of its own, and a way to begin as a new process does."""
    for name in ("POCL_CACHE_DIR", "OCL_ICD_VENDORS", "PYOPENCL_NO_CACHE", "MIRRORSKIN_PROCESSOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = os.environ["PATH"]

    def begin():
        monkeypatch.setenv("PATH", path)
        embedded.verify.cache_clear()

    begin()
    return begin


@pytest.fixture(scope="module")
def pocl():
    """The embedded device."""
    return next(device for device in device_layer._find() if device_layer._is_pocl(device))


@pytest.fixture
def tries(monkeypatch):
    """Collect the child processes that are started."""
    started = []
    run = subprocess.run
    monkeypatch.setattr(
        subprocess, "run", lambda *args, **options: started.append(args) or run(*args, **options)
    )
    return started


@pytest.fixture
def break_linker(tmp_path, monkeypatch):
    """Leave nothing that can link."""
    folder = script(tmp_path / "broken" / "ld", "echo no luck >&2; exit 1").parent

    def hide():
        monkeypatch.setenv("PATH", str(folder))
        monkeypatch.setattr(embedded, "find_zig", lambda: None)

    return hide


def kept(tmp_path):
    return [file.read_bytes()[32:] for file in (tmp_path / "cache" / "mirrorskin").glob("pocl-*")]


def not_a_folder(tmp_path):
    (tmp_path / "file").touch()
    return tmp_path / "file" / "folder"


# --- The first kernel ------------------------------------------------------------------------------------


def test_a_good_answer_is_kept_but_not_for_another_linker(pocl, start, tries, tmp_path, break_linker):
    embedded.verify(pocl)
    first = len(tries)
    assert first >= 1
    assert len(kept(tmp_path)) == 1
    assert list((tmp_path / "cache" / "pocl" / "kcache").iterdir()) == []
    start()
    embedded.verify(pocl)
    assert len(tries) == first
    start()
    break_linker()
    for number in (1, 2):
        with pytest.raises(DeviceError, match=r"no luck.*gcc libc6-dev.*mirrorskin\[linker\]'") as caught:
            embedded.verify(pocl)
        assert "\n" not in str(caught.value)
        assert len(tries) == first + number
    assert len(kept(tmp_path)) == 1


def test_ziglang_takes_over_from_a_broken_linker(pocl, tries, tmp_path, monkeypatch):
    zig = embedded.find_zig()
    working = [str(zig), "ld.lld"] if zig else [str(shutil.which("ld"))]
    standin = script(tmp_path / "zig", f'shift\nexec {shlex.join(working)} "$@"')
    broken = str(script(tmp_path / "broken" / "ld", "exit 1").parent)
    monkeypatch.setattr(embedded, "find_zig", lambda: standin)
    for _ in ("tried", "remembered"):
        monkeypatch.setenv("PATH", broken)
        embedded.verify.cache_clear()
        embedded.verify(pocl)
        assert os.environ["PATH"].endswith(os.pathsep + broken)
        assert kept(tmp_path) == [b"ziglang"]
        assert len(tries) == 2


def test_a_device_that_never_answers(pocl, monkeypatch):
    monkeypatch.setattr(embedded, "_TIMEOUT", 0.001)
    monkeypatch.setattr(embedded, "find_zig", lambda: None)
    with pytest.raises(DeviceError, match="did not finish"):
        embedded.verify(pocl)


def test_a_python_that_does_not_start_is_named(pocl, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(embedded, "find_zig", lambda: None)
    with pytest.raises(DeviceError, match=r"since .*/python does not start \(No such file or directory\)$"):
        embedded.verify(pocl)


def test_without_the_wheel_nothing_is_prepared(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    monkeypatch.setattr(embedded, "_processor", None)
    embedded.prepare()
    assert embedded._processor is None
    assert embedded.why_no_device() is None


_NEW_PROCESS = """
import sys
children = []
sys.addaudithook(lambda event, args: event == "subprocess.Popen" and children.append(args))
import numpy as np
from mirrorskin.kernels.device import open_device
device = open_device("portable")
words = device.from_host("words", np.arange(8), np.uint32)
device.kernel("limits", "copy_all", LANES=2, WORDS=2, STRIDE=1)(1, words=words, count=2, moved=32)
print(len(children), *words.read())
"""


@pytest.mark.usefixtures("pocl")
def test_another_process_tries_no_kernel_again_and_survives_damaged_caches(tmp_path):
    def run():
        command = [sys.executable, "-c", _NEW_PROCESS]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert run() == "1 0 1 2 3 0 1 2 3\n"
    assert run() == "0 0 1 2 3 0 1 2 3\n"
    (answer,) = tmp_path.glob("cache/mirrorskin/pocl-*")
    (program,) = tmp_path.glob("cache/pocl/kcache/**/program.bc")
    for file in (answer, program):
        os.truncate(file, 0)
    assert run() == "1 0 1 2 3 0 1 2 3\n"
    assert run() == "0 0 1 2 3 0 1 2 3\n"


@pytest.mark.parametrize(
    ("complaints", "complaint"),
    [
        ("Build on <device>:\nerror: unknown target CPU 'generic'\n(options: -I x)", "unknown target CPU"),
        ("Traceback\n  File x\npyopencl.LogicError: no platform\n", "pyopencl.LogicError: no platform"),
        ("", "ended with status -11"),
    ],
)
def test_other_failures_quote_what_matters(complaints, complaint):
    explained = embedded._explain(-11, complaints)
    assert complaint in explained
    assert "\n" not in explained
    assert "gcc" not in explained


# --- The caches ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("variable", "below"),
    [("POCL_CACHE_DIR", ""), ("XDG_CACHE_HOME", "pocl/kcache"), ("HOME", ".cache/pocl/kcache")],
)
def test_an_unwritable_cache_is_named(pocl, variable, below, tmp_path, monkeypatch):
    folder = not_a_folder(tmp_path)
    if variable == "HOME":
        monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv(variable, str(folder))
    remedy = "POCL_CACHE_DIR" if variable == "POCL_CACHE_DIR" else "XDG_CACHE_HOME"
    with pytest.raises(DeviceError) as caught:
        embedded.verify(pocl)
    assert f"PoCL cannot write its cache folder {folder / below} (Not a directory)" in str(caught.value)
    assert f"set {remedy} to a writable folder" in str(caught.value)
    assert embedded.why_no_device() == str(caught.value)


def test_a_home_that_cannot_be_written_is_replaced_by_a_temporary_cache(tmp_path):
    home = "/proc"  # where nobody can write, not even root
    environment = {**os.environ, "HOME": home, "TMPDIR": str(tmp_path)}
    del environment["XDG_CACHE_HOME"]
    command = [sys.executable, "-c", _NEW_PROCESS]
    completed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert completed.stdout.endswith(" 0 1 2 3 0 1 2 3\n")
    (note,) = completed.stderr.splitlines()
    assert re.fullmatch(
        rf"PoCL cannot write its cache folder {home}/.cache/pocl/kcache \(.+\); set XDG_CACHE_HOME to a"
        " writable folder; until then kernels are compiled again by every command",
        note,
    )
    assert list(tmp_path.iterdir()) == []


def test_pyopencl_needs_a_cache_too(pocl, tmp_path, monkeypatch):
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(not_a_folder(tmp_path)))
    with pytest.raises(DeviceError, match=r"pyopencl cannot write .* set XDG_CACHE_HOME"):
        embedded.verify(pocl)
    monkeypatch.setenv("PYOPENCL_NO_CACHE", "1")
    assert embedded.why_no_device() is None


def test_hidden_drivers_and_broken_libraries_are_named(tmp_path, monkeypatch):
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "nowhere"))
    assert f"OCL_ICD_VENDORS names {tmp_path / 'nowhere'}" in str(embedded.why_no_device())
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    assert embedded.why_no_device() is None
    broken = tmp_path / "libvendor.so"
    broken.write_text("not a library")
    (tmp_path / "vendor.icd").write_text(f"{broken}\n")
    for named in (broken, tmp_path / "vendor.icd", tmp_path):
        monkeypatch.setenv("OCL_ICD_VENDORS", str(named))
        with pytest.raises(UnknownDeviceError, match=f"{broken} cannot be loaded: .*file too short; OCL_ICD"):
            open_device("vendor's")
    monkeypatch.setattr(device_layer, "_find", list)
    with pytest.raises(DeviceError, match=f"no OpenCL device found: OpenCL's library {broken} cannot be"):
        open_device()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("POCL_DEVICES", "bogus", "no OpenCL device found: POCL_DEVICES is 'bogus', which makes PoCL show"),
        ("POCL_DEVICES", "", "no OpenCL device found: POCL_DEVICES is '', which makes PoCL show"),
        ("POCL_MAX_PTHREAD_COUNT", "-3", "POCL_MAX_PTHREAD_COUNT is '-3': a whole number above 0 is needed"),
        ("MIRRORSKIN_PROCESSOR", "i999", "kernels here: MIRRORSKIN_PROCESSOR is 'i999'; unset it"),
        ("PYOPENCL_BUILD_OPTIONS", "-bogus", "kernels here: PYOPENCL_BUILD_OPTIONS is '-bogus'; unset it"),
    ],
)
def test_the_variable_that_hides_the_device_or_breaks_it_is_named(tmp_path, name, value, message):
    run = "from mirrorskin.kernels.device import open_device; open_device()"
    environment = {key: text for key, text in os.environ.items() if not key.startswith("POCL_")}
    ended = subprocess.run(
        [sys.executable, "-P", "-c", run],
        env={**environment, "MIRRORSKIN_CACHE": str(tmp_path), name: value},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    last = ended.stderr.strip().splitlines()[-1]
    assert re.search(message, ended.stderr), last


def test_a_pocl_that_cannot_run_leaves_the_work_to_a_sound_one(pocl, monkeypatch, caplog):
    broken = type("Broken", (), {name: getattr(pocl, name) for name in _ASKED})()
    monkeypatch.setattr(device_layer, "_find", lambda: [broken, pocl])
    verify = embedded.verify
    problem = DeviceError("PoCL cannot link kernels")

    def verify_each(device):
        if device is broken:
            raise problem
        verify(device)

    monkeypatch.setattr(embedded, "verify", verify_each)
    for choice in (None, "cpu", device_layer._describe(pocl).title):
        assert open_device(choice).context.devices == [pocl]
    assert "is left out: PoCL cannot link kernels" in caplog.text
    with pytest.raises(DeviceError, match="PoCL cannot link kernels"):
        open_device("0")


# --- The processor's name --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (set(), "x86-64"),
        ({"sse2", "avx2", "avx512f"}, "x86-64"),
        (CORE2 | {"sse4_1"}, "penryn"),
        (HASWELL - {"movbe"}, "ivybridge"),
        (SKYLAKE | {"avx512_vnni", "amx_tile"}, "skylake-avx512"),
        (SKYLAKE - {"avx512vl"}, "haswell"),
    ],
)
def test_the_best_name_without_an_instruction_that_is_lacking(flags, name):
    assert processor_name.choose_name(flags) == name


@pytest.mark.parametrize("offset", [0, mmap.PAGESIZE - 5], ids=["in a page", "across two pages"])
def test_a_function_is_made_to_answer_with_a_copy_of_the_name(offset):
    code = mmap.mmap(-1, 2 * mmap.PAGESIZE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(code)) + offset
    processor_name._answer_with(start, "haswell")
    function = ctypes.CFUNCTYPE(ctypes.c_void_p)(start)
    first, second = function(), function()
    assert first != second
    assert [processor_name._take_string(first), processor_name._take_string(second)] == ["haswell"] * 2


@pytest.fixture
def asked(monkeypatch):
    """Begin as a new process does, with a library whose function is made up; return what it was given."""

    def prepare(names, size=83, changed=False):
        libc, calls = ctypes.CDLL(None), []
        libc.strdup.restype = ctypes.c_void_p
        ask = ctypes.CFUNCTYPE(ctypes.c_void_p)(lambda: calls.append("called") or libc.strdup(names.encode()))
        library = SimpleNamespace(pocl_get_llvm_cpu_name=ask)
        code = ctypes.string_at(processor_name._address(ask), 83)
        digest = hashlib.sha256(code[:-1] + b"?" if changed else code).hexdigest()
        monkeypatch.setattr(ctypes, "CDLL", lambda name, **_: libc if name is None else library)
        monkeypatch.setattr(processor_name, "_NAME_FUNCTION_SHA256", digest)
        monkeypatch.setattr(processor_name, "look_up", lambda _: (None, size))
        monkeypatch.setattr(processor_name, "_read_flags", lambda: SKYLAKE)
        monkeypatch.setattr(processor_name, "_answer_with", lambda _, name: calls.append(name))
        embedded.prepare()
        return calls

    monkeypatch.setattr(embedded, "_processor", None)
    monkeypatch.setattr(embedded, "_patched", False)
    return prepare


@pytest.mark.parametrize(
    ("names", "expected"), [("znver3", ["called"]), ("generic", ["called", "skylake-avx512"])]
)
def test_the_known_function_is_patched_for_unknown_processors(asked, names, expected):
    assert asked(names) == expected
    assert ("patched" in embedded.note("3.0")) == (names == "generic")


def test_the_processor_of_the_variable_replaces_the_recognised_one(asked, monkeypatch):
    monkeypatch.setenv("MIRRORSKIN_PROCESSOR", "haswell")
    assert asked("znver3") == ["called", "haswell"]


@pytest.mark.parametrize(
    ("processor", "width"),
    [
        ("unknown", 16),
        ("haswell", 8),
        ("znver3", 8),
        ("skylake-avx512", 16),
        ("rocketlake", 16),
        ("skylake", 8),
    ],
)
def test_vectors_are_as_wide_as_registers_of_the_processor(monkeypatch, processor, width):
    monkeypatch.setattr(embedded, "_processor", processor)
    assert embedded.vector_width(SimpleNamespace(native_vector_width_float=16)) == width


@pytest.mark.parametrize("other", [{"size": 84}, {"changed": True}], ids=["another size", "other bytes"])
def test_another_function_of_that_name_is_neither_called_nor_patched(asked, other):
    assert asked("generic", **other) == []
    assert embedded.note("3.0") == ""


def test_a_library_without_the_function_is_used_as_it_is(monkeypatch, caplog):
    monkeypatch.setattr(embedded, "find_library", lambda: Path("libc.so.6"))
    monkeypatch.setattr(embedded, "_processor", None)
    monkeypatch.setattr(embedded, "_patched", False)
    with caplog.at_level("INFO"):
        embedded.prepare()
    assert "libc.so.6 has no function pocl_get_llvm_cpu_name" in caplog.text
    assert embedded.note("3.0") == ""


# Prints which of the two is in the place of PoCL's function, in a process that has not looked at it yet.
_WHICH = """
import ctypes
from mirrorskin.kernels import embedded, processor_name
function = getattr(ctypes.CDLL(str(embedded.find_library())), processor_name.NAME_FUNCTION)
print(processor_name._digest(processor_name._address(function)) == processor_name._NAME_FUNCTION_SHA256)
"""


@pytest.mark.usefixtures("pocl")
def test_the_function_of_the_wheel_is_the_known_one():
    completed = subprocess.run([sys.executable, "-c", _WHICH], capture_output=True, text=True, check=True)
    assert completed.stdout == "True\n"


def test_the_library_and_the_size_of_a_function_are_looked_up():
    path = embedded.find_library()
    function = ctypes.CDLL(str(path)).pocl_get_llvm_cpu_name
    file, size = processor_name.look_up(processor_name._address(function))
    assert file.samefile(path)
    assert size > 22  # what is written over it
    assert processor_name.look_up(processor_name._address(ctypes.CFUNCTYPE(None)(lambda: None))) == (None, 0)


# --- The linker ------------------------------------------------------------------------------------------


@pytest.fixture
def zig(tmp_path, monkeypatch):
    """A ``ziglang`` that says how it was called."""
    package = tmp_path / "site with a space" / "ziglang"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setenv("PATH", os.environ["PATH"])
    return script(package / "zig", "printf '%s\\n' \"$@\"")


def test_zig_is_found_next_to_its_package(zig):
    assert embedded.find_zig() == zig
    zig.unlink()
    path = os.environ["PATH"]
    assert embedded.find_zig() is None
    assert not embedded.provide_linker()
    assert os.environ["PATH"] == path


def test_compiler_libraries_are_left_out_and_the_rest_is_kept_in_order(zig, tmp_path):
    remaining = ["--hash-style=both", "-shared", "-o", "a.so", "-L/usr/lib/gcc/12", "a's.o", "-lcrystal"]
    dropped = ["-lgcc", "-lgcc_s", "-lc", "-lm", "/usr/lib/crti.o", "crtbeginS.o"]
    folder = embedded.write_linker(tmp_path / "cache", [str(zig), "ld.lld"])
    assert [file.name for file in folder.iterdir()] == ["ld"]
    arguments = [*dropped, *remaining[:5], *dropped, *remaining[5:], *dropped]
    called = subprocess.run([folder / "ld", *arguments], capture_output=True, text=True, check=True)
    assert called.stdout.splitlines() == ["ld.lld", *remaining]
    failing = embedded.write_linker(tmp_path / "cache", ["sh", "-c", "exit 3"])
    assert failing != folder
    assert subprocess.run([failing / "ld"]).returncode == 3


@pytest.mark.usefixtures("zig")
def test_an_unwritable_cache_is_replaced_by_a_private_folder(tmp_path, monkeypatch):
    assert embedded.provide_linker()
    assert Path(str(shutil.which("ld"))).is_relative_to(tmp_path / "cache" / "mirrorskin")
    (tmp_path / "private").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(not_a_folder(tmp_path)))
    monkeypatch.setattr("tempfile.mkdtemp", lambda **_: str(tmp_path / "private"))
    assert embedded.provide_linker()
    assert Path(str(shutil.which("ld"))).is_relative_to(tmp_path / "private")
