"""The contents of a result's file, that it is read back unchanged, and files that are no results."""

from __future__ import annotations

import os

import h5py
import numpy as np
import pytest
from stacks import assert_same, plot_of, record, sphere

from mirrorskin import io
from mirrorskin.io.model.maps import declaration_of

PROCESS = {"program": "mirrorskin", "threshold": 0.5, "hold": 2, "subframe": True, "source": "Münze 五円.h5"}
KNOWN = io.Fitted(
    tilt=0.05,
    turns=2,
    registered=False,
    undistorted=True,
    event="release",
    height_correlation=np.inf,
    source_frames=(0, 8),
    source_region=(1, 6, 2, 9),
)

PLACES = dict(zip("xy", io.pixel_axes((5, 7), (0.5, 0.6)), strict=True))
FLOATS = ("zenith", "azimuth", "normals_sigma", "mean", "cosine", "sine", "modulation", "residual")


def a_press(**changes):
    height = np.linspace(-1, 0, 35, dtype=np.float32).reshape(5, 7)
    height[1, 2] = np.nan
    maps = {"height": height, "height_sigma": height / 10, "status": np.ones((5, 7), np.uint8)}
    return io.Result(**maps | PLACES | {"process": PROCESS} | changes)


def a_rotation(*size, **changes):
    """Return a result with every map of a rotation, of so many turns, rows and columns."""
    rng = np.random.default_rng(5)
    maps = {name: rng.normal(size=size).astype(np.float32) for name in FLOATS}
    maps["normals"] = rng.normal(size=(*size, 3)).astype(np.float32)
    maps["normals"][..., 1, 2, :] = np.nan
    maps |= {name: rng.integers(0, 2, size).astype(np.uint8) for name in ("edges", "contact")}
    return io.Result(**maps | {"process": PROCESS} | changes)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "result.h5"


def test_a_result_has_the_layout_of_the_design(path):
    io.save_result(a_press(), path)
    with h5py.File(path) as file:
        assert dict(file.attrs) == {"NX_class": "NXroot", "default": "entry"}
        assert dict(file["entry"].attrs) == {
            "NX_class": "NXentry",
            "default": "result",
            "mirrorskin_result": 2,
        }
        assert list(file["entry"]) == ["process", "result"]
        maps = file["entry/result"]
        assert {name: np.asarray(value).tolist() for name, value in maps.attrs.items()} == {
            "NX_class": "NXdata",
            "signal": "height",
            "auxiliary_signals": ["height_sigma", "status"],
            "axes": ["y", "x"],
        }
        image, mm = {"interpretation": "image"}, {"units": "mm"}
        height, sigma, status = (
            {"long_name": declaration_of(name).caption} for name in ("height", "height_sigma", "status")
        )
        assert {name: (node.shape, node.dtype.str[1:], dict(node.attrs)) for name, node in maps.items()} == {
            "height": ((5, 7), "f4", image | mm | height),
            "height_sigma": ((5, 7), "f4", image | mm | sigma),
            "height_errors": ((5, 7), "f4", image | mm | sigma),  # a link to it, for viewers
            "status": ((5, 7), "u1", image | status),
            "x": ((7,), "f8", mm),
            "y": ((5,), "f8", mm),
        }
        process = file["entry/process"]
        assert process.attrs["NX_class"] == "NXprocess"
        assert process["source"].asstr()[()] == "Münze 五円.h5"
        assert process["threshold"][()] == 0.5


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"height_sigma": None, "status": None},
        {"x": None, "y": None},
        {"process": {}},
        {"fitted": KNOWN, "process": {}},
    ],
)
def test_a_result_comes_back_as_it_was(path, changes):
    result = a_press(**changes)
    io.save_result(result, path)
    actual = io.open_result(path)
    assert_same(actual, result)
    assert {name: type(value) for name, value in actual.process.items()} == {
        name: type(value) for name, value in result.process.items()
    }
    group, signal, axes = plot_of(path)
    assert (group.name, axes) == ("/entry/result", [] if result.x is None else ["y", "x"])
    np.testing.assert_array_equal(signal, result.height)


