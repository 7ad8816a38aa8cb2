"""Warnings compose: the output of each function that takes a result contains the warnings of that result."""

import zipfile

import numpy as np
import pytest

from mirrorskin import engine, io
from mirrorskin.engine.base.undistort import undistort
from mirrorskin.evaluation.scenes import rotations
from mirrorskin.evaluation.scenes.rotations import EIGHTHS, TILT
from mirrorskin.io.formats.registry import export_suffixes
from mirrorskin.view.report import write_report

LOST, FLICKER = "3 frames were lost", "the light flickers by 5 %"
PIXEL, SHAPE = 0.1, (32, 40)
X, Y = np.meshgrid(*io.pixel_axes(SHAPE, (PIXEL, PIXEL)))


def touch(warning=LOST, at=0.0):
    """Return heights and normals of a wavy surface, with a warning in their process."""
    slopes = 0.3 * np.cos(X - at) * np.cos(Y), -0.3 * np.sin(X - at) * np.sin(Y)
    normals = np.stack([-slopes[0], -slopes[1], np.ones(SHAPE)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    height = (0.3 * np.sin(X - at) * np.cos(Y) - 0.5).astype(np.float32)
    return io.Result(
        height=height,
        height_sigma=np.full(SHAPE, 0.01, np.float32),
        normals=normals.astype(np.float32),
        normals_sigma=np.full(SHAPE, 0.01, np.float32),
        x=X[0],
        y=Y[:, 0],
        process={"warnings": warning, "source": "a.h5"},
    )


def phases():
    shape = {"phase": X % 6, "phase_sigma": np.full(SHAPE, 0.1)}
    return io.Result(shape, process={"warnings": LOST})


def stripes():
    shape = {"stripe": np.floor(X / np.pi), "risk": np.zeros(SHAPE)}
    return io.Result(shape, process={"warnings": FLICKER})


def displacement():
    moved = np.broadcast_to(np.float32([0.1, 0.0]), (*SHAPE, 2))
    return io.Result(displacement=moved, contact=np.ones(SHAPE, np.uint8), process={"warnings": LOST})


def tracked():
    tracker = engine.pose.PoseTracker(PIXEL)
    tracker.push(touch())
    return tracker.push(touch(FLICKER, 0.1)).notes


BOTH = "heights: 3 frames were lost; normals: the light flickers by 5 %"
CONSUMERS = {
    "fuse": (lambda: engine.fuse(touch(), touch(FLICKER)).process["warnings"], BOTH),
    "measure": (lambda: engine.measure(touch()).notes[0], f"result: {LOST}"),
    "section": (lambda: engine.metrology.section(touch()).notes, (f"result: {LOST}",)),
    "estimate_pose": (
        lambda: engine.pose.estimate_pose(touch(), touch(FLICKER)).notes,
        (f"first: {LOST}", f"second: {FLICKER}"),
    ),
    "PoseTracker": (tracked, (f"result 0: {LOST}", f"result 1: {FLICKER}")),
    "stitch": (
        lambda: engine.pose.stitch([touch(), touch(FLICKER, 0.2)]).result.process["warnings"],
        f"result 0: {LOST}; result 1: {FLICKER}",
    ),
    "find_force": (
        lambda: engine.force.find_force(touch(), 0.5, PIXEL, modulus=0.1).process["warnings"],
        f"height: {LOST}",
    ),
    "ForceTracker": (
        lambda: engine.force.ForceTracker(PIXEL, 0.1, binning=1).push(touch(), -9.0).process["warnings"],
        f"result: {LOST}",
    ),
    "find_tangential_force": (
        lambda: engine.force.find_tangential_force(displacement(), PIXEL, 0.1).process["warnings"],
        f"displacement: {LOST}",
    ),
    "unwrap_frequencies": (
        lambda: engine.optical.unwrap_frequencies([phases(), phases()], [1, 4]).process["warnings"],
        f"fringes[0]: {LOST}; fringes[1]: {LOST}",
    ),
    "unwrap_gray": (
        lambda: engine.optical.unwrap_gray(phases(), stripes()).process["warnings"],
        f"fringes: {LOST}; stripes: {FLICKER}",
    ),
    "assign": (lambda: touch().assign(zenith=X).process["warnings"], LOST),
    "assign a result": (lambda: touch().assign(touch(FLICKER)).process["warnings"], f"{LOST}; {FLICKER}"),
    "assign the same result": (lambda: touch().assign(touch()).process["warnings"], LOST),
    "to_xarray": (lambda: io.Result.from_xarray(touch().to_xarray()).process["warnings"], LOST),
}


@pytest.mark.parametrize("name", CONSUMERS)
def test_output_contains_the_warnings_of_each_input_once(name):
    output, expected = CONSUMERS[name]
    assert output() == expected


def test_score_contains_the_warnings_of_its_result():
    flat = np.zeros(SHAPE, np.float32)
    truth = io.Truth(flat, flat, flat, np.ones(SHAPE, np.uint8))
    assert engine.score(touch(), truth).notes == (f"result: {LOST}",)


def test_notes_are_carried_as_notes():
    noted = touch().assign(process={"notes": "slopes scatter"})
    assert engine.fuse(noted, touch(FLICKER)).process["notes"] == "heights: slopes scatter"


def test_warnings_of_fused_results_are_carried_further():
    fused = engine.fuse(touch(), touch(FLICKER)).assign(normals=touch().normals)
    notes = engine.measure(fused).notes
    assert notes[0] == f"result: {BOTH}"


@pytest.mark.parametrize("kind", ["h5", "zarr"])
def test_files_contain_the_warnings_of_their_result(tmp_path, kind):
    io.save_result(touch(), tmp_path / f"touch.{kind}")
    assert io.open_result(tmp_path / f"touch.{kind}").process["warnings"] == LOST


def test_paths_are_named_where_their_warnings_are_carried(tmp_path):
    for name, result in (("a.h5", touch()), ("b.h5", touch(FLICKER, 0.2))):
        io.save_result(result, tmp_path / name)
    stitched = engine.pose.stitch([tmp_path / "a.h5", tmp_path / "b.h5"])
    assert f"{tmp_path / 'a.h5'}: {LOST}" in stitched.result.process["warnings"]


TEXTS = [
    suffix for suffix in export_suffixes() if suffix not in (".stl", ".zarr")
]  # STL has room for 80 letters only


@pytest.mark.parametrize("suffix", TEXTS)
def test_exports_contain_the_warnings_of_their_result(tmp_path, suffix):
    path = tmp_path / f"touch{suffix}"
    io.export_result(touch(), path)
    data = path.read_bytes()
    if suffix in (".npz", ".x3p"):
        with zipfile.ZipFile(path) as archive:
            data = b"".join(archive.read(name) for name in archive.namelist())
    assert data.replace(b"\0", b"").count(LOST.encode()) == 1


def test_a_report_contains_the_warnings_of_its_result(tmp_path):
    write_report(touch(), tmp_path / "touch.html", name="touch")
    assert (tmp_path / "touch.html").read_text().count(LOST) >= 1


def turned():
    """Return a rotation on the same surface, in an array."""
    normals = touch().normals.astype(float)
    setup = rotations.Setup()
    header = {"pixel_size": PIXEL, "tilt": TILT, "press": 0.5, "pivot": (0.0, 0.0, 0.0)}
    header |= {"zenith_gain": setup.slope, "zenith_offset": setup.offset}
    return io.ArrayRecording(rotations.expose(normals, setup, 1), {"phase": np.array(EIGHTHS)}, header)


@pytest.mark.parametrize("kind", ["result", "path"])
def test_a_rotation_contains_the_warnings_of_the_heights_it_is_registered_with(tmp_path, kind):
    heights = touch().assign(normals=None, normals_sigma=None)
    if kind == "path":
        io.save_result(heights, tmp_path / "heights.h5")
        heights = tmp_path / "heights.h5"
    with pytest.warns(io.MirrorskinWarning, match=f"heights: {LOST}"):
        result = engine.reconstruct(turned(), heights=heights)
    assert result.process["warnings"] == f"heights: {LOST}"


def test_a_slide_contains_the_warnings_of_its_contact():
    texture = np.random.default_rng(1).normal(100, 20, (60, 80))
    frames = np.stack([np.roll(texture, -k, axis=1) for k in range(4)]).astype(np.float32)
    contact = io.Result(contact=np.ones((60, 80), np.uint8), process={"warnings": LOST})
    path = np.outer(range(4), [0.1, 0.0])
    with pytest.warns(io.MirrorskinWarning, match=f"contact: {LOST}"):
        result = engine.reconstruct(frames, displacement=path, pixel_size=0.1, contact=contact, noise=0.1)
    assert result.process["warnings"].count(LOST) == 1


def test_undistorted_maps_keep_the_warnings_of_their_result():
    lens = io.Lens((PIXEL, PIXEL), np.eye(3), np.zeros(5), np.eye(3), SHAPE, 0.0)
    assert undistort(touch(), lens).process["warnings"] == LOST


class Suspicious(engine.Operation):
    """An operation of a user, whose result has a warning."""

    def start(self, shape, dtype):
        self.total = np.zeros(shape)

    def push(self, frames):
        self.total += frames.sum(axis=0)

    def result(self):
        return {"total": self.total, "warnings": LOST}


def test_warnings_of_an_own_operation_are_issued_and_in_the_process():
    with pytest.warns(io.MirrorskinWarning, match=f"^Suspicious: {LOST}$"):
        result = engine.run(np.ones((4, 3, 3)), Suspicious)
    assert result.process["warnings"] == LOST


SHIFTS = {"12 bits": 0, "12 in the upper bits": 4}


@pytest.mark.parametrize("shift", SHIFTS.values(), ids=SHIFTS)
def test_saturation_is_reported_through_every_door(shift, tmp_path):
    travel = 0.05 * np.arange(30)
    above = (travel[:, np.newaxis, np.newaxis] - 0.3 - (X**2 + Y**2) / 8) / 0.08
    light = 200 + 6500 / (1 + np.exp(-above))
    frames = np.clip(light, 0, 4095).astype(np.uint16) << shift
    np.save(tmp_path / "press.npy", frames)
    opening = {"motion": "vertical", "travel": io.Steps(0.05), "pixel_size": (PIXEL, PIXEL)}
    text = f"of the pixels reach the end of the scale, {4095 << shift}: shorten the exposure"
    with pytest.warns(io.MirrorskinWarning, match=text):
        engine.find_onset(frames, travel)
    assert [finding.kind for finding in io.check(tmp_path / "press.npy", **opening).findings] == ["cut off"]
    with (
        io.open_recording(tmp_path / "press.npy", **opening) as source,
        pytest.warns(io.MirrorskinWarning, match=text),
    ):
        assert text in engine.reconstruct(source).process["warnings"]
    run = engine.Run(engine.press.Onset())
    for frame, position in zip(frames, travel, strict=True):
        run.push(frame[np.newaxis], travel=[position])
    assert text in run.result(ended=True).process["warnings"]
