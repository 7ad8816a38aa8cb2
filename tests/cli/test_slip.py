"""Slides and twists on the command line: simulated, reconstructed, scored and displayed."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest
from commands import done, refused, run

from mirrorskin import engine, io

SCENE = "--contact elastic --texture flakes --size 64x64 --pixel-size 0.05mm --press 0.5mm --friction 0.6"


def simulate(motion, folder, *more):
    path = folder / f"{motion}.h5"
    assert run("simulate", motion, *SCENE.split(), *more, "-o", path).code == 0
    return path


@pytest.fixture(scope="module")
def slide(tmp_path_factory):
    folder = tmp_path_factory.mktemp("slide")
    return simulate("horizontal", folder, "--frames", 12, "--displacement-step", "0.02mm,0mm")


@pytest.fixture(scope="module")
def contact(slide):
    """A result that tells where the skin touches, from the simulation."""
    with io.open_recording(slide) as recording:
        touched = recording.truth.contact
    path = slide.with_name("press-result.h5")
    io.save_result(io.Result(contact=touched), path)
    return path


@pytest.fixture(scope="module")
def slide_result(slide, contact):
    ended = run("reconstruct", slide, "--contact", contact, "--per-frame", "-o", slide.with_name("found.h5"))
    assert (ended.code, ended.said) == (0, "")
    assert "slip onset at " in ended.out
    assert " slipped, " in ended.out
    return io.open_result(slide.with_name("found.h5"))


def test_a_slide_is_reported_as_found_in_its_frames(slide, contact, slide_result):
    touched = io.open_result(contact).contact
    with io.open_recording(slide) as recording:
        expected = engine.run(recording, engine.slip.SlipOnset(contact=touched, per_frame=True))
    for name in ("displacement", "displacement_sigma", "slip_onset", "slip_onset_sigma", "status", "contact"):
        np.testing.assert_array_equal(getattr(slide_result, name), getattr(expected, name), err_msg=name)
    np.testing.assert_allclose(slide_result.slide_distance, np.arange(12) * 0.02, atol=1e-12)
    np.testing.assert_array_equal(slide_result.stick_ratio, expected.stick_ratio)


def test_a_slide_agrees_with_the_truth(slide, slide_result):
    with io.open_recording(slide) as recording:
        score = engine.score(slide_result, recording.truth).slip
    assert score.coverage > 0.9
    assert score.recall > 0.9
    assert score.precision > 0.9
    assert score.onset_rms < 0.03
    assert score.displacement_rms < 0.01
    ended = run("score", slide.with_name("found.h5"), "--truth", slide, "--json")
    assert json.loads(ended.out)["slip"]["unit"] == "mm"


@pytest.mark.parametrize(("motion", "words"), [("horizontal", "--friction 0.5"), ("twist", "--friction 0.8")])
def test_skin_at_coarse_pixels_is_not_reported_to_slip_too_early(motion, words, tmp_path):
    path = tmp_path / "coarse.h5"
    scene = SCENE.replace("64x64", "96x96").replace("--friction 0.6", words).split()
    assert run("simulate", motion, *scene, "-o", path).code == 0
    with io.open_recording(path) as recording:
        truth = recording.truth
        coarse = engine.reconstruct(recording, contact=truth.contact)
    slipped = np.isfinite(truth.slip_onset).astype(np.uint8)
    around = np.ones((3, 3), np.uint8)
    inside = cv2.dilate(slipped, around) == cv2.erode(slipped, around)
    slipping, decided = (coarse.status == 1) & inside, np.isin(coarse.status, (1, 2)) & inside
    assert np.mean(slipped[slipping]) > 0.98
    assert np.mean(slipping[decided & (slipped != 0)]) > 0.98


def test_slip_in_the_first_frames_is_scored_by_the_truth_of_these(slide, contact, slide_result, tmp_path):
    target = tmp_path / "part.h5"
    assert run("reconstruct", slide, "--frames", "0:10", "--contact", contact, "-o", target).code == 0
    ended = run("score", target, "--truth", slide, "--json")
    assert (ended.code, ended.said) == (0, "")
    slip = json.loads(ended.out)["slip"]
    assert slip["recall"] > 0.9
    assert slip["precision"] > 0.9
    assert slip["displacement_rms"] < 0.01
    # Cattaneo and Mindlin: less sticks at the end of the slide than on the way.
    with io.open_recording(slide) as recording:
        whole = engine.score(slide_result, recording.truth).slip
    assert slip["true_stick_radius"] > whole.true_stick_radius + 0.03


def test_slip_that_begins_later_than_the_truth_is_left_out_with_the_reason(slide, contact, tmp_path):
    target = tmp_path / "part.h5"
    assert run("reconstruct", slide, "--frames", "3:12", "--contact", contact, "-o", target).code == 0
    ended = run("score", target, "--truth", slide, "--json")
    assert (ended.code, ended.said.count("\n")) == (0, 1)
    assert "slip is left out: the result is of 9 frames (3:12)" in ended.said
    assert "slip" not in json.loads(ended.out)


def stuck_within(radius, truth):
    """Return a result of slip that says so much of the contact's radius sticks, and nothing else."""
    x, y = np.meshgrid(*2 * [np.arange(64) - 31.5])
    touched = truth.contact != 0
    slipped = touched & (np.hypot(x, y) > radius * np.sqrt(touched.sum() / np.pi))
    return io.Result(
        displacement=truth.displacement[-1],
        slip_onset=np.where(slipped, 0.0, np.nan).astype(np.float32),
        status=np.where(touched, np.where(slipped, 1, 2), 3).astype(np.uint8),
        slide_distance=np.arange(12) * 0.02,
    )


