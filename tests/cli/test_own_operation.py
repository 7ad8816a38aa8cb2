"""An operation outside the repository, of at most 40 lines, has all features of built-in ones."""

from __future__ import annotations

import csv
import inspect
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tifffile
from commands import done, refused, run
from shown import panel
from stacks import MadeUp, record

from mirrorskin import engine, io
from mirrorskin.engine.base.reconstruction import load_operation
from mirrorskin.view.app.session import Opening, Session
from mirrorskin.view.app.wording import as_command, as_python
from mirrorskin.view.result import overview

CODE = '''\
import numpy as np
from numpy.typing import ArrayLike

from mirrorskin import engine, io
from mirrorskin.kernels.device import C_TYPES

KERNEL = """
__kernel void above_level(__global const FRAME *frames, const int count, const int pixels,
                          __global const float *level, __global int *above) {
    const int pixel = get_global_id(0);
    for (int k = 0; k < count && pixel < pixels; k++)
        above[pixel] += frames[(long)k * pixels + pixel] > level[pixel];
}
"""


class Bright(engine.Operation):
    """Height from the number of frames that are brighter than a level."""

    travel_offset: float = engine.option(default=0.0, unit="mm", within=(-1, 1), help="added to all travels")
    level: ArrayLike | None = engine.option(
        default=None, unit="counts", within=(0, None), help="bright above"
    )
    depth = io.Map("depth at which the pixel turns bright", "mm", quantity="height", displayed="µm")
    kind = io.Map("kind of pixel", codes={0: "never bright", 1: "bright at the end"}, undefined=0)
    motions = ("vertical",)

    def configured_for(self, source):
        dark, bright = source.header.dark, source.header.bright  # of the calibration, if there is one
        known = self.level is None and dark is not None and bright is not None
        return self.with_options(level=(dark + bright) / 2) if known else self

    def start(self, shape, dtype):
        level = np.broadcast_to(100 if self.level is None else self.level, shape)
        self.threshold = self.device.from_host("level", level, np.float32)
        self.above = self.device.from_host("above", np.zeros(shape), np.int32)
        self.kernel = self.device.kernel(KERNEL, "above_level", FRAME=C_TYPES[dtype.name])

    def push(self, frames, *, travel):
        pixels, seen = frames[0].size, self.device.share("frames", frames)
        arguments = {"count": len(frames), "pixels": pixels, "level": self.threshold, "above": self.above}
        self.kernel(pixels, frames=seen, moved=frames.nbytes, **arguments)
        self.device.finish()

    def result(self):
        above, travel = self.above.read(), self.positions_so_far("travel") + self.travel_offset
        step = np.diff(travel).mean() if len(travel) > 1 else np.nan
        depth = np.where(above > 0, above * step - travel[-1] - step / 2, np.nan)
        return {"depth": depth, "depth_sigma": np.where(above > 0, step / 12**0.5, np.nan), "kind": above > 0}
'''
SHAPE, PIXEL = (24, 32), 0.1
X, Y = io.pixel_axes(SHAPE, (PIXEL, PIXEL))
BALL = np.sqrt(25 - X**2 - Y[:, np.newaxis] ** 2) - 5.1
TRAVEL = 0.02 * np.arange(40)
FRAMES = np.where(TRAVEL[:, np.newaxis, np.newaxis] >= -BALL, 200, 20).astype(np.uint8)
OFFSET = 0.1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the class, two recordings, and the result of the first."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.py").write_text(CODE, encoding="utf-8")
    for name in ("one.h5", "two.h5"):
        record(MadeUp(FRAMES, io.Header("vertical", pixel_size=(PIXEL, PIXEL)), travel=TRAVEL), folder / name)
    ended = done(
        *words(folder), "--travel-offset", "100um", "--device", "0", "-o", folder / "res.h5", "--json"
    )
    (folder / "said.json").write_text(ended.out, encoding="utf-8")
    return folder


def words(folder):
    return "run", f"{folder / 'mine.py'}:Bright", folder / "one.h5"


@pytest.fixture(scope="module")
def result(folder):
    return io.open_result(folder / "res.h5")


def test_it_has_at_most_40_lines():
    code = CODE[CODE.index("class Bright") :]
    assert len([line for line in code.splitlines() if line.strip()]) <= 40


def test_its_heights_and_their_standard_deviation_are_right(result):
    error = result.height - (BALL - OFFSET)
    assert np.nanmax(np.abs(error)) < 0.02
    assert np.nanmean((error / result.height_sigma) ** 2) == pytest.approx(1, abs=0.3)


def test_help_shows_its_options_with_units_and_defaults(folder):
    ended = done(*words(folder)[:2], "--help")
    text = " ".join(ended.out.split())
    assert "--travel-offset LENGTH" in text
    assert "Added to all travels" in text
    assert "Bright above" in text
    assert "Height from the number of frames" in text


