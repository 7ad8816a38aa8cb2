import os
import shutil
import subprocess
from pathlib import Path

import pytest

from mirrorskin.kernels import linker


@pytest.fixture
def zig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A ``ziglang`` that says how it was called."""
    package = tmp_path / "site with a space" / "ziglang"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    program = package / "zig"
    program.write_text("#!/bin/sh\nprintf '%s\\n' \"$@\"\n")
    program.chmod(0o755)
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setenv("PATH", os.environ["PATH"])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return program


def test_it_is_found_beside_its_package(zig: Path) -> None:
    assert linker.find_zig() == zig
    zig.unlink()
    assert linker.find_zig() is None


def test_it_is_not_found_where_it_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert linker.find_zig() is None
    path = os.environ["PATH"]
    assert not linker.provide()
    assert os.environ["PATH"] == path


def test_compiler_libraries_are_left_out_and_the_rest_is_kept_in_order(zig: Path, tmp_path: Path) -> None:
    kept = ["--hash-style=both", "-shared", "-o", "a.so", "-L/usr/lib/gcc/12", "a's.o", "-lcrystal"]
    dropped = ["-lgcc", "-lgcc_s", "-lc", "-lm", "/usr/lib/crti.o", "crtbeginS.o"]
    shim = linker.write_shim(tmp_path, [str(zig), "ld.lld"]) / "ld"
    given = [*dropped, *kept[:5], *dropped, *kept[5:], *dropped]
    called = subprocess.run([shim, *given], capture_output=True, text=True, check=True)
    assert called.stdout.splitlines() == ["ld.lld", *kept]


def test_a_failing_linker_fails(tmp_path: Path) -> None:
    shim = linker.write_shim(tmp_path, ["sh", "-c", "exit 3"]) / "ld"
    assert subprocess.run([shim]).returncode == 3


def test_each_command_has_a_folder_that_holds_nothing_else(tmp_path: Path) -> None:
    folders = {linker.write_shim(tmp_path, [command]) for command in ("one", "other", "one")}
    assert len(folders) == 2
    assert all([file.name for file in folder.iterdir()] == ["ld"] for folder in folders)


def test_it_comes_first_on_the_path(zig: Path, tmp_path: Path) -> None:
    assert linker.provide()
    found = shutil.which("ld")
    assert found is not None
    assert Path(found).is_relative_to(tmp_path / "cache" / "mirrorskin")


@pytest.mark.usefixtures("zig")
def test_an_unwritable_cache_is_replaced_by_a_private_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr("tempfile.mkdtemp", lambda **_: str(private))
    assert linker.provide()
    found = shutil.which("ld")
    assert found is not None
    assert Path(found).is_relative_to(private)
