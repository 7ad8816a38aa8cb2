"""What stands between PoCL and its first kernel. Every try is a real child process."""

import os
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mirrorskin.kernels import linker, pocl, processor
from mirrorskin.kernels.errors import DeviceError


def _script(file: Path, body: str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"#!/bin/sh\n{body}\n")
    file.chmod(0o755)
    return file


@pytest.fixture(autouse=True)
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Give the test caches of its own, and a way to begin as a new process does."""
    for name in ("POCL_CACHE_DIR", "OCL_ICD_VENDORS", "PYOPENCL_NO_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = os.environ["PATH"]

    def begin() -> None:
        monkeypatch.setenv("PATH", path)
        monkeypatch.setattr(pocl, "_verified", False)

    begin()
    return begin


@pytest.fixture
def tries(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Collect the child processes that are started."""
    started: list[object] = []
    run = subprocess.run

    def count(*args: Any, **kwargs: Any) -> Any:
        started.append(args)
        return run(*args, **kwargs)

    monkeypatch.setattr(subprocess, "run", count)
    return started


@pytest.fixture
def break_linker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Leave nothing that can link."""

    def hide() -> None:
        monkeypatch.setenv(
            "PATH", str(_script(tmp_path / "broken" / "ld", "echo no luck >&2; exit 1").parent)
        )
        monkeypatch.setattr(linker, "find_zig", lambda: None)

    return hide


def _kept(tmp_path: Path) -> list[str]:
    return [file.read_text() for file in (tmp_path / "cache" / "mirrorskin").glob("pocl-*")]


def _not_a_folder(tmp_path: Path) -> Path:
    (tmp_path / "file").touch()
    return tmp_path / "file" / "folder"


def test_the_compiler_has_a_name_for_this_processor() -> None:
    pocl.prepare()
    assert pocl._processor not in (None, "generic")


def test_a_good_answer_is_kept(start: Callable[[], None], tries: list[object], tmp_path: Path) -> None:
    pocl.verify()
    first = len(tries)
    assert first >= 1
    assert len(_kept(tmp_path)) == 1
    pocl.verify()
    start()
    pocl.verify()
    assert len(tries) == first


def test_nothing_is_left_in_the_kernel_cache(tmp_path: Path) -> None:
    pocl.verify()
    assert list((tmp_path / "cache" / "pocl" / "kcache").iterdir()) == []


def test_a_process_that_cannot_link_is_one_line(
    break_linker: Callable[[], None], tries: list[object], tmp_path: Path
) -> None:
    break_linker()
    for number in (1, 2):
        with pytest.raises(DeviceError, match="no luck") as caught:
            pocl.verify()
        assert "gcc libc6-dev" in str(caught.value)
        assert "pip install 'mirrorskin[linker]'" in str(caught.value)
        assert "\n" not in str(caught.value)
        assert len(tries) == number
    assert _kept(tmp_path) == []


def test_a_good_answer_does_not_serve_another_linker(
    start: Callable[[], None], break_linker: Callable[[], None]
) -> None:
    pocl.verify()
    start()
    break_linker()
    with pytest.raises(DeviceError, match="no luck"):
        pocl.verify()


def test_without_any_linker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(linker, "find_zig", lambda: None)
    with pytest.raises(DeviceError, match="gcc libc6-dev"):
        pocl.verify()


def test_ziglang_takes_over_from_a_broken_linker(
    tries: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    zig = linker.find_zig()
    working = [str(zig), "ld.lld"] if zig else [str(shutil.which("ld"))]
    standin = _script(tmp_path / "zig", f'shift\nexec {shlex.join(working)} "$@"')
    broken = str(_script(tmp_path / "broken" / "ld", "exit 1").parent)
    monkeypatch.setattr(linker, "find_zig", lambda: standin)
    for _ in ("tried", "remembered"):
        monkeypatch.setenv("PATH", broken)
        monkeypatch.setattr(pocl, "_verified", False)
        pocl.verify()
        assert os.environ["PATH"].endswith(os.pathsep + broken)
        assert _kept(tmp_path) == ["ziglang"]
        assert len(tries) == 2


def test_an_answer_that_cannot_be_kept_is_found_again(
    start: Callable[[], None], tries: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(_not_a_folder(tmp_path)))
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setenv("PYOPENCL_NO_CACHE", "1")
    pocl.verify()
    first = len(tries)
    start()
    pocl.verify()
    assert len(tries) == 2 * first


def test_a_device_that_never_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pocl, "_TIMEOUT", 0.001)
    monkeypatch.setattr(linker, "find_zig", lambda: None)
    with pytest.raises(DeviceError, match="did not finish"):
        pocl.verify()


def test_without_the_wheel_nothing_is_done(tries: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    monkeypatch.setattr(pocl, "_processor", None)
    pocl.prepare()
    pocl.verify()
    assert pocl._processor is None
    assert pocl.why_no_device() is None
    assert tries == []


def test_a_system_that_forbids_the_change_leaves_pocl_as_it_is(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_: Path) -> str:
        raise PermissionError("mprotect refused")

    monkeypatch.setattr(pocl, "_processor", None)
    monkeypatch.setattr(processor, "ensure_name", refuse)
    pocl.prepare()
    assert "mprotect refused" in caplog.text


@pytest.mark.parametrize(
    ("complaints", "complaint"),
    [
        ("Build on <device>:\nerror: unknown target CPU 'generic'\n(options: -I x)", "unknown target CPU"),
        ("Traceback\n  File x\npyopencl.LogicError: no platform\n", "pyopencl.LogicError: no platform"),
        ("", "ended with status -11"),
    ],
)
def test_other_failures_quote_what_matters(complaints: str, complaint: str) -> None:
    explained = pocl._explain(-11, complaints)
    assert complaint in explained
    assert "\n" not in explained
    assert "gcc" not in explained


def test_nothing_to_tell_where_all_is_well() -> None:
    assert pocl.why_no_device() is None


@pytest.mark.parametrize(
    ("variable", "below"),
    [
        ("POCL_CACHE_DIR", ""),
        ("XDG_CACHE_HOME", "pocl/kcache"),
        ("HOME", ".cache/pocl/kcache"),
    ],
)
def test_an_unwritable_cache_is_named(
    variable: str, below: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = _not_a_folder(tmp_path)
    if variable == "HOME":
        monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv(variable, str(folder))
    reason = pocl.why_no_device()
    assert reason is not None
    assert f"PoCL cannot write its cache folder {folder / below} (Not a directory)" in reason
    remedy = "POCL_CACHE_DIR" if variable == "POCL_CACHE_DIR" else "XDG_CACHE_HOME"
    assert f"set {remedy} to a writable folder" in reason
    with pytest.raises(DeviceError) as caught:
        pocl.verify()
    assert str(caught.value) == reason


def test_pyopencl_needs_a_cache_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(_not_a_folder(tmp_path)))
    with pytest.raises(DeviceError, match=r"pyopencl cannot write .* set XDG_CACHE_HOME"):
        pocl.verify()
    monkeypatch.setenv("PYOPENCL_NO_CACHE", "1")
    assert pocl.why_no_device() is None


def test_hidden_drivers_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "nowhere"))
    assert f"OCL_ICD_VENDORS names {tmp_path / 'nowhere'}" in str(pocl.why_no_device())
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path))
    assert pocl.why_no_device() is None


def test_a_library_that_does_not_load_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "libpocl-0.so").write_text("not a library")
    monkeypatch.setattr(pocl, "find_library", lambda: tmp_path / "libpocl-0.so")
    assert "PoCL cannot be loaded" in str(pocl.why_no_device())