def test_options_are_in_the_process(result):
    chosen = {name: result.process[name] for name in ("operation", "travel_offset")}
    assert chosen == {"operation": "Bright", "travel_offset": OFFSET}


@pytest.mark.parametrize(
    ("option", "line"),
    [
        (["--travel-offst", "1mm"], "has no option --travel-offst: did you mean --travel-offset?"),
        (["--travel-offset", "100"], "a unit is needed"),
        (["--level", "-1"], "level -1.0: a number in counts of at least 0"),
    ],
)
def test_an_impossible_option_is_one_line(folder, option, line):
    refused(line, *words(folder), *option, "-o", folder / "no.h5")
    assert not (folder / "no.h5").exists()


def test_json_has_units_and_counts(folder):
    text = json.loads((folder / "said.json").read_text(encoding="utf-8"))
    assert text["process"]["travel_offset"] == OFFSET
    assert text["summary"]["what"] == "depth"


@pytest.mark.parametrize("suffix", ["h5", "zarr"])
def test_files_keep_units_titles_and_legends(folder, result, suffix, tmp_path):
    io.save_result(result, tmp_path / f"res.{suffix}")
    read = io.open_result(tmp_path / f"res.{suffix}")
    assert read.declaration("depth").unit == read.declaration("depth_sigma").unit == "mm"
    assert read.declaration("kind").codes == {0: "never bright", 1: "bright at the end"}
    np.testing.assert_array_equal(read.height, result.height)


def test_one_of_its_maps_is_exported_in_its_unit(folder, result, tmp_path):
    targets = [tmp_path / f"kind.{suffix}" for suffix in ("csv", "tif", "npz")]
    done("export", folder / "res.h5", "--map", "kind", *(word for path in targets for word in ("-o", path)))
    kind = np.where(result["kind"] == 0, np.nan, 1)  # 0 is undefined
    np.testing.assert_array_equal(np.loadtxt(targets[0], delimiter=","), kind)
    np.testing.assert_array_equal(tifffile.imread(targets[1]), kind)
    with np.load(targets[2]) as arrays:
        assert set(arrays) == {"kind", "x", "y", "units", "legends", "process", "fitted"}
    done("export", folder / "res.h5", "--map", "depth_sigma", "-o", tmp_path / "sigma.csv")
    assert "depth_sigma in mm" in (tmp_path / "sigma.csv").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--map", "kin", "-o", "a.csv"], "the result has no map kin: did you mean kind?"),
        (["--map", "kind", "-o", "a.ply"], "--map is for a .tif file"),
        (["--map", "kind", "-o", "a.zarr", "-o", "a.csv"], "a.zarr takes all maps: leave --map out"),
        (
            ["--map", "kind", "-o", "a.ply", "-o", "a.csv"],
            "a.ply takes no map: choose .tif, .tiff",
        ),
        (["--map", "kind", "--section", "apex", "-o", "a.csv"], "Leave out the section or the map"),
    ],
)
def test_a_map_that_cannot_be_exported_is_one_line(folder, options, line):
    refused(line, "export", folder / "res.h5", *options)


def test_its_function_on_arrays_gives_the_same(folder, result):
    operation = load_operation(f"{folder / 'mine.py'}:Bright")
    height_of = engine.function_of(operation)
    assert [*inspect.signature(height_of).parameters][:2] == ["frames", "travel"]
    assert "Added to all travels" in height_of.__doc__
    same(height_of(FRAMES, TRAVEL, travel_offset=OFFSET), result)


def same(first, other):
    assert first.maps().keys() == other.maps().keys()
    for name in other.maps():
        np.testing.assert_array_equal(first[name], other[name], err_msg=name)


def test_a_calibration_is_used_by_the_command_the_application_and_if_the_recording_carries_it(
    folder, tmp_path, monkeypatch
):
    level = np.full(SHAPE, 20, np.float32)
    level[:, :3] = 400  # above all samples, so that these columns never turn bright
    no, sure = np.zeros(SHAPE, np.uint8), np.full(SHAPE, 0.1, np.float32)
    references = io.References(level, level + 100, sure, sure, no)
    calibration = io.Calibration(io.CameraId("", SHAPE, FRAMES.dtype), references=references)
    io.save_calibration(calibration, tmp_path / "cal.h5")
    done(*words(folder), "--calibration", tmp_path / "cal.h5", "-o", tmp_path / "res.h5")
    result = io.open_result(tmp_path / "res.h5")
    assert result.process["calibration_parts"] == "references"
    np.testing.assert_array_equal(np.isfinite(result.height[:, :3]), False)
    assert np.isfinite(result.height[:, 3:]).any()
    opening = Opening(calibration=tmp_path / "cal.h5", operation=f"{folder / 'mine.py'}:Bright")
    session = Session(folder / "one.h5", opening)
    same(session.now.result, result)
    texts = as_command(session), as_python(session)
    session.close()
    monkeypatch.chdir(tmp_path)
    for work in (lambda: done(*shlex.split(texts[0])[1:], "--overwrite"), lambda: exec(texts[1], {})):
        Path("result.h5").unlink(missing_ok=True)
        work()
        same(io.open_result("result.h5"), result)
    header = io.Header("vertical", pixel_size=(PIXEL, PIXEL))
    record(io.Calibrated(MadeUp(FRAMES, header, travel=TRAVEL), calibration), tmp_path / "carried.h5")
    with io.open_recording(tmp_path / "carried.h5") as recording:
        again = engine.run(recording, load_operation(f"{folder / 'mine.py'}:Bright"))
    same(again, result)