def test_a_score_prints_the_true_and_found_radius_of_sticking(slide):
    with io.open_recording(slide) as recording:
        truth = recording.truth
    score = engine.score(stuck_within(0.7, truth), truth)
    assert score.slip.stick_radius == pytest.approx(0.7, abs=0.03)
    touched = truth.contact != 0
    sticks = touched & ~np.isfinite(truth.slip_onset)
    assert score.slip.true_stick_radius == pytest.approx(math.sqrt(sticks.sum() / touched.sum()))
    error = 100 * (score.slip.stick_radius / score.slip.true_stick_radius - 1)
    assert score.table()["slip stick radius"].endswith(f"({error:+.1f} %)")


def test_slip_without_a_truth_of_it_is_left_out_or_refused_where_there_is_nothing_else(slide, slide_result):
    with io.open_recording(slide) as recording:
        truth = recording.truth
    bare = io.Truth(truth.height, truth.zenith, truth.azimuth, truth.contact)
    score = engine.score(slide_result, bare)
    assert score.slip is None
    assert "the truth has none" in score.slip_left_out
    with pytest.raises(io.InputError, match="the truth has none"):
        engine.score(stuck_within(0.5, truth), bare)


def test_only_the_last_displacement_is_reported_unless_all_are_wanted(slide, contact, slide_result):
    target = slide.with_name("last.h5")
    assert run("reconstruct", slide, "--contact", contact, "-o", target).code == 0
    np.testing.assert_array_equal(io.open_result(target).displacement, slide_result.displacement[-1])


def test_a_part_of_a_twist_turns_about_the_whole_pictures_centre(tmp_path):
    path = simulate("twist", tmp_path, "--frames", 6, "--twist-step", "0.5deg", "--friction", "5")
    with io.open_recording(path, region=io.Region.read("8,4,52x56")) as recording:
        io.save_result(io.Result(contact=recording.truth.contact), tmp_path / "press.h5")
    words = "--region", "8,4,52x56", "--contact", tmp_path / "press.h5", "-o", tmp_path / "found.h5"
    assert run("reconstruct", path, *words).code == 0
    result = io.open_result(tmp_path / "found.h5")
    assert result.process["angle"] == pytest.approx(-math.radians(2.5), rel=0.05)
    assert (result.process["centre_x"], result.process["centre_y"]) == pytest.approx((0, 0), abs=0.06)
    assert result.to_xarray()["twist_angle"].attrs["units"] == "rad"
    assert result.twist_angle[-1] == pytest.approx(math.radians(2.5))


def test_pictures_and_tables_know_slip(slide, slide_result, tmp_path):
    result = slide.with_name("found.h5")
    assert run("view", result, "-o", tmp_path / "pictures").code == 0
    assert {path.stem for path in (tmp_path / "pictures").iterdir()} == {
        "status",
        "displacement",
        "slip_onset",
    }
    assert run("report", result, "-o", tmp_path / "page.html").code == 0
    assert run("export", result, "-o", tmp_path / "maps.npz").code == 0
    with np.load(tmp_path / "maps.npz") as arrays:
        assert json.loads(str(arrays["units"]))["slip_onset"] == "mm"
        np.testing.assert_array_equal(arrays["stick_ratio"], slide_result.stick_ratio)
    described = slide_result.to_xarray()
    assert described["displacement"].dims == ("frame", "y", "x", "direction")


