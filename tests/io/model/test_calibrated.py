"""A source with a calibration: its header and phases, and refused calibrations."""

from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from calibrations import a_calibration, a_lens, a_map, a_precession, assert_same
from growing import Feed, frames_of
from stacks import SHAPE, MadeUp, random_stack, read_all, record

from mirrorskin import io

PICTURE = SHAPE[1:]
PHASE = np.linspace(0.1, 7.0, 8)
OWN = io.Header(
    "axial",
    title="mine",
    pixel_size=(0.1, 0.2),
    dark=a_map(20),
    bright=a_map(21),
    press=1.0,
    tilt=0.042,
    pivot=(1.0, 2.0, 3.0),
    zenith_gain=np.asarray(50.0),
    camera="left",
)


def a_source(dtype="uint8", **changes):
    return MadeUp(random_stack(dtype), replace(OWN, **changes), phase=PHASE)


def calibrated(only=None, source=None, **options):
    return io.Calibrated(source or a_source(), a_calibration(only=only, **options))


def differing(header, reference=OWN):
    """Name what two headers say differently; equal maps are the same object."""
    names = [field.name for field in fields(reference)]
    return {name for name in names if getattr(header, name) is not getattr(reference, name)}


RESPONSE = {"zenith_gain", "zenith_offset", "gamma"}
RESPONSE |= {f"{name}_sigma" for name in RESPONSE}


@pytest.mark.parametrize(
    ("only", "changed"),
    [
        ([], set()),
        (["references"], {"dark", "bright"}),
        (["precession"], {"tilt", "pivot"}),
        (["response"], RESPONSE),
        (None, {"dark", "bright", "pixel_size", "tilt", "pivot", *RESPONSE}),
    ],
)
def test_each_part_replaces_its_values_and_the_rest_is_the_source_s(only, changed):
    with_calibration = calibrated(only)
    header, calibration = with_calibration.header, with_calibration.calibration
    assert differing(header) == changed
    response = calibration.response
    stated = {
        "zenith_gain": lambda: response.gain,
        "zenith_offset": lambda: response.offset,
        "gamma": lambda: response.gamma,
        "zenith_gain_sigma": lambda: response.sigma["gain"] / float(np.median(response.gain)),
        "zenith_offset_sigma": lambda: response.sigma["offset"],
        "gamma_sigma": lambda: response.sigma["gamma"],
        "dark": lambda: calibration.references.dark,
        "bright": lambda: calibration.references.bright,
        "pixel_size": lambda: calibration.lens.pixel_size,
        "tilt": lambda: calibration.precession.tilt,
        "pivot": lambda: calibration.precession.pivot,
    }
    for name in changed:
        np.testing.assert_array_equal(getattr(header, name), stated[name]())
    assert (with_calibration.whole, with_calibration.calibration) == (calibration, calibration)


@pytest.mark.parametrize("name", ["bright", "zenith_gain", "zenith_offset"])
def test_levels_follow_the_exposure_about_the_dark_level(name):
    whole, half = (calibrated(source=a_source(exposure_ratio=ratio)).header for ratio in (1.0, 0.5))
    dark = 0.0 if name == "zenith_gain" else whole.dark
    np.testing.assert_allclose(getattr(half, name), dark + (getattr(whole, name) - dark) / 2, rtol=1e-5)


def test_levels_of_the_recording_are_those_of_its_exposure():
    assert differing(calibrated([], a_source(exposure_ratio=0.5)).header) == {"exposure_ratio"}


@pytest.mark.parametrize(
    ("actual", "of_source", "message"),
    [
        ((0.5, -0.5, np.nan), (1.0, 2.0, 3.0), (0.5, -0.5, 3.0)),
        ((0.5, -0.5, 9.0), None, (0.5, -0.5, 9.0)),
        ((0.5, -0.5, np.nan), None, None),
    ],
)
def test_what_was_not_found_of_the_pivot_is_the_source_s(actual, of_source, message):
    calibration = replace(a_calibration(only=[]), precession=a_precession(pivot=actual))
    assert io.Calibrated(a_source(pivot=of_source), calibration).header.pivot == message


