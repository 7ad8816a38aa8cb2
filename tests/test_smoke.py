"""Each command on small recordings, with each optional package; warnings are errors.

'make test-lowest' runs it with the oldest packages that pyproject.toml allows.
"""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from commands import run

from mirrorskin import io
from mirrorskin.io.formats.registry import export_suffixes

pytestmark = pytest.mark.slow

SMALL = "--size", "96x80", "--pixel-size", "0.12mm"
EXPORTS = tuple(suffix.removeprefix(".") for suffix in export_suffixes())


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with a press and a turn, and what was reconstructed from them."""
    place = tmp_path_factory.mktemp("desk")
    with contextlib.chdir(place):
        done("simulate", "vertical", *SMALL, "--frames", "16", "-o", "press.h5")
        done("simulate", "axial", *SMALL, "-o", "turn.h5")
        for name in ("press", "turn"):
            done("reconstruct", f"{name}.h5", "-o", f"{name}-result.h5")
        yield place


@pytest.fixture(autouse=True)
def _in_it(desk, monkeypatch):
    monkeypatch.chdir(desk)


def done(*words):
    """Run a command, which must succeed without a word on standard error; return what it printed."""
    ended = run(*words)
    assert ended.code == 0, ended.said
    assert "Warning" not in ended.said
    return ended.out


@pytest.mark.parametrize("name", ["press", "turn"])
def test_a_result_is_scored(name):
    assert "answered" in done("score", f"{name}-result.h5", "--truth", f"{name}.h5")


@pytest.mark.parametrize("name", ["press.h5", "turn-result.h5"])
def test_info(name):
    assert "kind" in done("info", name)


def test_devices():
    assert done("devices")


def test_samples(desk):
    done("sample", "stack", "-o", "stack.h5")
    done("sample", "pictures", "-o", "pictures")
    done("import", "pictures", "--motion", "vertical", "--travel-step", "0.1mm", "-o", "imported.h5")
    done("sample", "video", "-o", "press.avi")
    assert "31 of 320 x 320, uint8" in done("info", "press.avi")


def test_fuse():
    done("fuse", "press.h5", "turn.h5", "--zenith-gain", "5.7/deg", "--zenith-offset", "0", "-o", "fused.h5")


def test_measure():
    done("measure", "press-result.h5")


@pytest.mark.parametrize("suffix", EXPORTS)
def test_a_result_is_exported(suffix):
    done("export", "press-result.h5", "-o", f"result.{suffix}")


def test_a_recording_in_zarr():
    done("export", "press.h5", "-o", "again.zarr")
    with io.open_recording("press.h5") as first, io.open_recording("again.zarr") as again:
        np.testing.assert_array_equal(first.frame(3), again.frame(3))


def test_a_recording_in_mcap():
    done("export", "press.h5", "-o", "again.mcap")
    done("import", "again.mcap", "--motion", "vertical", "--travel-step", "0.1mm", "-o", "again.h5")
    with io.open_recording("press.h5") as first, io.open_recording("again.h5") as again:
        np.testing.assert_array_equal(first.frame(3), again.frame(3))


def test_a_recording_in_a_store_of_fsspec():
    io.save_zarr("press.h5", "memory://smoke/press.zarr")
    done("reconstruct", "memory://smoke/press.zarr", "-o", "store.h5")


def test_a_mesh_is_pressed_on():
    done("export", "press-result.h5", "-o", "mesh.stl")
    done("simulate", "vertical", *SMALL, "--frames", "8", "--object", "mesh.stl", "-o", "mesh.h5")


def test_views_and_a_report():
    done("view", "press-result.h5", "-o", "view.png")
    done("report", "press-result.h5", "-o", "report.html")


def test_the_application():
    from mirrorskin.view.app import App

    with contextlib.closing(App("press.h5", "press-result.h5")) as app:
        app.options.widgets["threshold"].value = 0.4
        assert app.session.before is not None


def test_a_batch_on_two_processes():
    assert "2 done" in done("batch", "press.h5", "turn.h5", "-o", "results", "--workers", "2")


def test_labelled_arrays():
    assert "height" in io.open_result("press-result.h5").to_xarray()
