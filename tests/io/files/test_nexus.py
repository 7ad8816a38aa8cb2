"""Two viewers of NeXus files, silx and NeXpy's library, find maps, axes and units in our files."""

import json
import subprocess
import sys
from typing import NamedTuple

import nexusformat.nexus
import numpy as np
import pytest
import silx.io
from calibrations import a_calibration
from growing import Feed, stream
from silx.io.nxdata import get_default
from stacks import MadeUp, random_stack, record

from mirrorskin import io
from mirrorskin.io.files.streaming import GrowingRecording

T, H, W = 6, 5, 7
X, Y = io.pixel_axes((H, W), (0.1, 0.2))
TRAVEL, PHASE = 0.1 * np.arange(T), np.arange(T) * np.pi / 3
SERIES = {
    "vertical": {"travel": TRAVEL},
    "axial": {"phase": PHASE},
    "horizontal": {"displacement": np.stack([TRAVEL, -TRAVEL], axis=1)},
    "twist": {"twist": 0.01 * PHASE},
}
ALONG = {
    "vertical": ("travel", "mm", TRAVEL),
    "axial": ("phase", "rad", PHASE),
    "horizontal": ("frame_time", "s", 0.5 * np.arange(T)),
    "twist": ("twist", "rad", 0.01 * PHASE),
}
OF_A_PRESS = ("height", "height_sigma", "status", "filled")
OF_A_ROTATION = (
    *("height", "height_sigma", "normals", "zenith", "azimuth", "normals_sigma"),
    *("mean", "modulation", "residual", "edges", "contact", "component"),
)
OF_A_WAVE = ("azimuth", "mean", "cosine", "sine", "modulation", "residual")
DTYPES = dict.fromkeys(("status", "filled", "edges", "contact"), np.uint8) | {"component": np.int32}


class Axis(NamedTuple):
    """An axis: its name, unit and values; without a name, where the file tells none."""

    name: str | None
    unit: str | None
    values: list[float] | None


class Plot(NamedTuple):
    """What a viewer plots unasked."""

    signal: str
    unit: str | None
    values: np.ndarray
    axes: list[Axis]
    errors: np.ndarray | None


def seen_by_silx(path):
    with silx.io.open(str(path)) as file:
        data = get_default(file)
        assert data.is_image or data.is_stack
        axes = [
            Axis(None, None, None)
            if axis is None
            else Axis(axis.name.rsplit("/", 1)[-1], axis.attrs.get("units"), axis[()].tolist())
            for axis in data.axes
        ]
        errors = None if data.errors is None else data.errors[()]
        name = data.signal.name.rsplit("/", 1)[-1]
        return Plot(name, data.signal.attrs.get("units"), data.signal[()], axes, errors)


def seen_by_nexpy(path):
    data = nexusformat.nexus.nxload(str(path)).get_default()
    assert data.plottable_data is data
    axes = [
        Axis(None, None, None)
        if axis.nxname.startswith("Axis")
        else Axis(axis.nxname, axis.attrs.get("units"), axis.nxdata.tolist())
        for axis in data.nxaxes
    ]
    errors = None if data.nxerrors is None else data.nxerrors.nxdata
    signal = data.nxsignal
    return Plot(signal.nxname, signal.attrs.get("units"), signal.nxdata, axes, errors)


@pytest.fixture(params=[seen_by_silx, seen_by_nexpy], ids=["silx", "nexpy"])
def plot_of(request):
    return request.param


def header(motion):
    return io.Header(motion, title="a coin", pixel_size=(0.1, 0.2), press=1.0, tilt=0.04)


def assert_shows(plot, signal, unit, values, axes):
    """Hold a plot to be that of a signal along axes, each of a name, a unit and values, or of none."""
    assert (plot.signal, plot.unit) == (signal, unit)
    np.testing.assert_array_equal(plot.values, values)
    assert [axis[:2] for axis in plot.axes] == [axis[:2] for axis in axes]
    for axis, (_, _, expected) in zip(plot.axes, axes, strict=True):
        assert expected is None or axis.values == pytest.approx(list(expected))


NONE = (None, None, None)


@pytest.mark.parametrize("motion", SERIES)
def test_a_recording_is_shown_along_where_the_body_was(plot_of, motion, tmp_path):
    frames = random_stack("uint16", (T, H, W))
    record(MadeUp(frames, header(motion), **SERIES[motion], time=0.5 * np.arange(T)), tmp_path / "rec.h5")
    assert_shows(plot_of(tmp_path / "rec.h5"), "frames", "counts", frames, [ALONG[motion], NONE, NONE])