def test_phases_are_those_of_the_precession_however_blocks_are_cut():
    actual = read_all(calibrated(["precession"]), 3)
    np.testing.assert_array_equal(actual.phase, a_precession().phase(PHASE))
    np.testing.assert_array_equal(actual.frames, random_stack())
    np.testing.assert_array_equal(read_all(calibrated(["references"]), 3).phase, PHASE)


def test_frames_are_the_source_s_own_and_stay_lent():
    feed = Feed(8, (3,), "axial")
    handed = []
    read = feed.read
    feed.read = lambda out=None: handed.append(read(out)) or handed[-1]
    source = calibrated(["references", "precession"], feed)
    while (block := source.read()) is not None:
        assert block.frames is handed[-1].frames
        assert block.stays_valid
        assert block.dropped == handed[-1].dropped
        np.testing.assert_array_equal(block.phase, a_precession().phase(handed[-1].phase))
    assert handed[-1] is None
    assert len(handed) == 4


def test_a_live_source_is_left_alone_until_its_header_is_asked_for():
    class Live(Feed):
        asked = 0

        @property
        def header(self):
            Live.asked += 1
            return io.Header("axial", tilt=0.04, camera="right")

        @header.setter
        def header(self, value):
            pass

    live = Live(8, motion="axial")
    source = calibrated(None, live)
    assert source.read() is not None
    assert Live.asked == 0
    with pytest.raises(io.InputError, match="the camera 'left', feed of 'right'"):
        _ = source.header


def test_a_live_source_reports_time_and_corrected_positions_and_can_be_left():
    feed = Feed(8, (3,), "axial")
    with calibrated(["precession"], feed) as source:
        while source.read() is not None:
            pass
        assert source.now() == feed.now()
        live, positions = feed.positions()["phase"], source.positions()
    np.testing.assert_array_equal(positions["phase"], a_precession().phase(live))
    assert list(positions) == ["phase"]
    assert feed.left


# Parts of the picture.


def test_a_part_of_the_picture_has_its_part_of_every_map(tmp_path):
    path = record(a_source(), tmp_path / "turn.h5")
    region = io.Region((1, 4), (2, 7))
    whole = a_calibration()
    with io.open_recording(path, region=region) as recording:
        source = io.Calibrated(recording, whole)
        part = source.calibration
        np.testing.assert_array_equal(source.header.dark, whole.references.dark[1:4, 2:7])
    np.testing.assert_array_equal(part.references.defects, whole.references.defects[1:4, 2:7])
    np.testing.assert_array_equal(part.zenith.azimuth_sigma, whole.zenith.azimuth_sigma[1:4, 2:7])
    assert part.zenith.zenith_sigma.flags.c_contiguous
    assert part.camera.shape == (3, 5)
    assert source.whole is whole


@pytest.mark.parametrize(("lens", "pixel"), [(None, (0.1, 0.2)), (a_lens(), (0.5, 0.6))])
def test_places_are_relative_to_the_centre_of_a_part(tmp_path, lens, pixel):
    """The same point of the sheet is the same pixel, of the whole picture and of a part."""
    path = record(a_source(), tmp_path / "turn.h5")
    region = io.Region((1, 4), (2, 7))
    whole = replace(a_calibration(), lens=lens)
    with io.open_recording(path, region=region) as recording:
        part = io.Calibrated(recording, whole).calibration
    (x, y), (part_x, part_y) = (io.pixel_axes(shape, pixel) for shape in (PICTURE, (3, 5)))
    for target, here in (
        (whole.zenith.axis, part.zenith.axis),
        (whole.precession.pivot, part.precession.pivot),
        (whole.gel.axis, part.gel.axis),
    ):
        assert here[0] - part_x[0] == pytest.approx(target[0] - x[2])
        assert here[1] - part_y[0] == pytest.approx(target[1] - y[1])
        assert here[2:] == target[2:]


# What is refused.