@pytest.mark.parametrize(
    ("turns", "places", "axes"),
    [
        ((), {}, []),
        ((), PLACES, ["y", "x"]),
        ((3,), {}, ["turn", ".", "."]),
        ((3,), PLACES, ["turn", "y", "x"]),
    ],
)
def test_a_rotation_s_result_comes_back_and_its_zenith_is_plotted(path, turns, places, axes):
    result = a_rotation(*turns, 5, 7, **places)
    io.save_result(result, path)
    assert_same(io.open_result(path), result)
    group, signal, plotted_along = plot_of(path)
    assert (signal.name, plotted_along) == ("/entry/result/zenith", axes)
    assert list(group.attrs["auxiliary_signals"]) == [*FLOATS[1:], "edges", "contact"]
    if turns:
        np.testing.assert_array_equal(group["turn"], range(turns[0]))


def pieces(*size):
    """Return two pieces, of which one is relative, and a filled pixel."""
    component = np.full(size, -1, np.int32)
    component[..., :2, :], component[..., 3:, :] = 0, 1
    filled = np.zeros(size, np.uint8)
    filled[..., 3, 3] = 1
    return {"component": component, "offset_unknown": np.array([0, 1], np.uint8), "filled": filled}


@pytest.mark.parametrize("turns", [(), (3,)])
def test_pieces_of_a_surface_come_back(path, turns):
    result = a_rotation(*turns, 5, 7, height=np.zeros((*turns, 5, 7), np.float32), **pieces(*turns, 5, 7))
    io.save_result(result, path)
    assert_same(io.open_result(path), result)
    group, signal, _ = plot_of(path)
    assert signal.name == "/entry/result/height"
    assert {"component", "filled"} < set(group.attrs["auxiliary_signals"])
    assert "offset_unknown" not in group.attrs["auxiliary_signals"]
    facts = io.describe(path)
    assert (facts["kind"], facts["components"]) == ("result", "2, 1 with an unknown offset")


def test_a_file_that_is_written_like_the_one_before_is_what_hdf5_would_write(tmp_path, monkeypatch):
    camera = io.CameraId("left", (50, 70), np.dtype(np.uint8))

    def result(seed):
        rng = np.random.default_rng(seed)
        maps = {name: rng.normal(size=(50, 70)).astype("f4") for name in ("height", "height_sigma")}
        references = io.References(*rng.uniform(0, 9, (4, 50, 70)).astype("f4"), np.zeros((50, 70), "u1"))
        facts = PROCESS | {"noise": rng.uniform(), "source": f"{seed} 五円.h5", "frames": seed}
        facts_of = {"calibration": io.Calibration(camera, references=references), "process": facts}
        return io.Result(**maps, status=rng.integers(0, 4, (50, 70)).astype("u1"), **facts_of)

    paths = tmp_path / "a.h5", tmp_path / "b.h5", tmp_path / "c.h5"
    for seed, path in enumerate(paths[:2]):
        io.save_result(result(seed), path)
    io.save_result(result(1), paths[2])
    first, like, anew = (path.read_bytes() for path in paths)
    assert like == anew != first
    actual = io.open_result(paths[1])
    np.testing.assert_array_equal(actual.height, result(1).height)
    assert actual.process["source"] == "1 五円.h5"
    assert actual.calibration.references.dark.tobytes() == result(1).calibration.references.dark.tobytes()


def test_a_result_of_another_program_s_types_is_read(path):
    io.save_result(a_press(), path)
    with h5py.File(path, "r+") as file:
        height = file["entry/result/height"][()]
        del file["entry/result/height"]
        file["entry/result/height"] = height.astype(">f8")
    assert_same(io.open_result(path), a_press())


def test_a_failure_leaves_the_older_result(path, monkeypatch):
    io.save_result(a_press(), path)
    before = path.read_bytes()
    bad = a_press(process={"program": object()})
    with pytest.raises(TypeError):
        io.save_result(bad, path, overwrite=True)
    monkeypatch.setattr("pathlib.Path.replace", lambda *names: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(io.InputError, match=r"result\.h5 could not be written: No space left on device"):
        io.save_result(a_press(), path, overwrite=True)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("missing/r.h5", "there is no folder .*missing: make it first"),
        ("folder", "is a folder: name a file in it"),
        ("pipe", "is not a regular file: choose another place with -o"),
        ("x" * 300, "cannot be written: File name too long; choose another place with -o"),
        ("/proc/r.h5", "/proc/r.h5 cannot be written: No such file or directory; choose another"),
    ],
)
def test_an_impossible_output_is_one_line(tmp_path, name, line):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    before = sorted(tmp_path.iterdir())
    for refuse in (io.check_output, lambda path: io.save_result(a_press(), path)):
        with pytest.raises(io.InputError, match=line) as caught:
            refuse(tmp_path / name)
        assert "\n" not in str(caught.value)
    assert sorted(tmp_path.iterdir()) == before


