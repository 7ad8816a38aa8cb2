"""Formats are declared once: those of packages work like built-in ones, and any of these can be missing."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import done, refused
from installed_packages import install

from mirrorskin import io
from mirrorskin.io.formats import registry

PAGE = Path(__file__).parents[3] / "docs" / "formats.md"
OWN = re.search(r"```python\n(# raw_frames\.py\n.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
"""The format of the page, which an installed package contains."""

TRAVEL = ("--travel-step", "0.1mm")
LEVELS = ("--dark", 20, "--bright", 200)


def press(count=12, shape=(6, 9)):
    """Return frames of a press, uint8."""
    late = np.add.outer(np.arange(shape[0]), np.arange(shape[1])) / 3
    frames = np.where(np.arange(count)[:, None, None] > late + 1, 200, 20)
    return (frames + np.random.default_rng(0).integers(0, 3, frames.shape)).astype(np.uint8)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install a package with the format of the page, in whose folder commands run."""
    package = tmp_path / "site"
    install(package, registry.FORMATS, raw="raw_frames:RAW")
    (package / "raw_frames.py").write_text(OWN, encoding="utf-8")
    monkeypatch.syspath_prepend(package)
    monkeypatch.chdir(tmp_path)
    frames = press()
    Path("press.raw").write_bytes(np.array(frames.shape, "<u4").tobytes() + frames.tobytes())
    np.save("press.npy", frames)


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("line", ["reconstruct", "run mirrorskin.engine.press:Onset"])
def test_frames_of_a_package_s_format_give_the_result_of_an_array(line):
    for name in ("raw", "npy"):
        done(line, f"press.{name}", *TRAVEL, *LEVELS, "-o", f"{name}.h5")
    raw, array = (io.open_result(f"{name}.h5") for name in ("raw", "npy"))
    np.testing.assert_array_equal(raw.height, array.height)
    assert np.isfinite(raw.height).any()


@pytest.mark.usefixtures("installed")
def test_a_package_s_format_is_checked():
    done("check", "press.raw", *TRAVEL)


@pytest.mark.usefixtures("installed")
def test_a_package_s_format_is_described():
    assert io.describe("press.raw")["kind"] == "raw frames file"


@pytest.mark.usefixtures("installed")
def test_a_package_s_format_is_imported():
    done("import", "press.raw", "--motion", "vertical", *TRAVEL, "-o", "press.h5")
    with io.open_recording("press.h5") as recording:
        np.testing.assert_array_equal(recording.frame(3), press()[3])


@pytest.mark.usefixtures("installed")
def test_a_result_is_exported_to_a_package_s_format():
    done("reconstruct", "press.npy", *TRAVEL, *LEVELS, "--pixel-size", "0.1mm", "-o", "r.h5")
    done("export", "r.h5", "-o", "heights.raw")
    rows, columns = np.fromfile("heights.raw", "<u4", 2)
    heights = np.fromfile("heights.raw", "<f4", offset=8).reshape(rows, columns)
    np.testing.assert_array_equal(heights, io.open_result("r.h5").height)


@pytest.mark.usefixtures("installed")
def test_a_package_s_format_is_no_result():
    line = refused("a result is HDF5", "reconstruct", "press.npy", *TRAVEL, "-o", "r.raw")
    assert "mirrorskin export" in line


@pytest.mark.usefixtures("installed")
def test_damaged_frames_of_a_package_s_format_are_one_line():
    Path("press.raw").write_bytes(Path("press.raw").read_bytes()[:-1])
    refused("press.raw is cut short", "reconstruct", "press.raw", *TRAVEL)


@pytest.mark.usefixtures("installed")
def test_an_option_that_a_format_does_not_take_is_refused():
    refused("press.raw: a raw frames file has no --channel", "info", "press.raw", "--channel", 1)


@pytest.mark.usefixtures("installed")
def test_exports_that_are_possible_are_listed_with_those_of_packages():
    done("reconstruct", "press.npy", *TRAVEL, *LEVELS, "--pixel-size", "0.1mm", "-o", "r.h5")
    assert refused("is not a supported format", "export", "r.h5", "-o", "r.off").endswith(".raw")


@pytest.mark.parametrize(
    ("value", "line"),
    [
        ("absent_module:RAW", "the format raw of an installed package cannot be loaded: No module named"),
        ("raw_frames:ABSENT", "the format raw of an installed package cannot be loaded"),
        ("raw_frames:encode", "raw_frames:encode, in the entry points mirrorskin.formats, is no mirrorskin"),
    ],
)
def test_an_entry_point_that_is_no_format_is_refused_in_a_line(installed, tmp_path, value, line):
    install(tmp_path / "site", registry.FORMATS, raw=value)
    refused(line, "info", "press.raw")


@pytest.fixture
def without_mcap(tmp_path, monkeypatch):
    """Remove the file of a built-in format."""
    folder = shutil.copytree(Path(registry.__file__).parent, tmp_path / "io" / "formats")
    (folder / "mcap.py").unlink()
    (tmp_path / "io" / "files").mkdir()
    shutil.copy(Path(registry.__file__).parents[1] / "files" / "result_file.py", tmp_path / "io" / "files")
    monkeypatch.setattr(registry, "_HERE", folder)
    registry._built_in.cache_clear()
    yield
    registry._built_in.cache_clear()


@pytest.mark.usefixtures("without_mcap")
def test_a_format_whose_file_is_missing_is_listed_nowhere():
    assert "MCAP" not in registry.sources()
    assert ".mcap" not in registry.export_suffixes()


@pytest.mark.usefixtures("without_mcap")
def test_without_the_file_of_a_format_others_are_read():
    assert registry.format_of_frames(Path("a.tif")).name == "TIFF"
    assert registry.format_of_frames(Path("a.mcap")) is None


def test_every_declaration_names_what_its_module_contains():
    for form in registry.formats(installed=False):
        names = [name for name in (form.reader, form.encoder, form.decoder, form.recorder) if name]
        assert names
        assert all(callable(form.load(name)) for name in names)


def test_no_two_formats_have_the_same_use_of_a_suffix():
    for use in ("reader", "encoder", "decoder"):
        suffixes = [
            suffix
            for form in registry.formats(installed=False)
            if getattr(form, use)
            for suffix in form.suffixes
        ]
        assert len(suffixes) == len(set(suffixes))