@pytest.mark.parametrize(
    ("expected", "message"),
    [
        ({"name": "right"}, "the camera 'right', made up of 'left': calibrate again"),
        ({"dtype": "uint16"}, "uint16 samples, made up of uint8: calibrate again"),
        (
            {"name": "b", "shape": (1, 1)},
            "the camera 'b' and 1 x 1 pixels, made up of 'left' and 7 x 5: calibrate again",
        ),
    ],
)
def test_the_calibration_of_another_camera_is_refused_in_a_line(expected, message):
    calibration = replace(a_calibration(**expected), name="cal.h5")
    with pytest.raises(io.InputError, match=rf"^cal\.h5 is of {message}") as caught:
        io.Calibrated(a_source(), calibration)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("tilt", "fits"), [(0.033, True), (0.049, True), (0.031, False), (0.051, False)])
def test_a_rotation_by_another_tilt_is_refused(tilt, fits):
    source = a_source(tilt=tilt)
    if fits:
        assert calibrated(["precession"], source).header.tilt == 0.04
        return
    with pytest.raises(
        io.InputError, match=r"for a tilt of 2.29 deg, but that of made up is .* calibrate the tilt again"
    ):
        calibrated(["precession"], source)


# What carries a copy.


def test_a_recording_contains_a_copy_and_the_header_of_the_source(tmp_path):
    path = tmp_path / "turn.h5"
    source, calibration = a_source(), a_calibration()
    with io.Recorder(source, path, calibration=calibration) as recorder:
        while recorder.read(np.empty((3, *PICTURE), np.uint8)) is not None:
            pass
    with io.open_recording(path) as recording:
        assert_same(recording.carried, calibration)
        assert recording.carried.name == f"the calibration in {path}"
        np.testing.assert_array_equal(recording.phase, PHASE)
        np.testing.assert_array_equal(recording.header.dark, OWN.dark)
        assert recording.header.tilt == OWN.tilt
    assert io.describe(path)["carried calibration"] == (
        "references, scale, zenith, tilt, elastic, force, self of camera 'left', 7 x 5, uint8"
    )
    assert io.describe(path)["camera"] == "left"
    assert_same(io.open_calibration(path), calibration)


@pytest.mark.parametrize("compression", ["raw", "lzf"])
def test_a_recording_that_is_written_while_frames_come_carries_a_copy(tmp_path, compression):
    path = tmp_path / "live.h5"
    feed = Feed(20, (3,), "axial")
    recorder = io.StreamRecorder(feed, path, compression, calibration=a_calibration())
    with recorder:
        while recorder.read() is not None:
            pass
    with io.open_recording(path) as recording:
        assert_same(recording.carried, a_calibration())
        assert recording.state == "complete"
        assert recording.how.startswith("chunks read") == (compression == "raw")
        np.testing.assert_array_equal(read_all(recording, 7).frames, frames_of(np.arange(20)))
        np.testing.assert_array_equal(recording.phase, feed.positions()["phase"])


def test_a_result_carries_a_copy_also_where_its_form_was_written_before(tmp_path):
    height = np.zeros(PICTURE, np.float32)
    for number, calibration in enumerate((a_calibration(), a_calibration(name="east", dtype="uint16"), None)):
        path = tmp_path / f"result-{number}.h5"
        for _ in range(2):
            result = io.Result(height=height, process={"hold": 2}, calibration=calibration)
            io.save_result(result, path, overwrite=True)
        actual = io.open_result(path)
        assert actual.process == {"hold": 2}
        assert list(actual.maps()) == ["height"]
        if calibration is None:
            assert actual.calibration is None
            assert "carried calibration" not in io.describe(path)
        else:
            assert_same(actual.calibration, calibration)
            assert_same(io.open_calibration(path), calibration)
            assert io.describe(path)["carried calibration"].startswith("references, scale")


def test_a_damaged_copy_is_reported_only_when_it_is_read(tmp_path):
    path = tmp_path / "turn.h5"
    with io.Recorder(a_source(), path, calibration=a_calibration()) as recorder:
        recorder.drain(lambda count: None)
    with h5py.File(path, "r+") as file:
        file["entry/calibration"].attrs["mirrorskin_calibration"] = 7
    with io.open_recording(path) as recording:
        assert recording.shape == SHAPE
        with pytest.raises(io.InputError, match="newer layout, 7"):
            _ = recording.carried