@pytest.mark.parametrize("packing", ["raw", "bitshuffle"])
def test_a_recording_of_a_live_run_is_shown_once_it_is_complete(plot_of, packing, tmp_path):
    frames = np.concatenate([block.frames for block in stream(Feed(T), tmp_path / "rec.h5", packing)])
    travel = ("travel", "mm", 0.01 * np.arange(T) + 0.001)
    assert_shows(plot_of(tmp_path / "rec.h5"), "frames", "counts", frames, [travel, NONE, NONE])


SHOWN = """
import json, sys, silx.io
from silx.io.nxdata import get_default
with silx.io.open(sys.argv[1]) as file:
    data = get_default(file)
    frames, travel = data.signal, data.axes[0]
    print(json.dumps([frames.shape, frames.attrs["units"], travel[()].tolist(), travel.attrs["units"]]))
"""


def test_an_unfinished_recording_is_shown_as_far_as_it_is_written(tmp_path):
    path, frames = tmp_path / "rec.h5", random_stack("uint8", (T, H, W))
    expected = header("vertical"), frames.shape, frames.dtype, "raw", None, ()
    with path.open("wb") as place, GrowingRecording(path, place.fileno(), *expected) as recording:
        recording.append(io.Block(frames[:4], 0, time=TRAVEL[:4], travel=TRAVEL[:4]))
        recording.publish()
        words = [sys.executable, "-c", SHOWN, str(path)]
        ended = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == [[4, H, W], "counts", pytest.approx(TRAVEL[:4]), "mm"]


def made_up(*names, turns=()):
    """Return a result of some maps of any values."""
    generator = np.random.default_rng(0)
    maps = {
        name: generator.uniform(0, 2, (*turns, H, W, *([3] if name == "normals" else []))).astype(
            DTYPES.get(name, np.float32)
        )
        for name in names
    }
    if "component" in maps:
        maps["component"][...] = 0
        maps["offset_unknown"] = np.ones(1, np.uint8)
    if "height" in maps:
        maps["height"][..., 0, 0] = np.nan
    return io.Result(**maps, x=X, y=Y, process={"program": "mirrorskin"})


PLACES = [("y", "mm", Y), ("x", "mm", X)]


@pytest.mark.parametrize("maps", [OF_A_PRESS, OF_A_ROTATION, (*OF_A_ROTATION, "filled", "status")])
def test_heights_are_shown_in_millimetres_over_millimetres_and_with_their_errors(plot_of, maps, tmp_path):
    result = made_up(*maps)
    io.save_result(result, tmp_path / "res.h5")
    plot = plot_of(tmp_path / "res.h5")
    assert_shows(plot, "height", "mm", result.height, PLACES)
    np.testing.assert_array_equal(plot.errors, result.height_sigma)


def test_each_turn_is_a_picture_of_a_stack(plot_of, tmp_path):
    result = made_up(*OF_A_ROTATION, turns=(3,))
    io.save_result(result, tmp_path / "res.h5")
    turns = ("turn", None, range(3))
    assert_shows(plot_of(tmp_path / "res.h5"), "height", "mm", result.height, [turns, *PLACES])


@pytest.mark.parametrize(
    ("parts", "signal", "unit"),
    [(("references", "zenith"), "bright", "counts"), (("zenith",), "zenith_sigma", "rad")],
)
def test_a_calibration_is_shown_by_its_first_map(plot_of, parts, signal, unit, tmp_path):
    expected = a_calibration((H, W), only=parts)
    io.save_calibration(expected, tmp_path / "cal.h5")
    part = expected.references if "references" in parts else expected.zenith
    assert_shows(plot_of(tmp_path / "cal.h5"), signal, unit, getattr(part, signal), [NONE, NONE])


def test_every_map_of_a_result_has_its_unit(tmp_path):
    io.save_result(made_up(*OF_A_ROTATION, "cosine", "sine"), tmp_path / "res.h5")
    with silx.io.open(str(tmp_path / "res.h5")) as file:
        units = {name: file["entry/result"][name].attrs.get("units") for name in file["entry/result"]}
    millimetres, radians = (
        ("height", "height_sigma", "height_errors", "x", "y"),
        ("zenith", "azimuth", "normals_sigma"),
    )
    counts, bare = (
        ("mean", "cosine", "sine", "modulation", "residual"),
        ("normals", "edges", "contact", "component"),
    )
    expected = (
        dict.fromkeys(millimetres, "mm") | dict.fromkeys(radians, "rad") | dict.fromkeys(counts, "counts")
    )
    assert units == expected | dict.fromkeys((*bare, "offset_unknown"))