def test_a_batch_takes_slides(slide, tmp_path):
    (tmp_path / "batch.toml").write_text("[slip]\nper-frame = true\n")
    assert run("batch", slide, "-o", tmp_path, "--settings", tmp_path / "batch.toml").code == 0
    assert io.open_result(tmp_path / "horizontal-result.h5").displacement.shape == (12, 64, 64, 2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--hold", 3], "--hold applies to presses only; "),
        (["--method", "paper"], "--method applies to presses and rotations only; "),
        (["--window-size", 200], "window_size"),
        (["--frames", "0:2"], "at least 3"),
    ],
)
def test_what_contains_nothing_about_a_slide_is_refused_in_a_line(slide, words, message):
    refused(message, "reconstruct", slide, *words)


def test_a_contact_that_is_only_estimated_is_reported(slide, tmp_path):
    ended = done("reconstruct", slide, "-o", tmp_path / "found.h5")
    assert "contact is estimated" in ended.said
    assert "--contact" in ended.said


def test_a_contact_by_the_light_of_a_press_is_reported(slide, tmp_path):
    height = np.full((64, 64), np.nan, np.float32)
    height[20:40, 20:40] = 0
    io.save_result(io.Result(height=height), tmp_path / "press.h5")
    words = "--contact", tmp_path / "press.h5", "-o", tmp_path / "found.h5"
    ended = run("reconstruct", slide, *words)
    assert (ended.code, ended.said.count("\n")) == (0, 1)
    assert "where a press saw light" in ended.said
    assert "--modulus" in ended.said
    np.testing.assert_array_equal(io.open_result(tmp_path / "found.h5").contact, np.isfinite(height))


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({"contact": np.ones((3, 4), np.uint8)}, "(3, 4), the frames are 64 x 64: give that of the same"),
        ({"contact": np.zeros((64, 64), np.uint8)}, "contact is nowhere: give"),
        ({"mean": np.zeros((64, 64), np.float32)}, "neither contact nor heights: give"),
    ],
)
def test_a_contact_of_no_use_is_refused_by_the_name_of_its_file(slide, tmp_path, maps, message):
    io.save_result(io.Result(**maps), tmp_path / "other.h5")
    line = refused("other.h5", "reconstruct", slide, "--contact", tmp_path / "other.h5")
    assert message in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--texture", "none", "--press", "0.05mm"], "speckled or printed sheet"),
        (["--displacement-step", "0mm,0mm"], "the body does not move in these frames: take some"),
    ],
)
def test_frames_that_show_no_slip_are_refused_by_the_name_of_their_file(tmp_path, words, message):
    path = simulate("horizontal", tmp_path, "--frames", 4, *words)
    line = refused(f"{path}: ", "reconstruct", path)
    assert message in line


def test_contact_is_determined_from_the_pressure_of_a_press(slide):
    touched = np.zeros((64, 64), bool)
    touched[20:40, 20:40] = True
    press = io.Result(height=np.zeros((64, 64), np.float32), pressure=touched.astype(np.float32))
    with io.open_recording(slide) as recording:
        from_press = engine.reconstruct(recording, contact=press)
    np.testing.assert_array_equal(from_press.contact, touched)


def test_a_modulus_gives_the_force_along_the_sheet(slide, contact, tmp_path):
    target = tmp_path / "force.h5"
    assert run("reconstruct", slide, "--contact", contact, "--modulus", "1MPa", "-o", target).code == 0
    result = io.open_result(target)
    with io.open_recording(slide) as recording:
        true = recording.truth.force[-1]
    # The simulation's modulus is 1 MPa, too.
    assert result.force_x == pytest.approx(true[0], rel=0.06)
    assert result.force_y == pytest.approx(true[1], abs=4 * result.force_y_sigma + 0.01 * abs(true[0]))
    assert result.traction.shape == (64, 64, 2)
    assert result.traction[..., 0].sum() * 0.05**2 == pytest.approx(result.force_x, rel=0.05)