def test_its_maps_are_shown_while_it_runs(folder, result):
    operation = load_operation(f"{folder / 'mine.py'}:Bright")(travel_offset=OFFSET)
    header = io.Header("vertical", pixel_size=(PIXEL, PIXEL))
    with engine.live.Stream(operation, SHAPE, header=header, latency=math.inf) as stream:
        stream.push(FRAMES, travel=TRAVEL)
        stream.result()
    shown = stream.latest()
    assert shown.first == "depth"
    assert shown.height is shown.depth
    same(shown.maps, result)
    for name in result.maps():
        assert shown.maps.declaration(name) == result.declaration(name)


def test_exports_take_its_height(folder, tmp_path):
    for name in ("res.tif", "res.ply", "res.mcap", "res.npz", "res.csv"):
        ended = run("export", folder / "res.h5", "-o", tmp_path / name)
        assert (ended.code, ended.said) == (0, "")
    with np.load(tmp_path / "res.npz") as arrays:
        assert json.loads(str(arrays["units"]))["depth"] == "mm"
    assert tifffile.imread(tmp_path / "res.tif").shape == SHAPE
    lines = (tmp_path / "res.csv").read_text(encoding="utf-8").splitlines()
    assert next(csv.reader(line for line in lines if not line.startswith("#")))


def test_measure_score_and_fuse_take_its_height(result):
    sphere = engine.measure(result, form="sphere").quantities["sphere radius"]
    assert sphere.value == pytest.approx(5, abs=4 * sphere.sigma)
    flat = np.zeros(SHAPE, np.float32)
    truth = io.Truth((BALL - OFFSET).astype(np.float32), flat, flat, np.ones(SHAPE, np.uint8))
    assert engine.score(result, truth).height.rms < 0.01
    normals = np.dstack(
        [X / 5 + 0 * BALL, Y[:, np.newaxis] / 5 + 0 * BALL, np.sqrt(1 - (X**2 + Y[:, np.newaxis] ** 2) / 25)]
    )
    faces = io.Result(normals=normals.astype(np.float32), normals_sigma=np.full(SHAPE, 0.01, np.float32))
    fused = engine.fuse(result, faces, PIXEL)
    assert np.sqrt(np.nanmean((fused.height - BALL + OFFSET) ** 2)) < 0.004


def test_figures_and_the_report_have_its_title_unit_and_legend(folder, result, tmp_path):
    figure = overview(result, name="res.h5")
    assert panel(figure, "Depth").child_axes[0].get_ylabel() == "depth (µm)"
    assert [text.get_text().splitlines()[0] for text in panel(figure, "Kind").get_legend().get_texts()]
    assert run("report", folder / "res.h5", "-o", tmp_path / "res.html").code == 0
    page = (tmp_path / "res.html").read_text(encoding="utf-8")
    assert "bright at the end" in page
    assert "depth at which the pixel turns bright" in page


def test_xarray_has_units_and_legends(result):
    dataset = result.to_xarray()
    assert dataset.depth.attrs["units"] == "mm"
    assert dataset.kind.attrs["flag_meanings"] == "never_bright bright_at_the_end"


def test_a_batch_runs_it_and_resumes(folder, tmp_path):
    (tmp_path / "batch.toml").write_text(
        f'[operation]\nclass = "{folder / "mine.py"}:Bright"\ntravel-offset = "100um"\n', encoding="utf-8"
    )
    command = "batch", folder / "one.h5", folder / "two.h5", "-o", tmp_path / "out", "--settings"
    done(*command, tmp_path / "batch.toml")
    result = io.open_result(next((tmp_path / "out").glob("one*.h5")))
    np.testing.assert_array_equal(result.height, io.open_result(folder / "res.h5").height)
    again = run(*command, tmp_path / "batch.toml", "--json")
    assert {file["state"] for file in json.loads(again.out)["files"]} == {"kept"}


def test_the_documentation_names_all_that_it_needs():
    page = (Path(__file__).parents[2] / "docs" / "operations.md").read_text(encoding="utf-8")
    for name in re.findall(r"(?:engine|io|self|self\.device)\.(\w+)\(", CODE[CODE.index("class Bright") :]):
        assert name in page, name