def test_what_is_not_a_result_is_refused(tmp_path, path):
    with pytest.raises(io.InputError, match=r"result\.h5: no such file"):
        io.open_result(path)
    record(sphere(), path)
    with pytest.raises(io.InputError, match=r"result\.h5 is not a result: 'mirrorskin reconstruct' computes"):
        io.open_result(path)
    with h5py.File(path, "w") as file:
        file["entry"] = 1
    with pytest.raises(io.InputError, match=r"is not a result"):
        io.open_result(path)


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("result", None, "/entry/result contains no maps: reconstruct it again"),
        ("result/status", np.ones((7, 5)), r"status has shape \(7, 5\) where \(5, 7\) is needed: "),
        ("result/x", np.zeros(7), "/entry/result/x is not in the order of the pixels: recon"),
        ("result/height_sigma", np.zeros((5, 7), "S2"), "height_sigma contains no numbers: rec"),
        ("result/height_sigma", h5py.SoftLink("gone"), "the link height_sigma leads to gone, which is"),
        ("result/status", h5py.ExternalLink("../x.h5", "/x"), "leads out of its folder"),
        ("result/offset_unknown", np.zeros(3), r"has shape \(3,\) where \(2,\) is needed: reconstruct"),
        ("result/component", np.zeros(2), r"component has shape \(2,\) where \(5, 7\) is needed"),
        ("process/hold", [1, 2], "/entry/process/hold does not hold one value"),
        ("fitted/tilt", "steep", "/entry/fitted/tilt contains no numbers: reconstruct it again"),
        ("fitted/turns", np.nan, "/entry/fitted/turns is .nan,., where whole numbers are needed: recons"),
        ("fitted/event", np.ones(2), "/entry/fitted/event does not hold one value"),
        ("fitted/source_region", [3, 1, 0, 7], r"source_region is \(3, 1, 0, 7\), which is invalid: reco"),
    ],
)
def test_a_damaged_result_is_one_line(path, name, value, line):
    io.save_result(a_press(**pieces(5, 7), fitted=KNOWN), path)
    with h5py.File(path, "r+") as file:
        del file[f"entry/{name}"]
        if value is not None:
            file[f"entry/{name}"] = value
    for read in (io.open_result, io.describe):
        with pytest.raises(io.InputError, match=line) as caught:
            read(path)
        assert str(caught.value).startswith(str(path))
        assert "\n" not in str(caught.value)


def test_what_is_known_of_maps_is_stored_with_its_unit(path):
    io.save_result(a_press(fitted=KNOWN), path)
    with h5py.File(path) as file:
        fitted = file["entry/fitted"]
        assert set(fitted) == set(KNOWN.values())
        assert dict(fitted["tilt"].attrs) == {"units": "rad"}
        assert (fitted["event"].asstr()[()], fitted["turns"].dtype, fitted["turns"][()]) == (
            "release",
            "i8",
            2,
        )


def test_a_number_in_place_of_a_series_is_refused(path):
    io.save_result(io.Result(status=np.zeros((5, 7), np.uint8), slide_distance=np.ones(5)), path)
    with h5py.File(path, "r+") as file:
        del file["entry/result/slide_distance"]
        file["entry/result/slide_distance"] = 1.0
    with pytest.raises(io.InputError, match=r"slide_distance has shape \(\) where \(0,\) is needed"):
        io.open_result(path)


def test_values_of_different_numbers_of_frames_are_refused(path):
    maps = {"status": np.zeros((5, 7), np.uint8), "stick_ratio": np.ones(4), "slide_distance": np.ones(5)}
    io.save_result(io.Result(**maps), path)
    with pytest.raises(io.InputError, match=r"different numbers of frames \(.* of [45], .* of [45]\)"):
        io.open_result(path)


def test_heights_in_another_unit_are_converted(tmp_path):
    path = tmp_path / "result.h5"
    io.save_result(io.Result(height=np.full((2, 3), 1.5, np.float32)), path)
    with h5py.File(path, "r+") as file:
        file["/entry/result/height"][...] = 1500
        file["/entry/result/height"].attrs["units"] = "um"
    np.testing.assert_allclose(io.open_result(path).height, 1.5, rtol=1e-6)
