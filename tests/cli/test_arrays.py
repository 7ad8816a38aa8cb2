"""Stacks written by NumPy, and the travel of each frame in a file: on the command line and in Python."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import done, refused, run
from stacks import ball, read_all, record

from mirrorskin import engine, io

TRAVEL = np.arange(1, 13) * 0.1
STEPS = ("--travel-step", "0.1mm", "--travel-start", "0.1mm")
SIZE = ("--pixel-size", "0.4mm")


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """The frames of a ball, and what its recording gives without references."""
    path = record(ball((12, 16), (0.4, 0.4), TRAVEL), tmp_path_factory.mktemp("ball") / "ball.h5")
    with io.open_recording(path, pixel_size=(0.4, 0.4)) as recording:
        frames = read_all(recording, 12).frames
        return frames, engine.reconstruct(recording, dark=0, bright=255)


@pytest.fixture(autouse=True)
def folder(tmp_path, stack):
    """Work in a folder that holds the frames as an array and as an archive."""
    np.save("ball.npy", stack[0])
    np.savez("ball.npz", frames=stack[0], travel=TRAVEL, dark=np.float64(0), bright=np.full((12, 16), 255.0))
    return tmp_path


def heights(*words):
    done("reconstruct", *words, "-o", "out.h5", "--overwrite")
    return io.open_result("out.h5").height


@pytest.mark.parametrize(
    "words",
    [
        ("ball.npy", *STEPS, *SIZE, "--dark", 0, "--bright", 255),
        ("ball.npz", *SIZE),
        ("ball.npz", "--dataset", "frames", *STEPS, *SIZE),
    ],
)
def test_an_array_has_the_heights_of_a_recording_of_the_same_frames(stack, words):
    np.testing.assert_array_equal(heights(*words), stack[1].height)


def test_a_region_of_an_array_is_that_part_of_the_picture():
    heights("ball.npz", *SIZE, "--no-fill")
    whole = io.open_result("out.h5")
    heights("ball.npz", *SIZE, "--no-fill", "--region", "3,2,8x6")
    part = io.open_result("out.h5")
    np.testing.assert_array_equal(part.height, whole.height[2:8, 3:11])
    np.testing.assert_array_equal(part.x, whole.x[3:11])


def test_an_imported_array_is_a_recording(stack):
    assert run("import ball.npy --motion vertical", *STEPS, *SIZE, "-o", "rec.h5").code == 0
    np.testing.assert_array_equal(heights("rec.h5", "--dark", 0, "--bright", 255), stack[1].height)


def test_a_batch_keeps_what_was_made_of_an_array_until_the_array_changes():
    assert "1 done" in run("batch ball.npz -o out").out
    assert "1 kept" in run("batch ball.npz -o out").out
    np.savez("ball.npz", frames=np.load("ball.npy") // 2, travel=TRAVEL, dark=0.0, bright=255.0)
    assert "1 done" in run("batch ball.npz -o out").out


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.txt", "\n".join(f"{travel:.1f}" for travel in TRAVEL)),
        ("t.txt", "# stage\n" + " ".join(f"{1000 * travel:.0f}um" for travel in TRAVEL)),
        ("t.csv", "travel (mm),\r\n" + "\r\n".join(f"{travel:.1f}," for travel in TRAVEL)),
    ],
)
def test_the_travel_of_each_frame_is_read_from_a_text(stack, name, text):
    Path(name).write_bytes(text.encode())
    height = heights("ball.npy", "--travel", name, *SIZE, "--dark", 0, "--bright", 255)
    np.testing.assert_allclose(height, stack[1].height, atol=1e-6)


def test_the_travel_of_a_real_stage_places_heights():
    uneven = TRAVEL**2
    np.save("t.npy", uneven)
    even = heights("ball.npy", *STEPS, "--no-fill", "--no-subframe")
    height = heights("ball.npy", "--travel", "t.npy", "--no-fill", "--no-subframe")
    np.testing.assert_allclose(height, -(even**2), rtol=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["ball.npy"], "ball.npy does not state the position of the body in each frame: give one of travel"),
        (["ball.npy", "--motion", "axial"], "ball.npy: axial motion needs the phase of each frame"),
        (["ball.npy", *STEPS, "--live"], "leave --live out"),
        (
            ["ball.npz", "--dataset", "none"],
            "contains no array 'none': choose from frames, travel, dark, bright",
        ),
        (
            ["ball.npy", "--travel", "ball.npz"],
            "ball.npz is not text in UTF-8: line 1 contains the byte",
        ),
        (["ball.npy", "--travel", "t.txt"], "t.txt lists 2 travels for 12 frames: one a frame is needed"),
        (["ball.npy", "--travel", "t.txt", *STEPS], "Remove --travel-step and --travel-start"),
        (["ball.npy", "--travel", "ball.npy"], "lists 2304 travels for 12 frames"),
        (["cut.npy", *STEPS], "cut.npy is not a NumPy array"),
        (["cut.npz", *STEPS], "cut.npz is not a NumPy array"),
        (["complex.npy", *STEPS], "complex.npy is not a NumPy array of numbers (it contains complex128)"),
        (["negative.npy", *STEPS], "frame 0 has a sample of -1; int16 is read as uint16, 0 to 65535"),
        (["flat.npy", *STEPS], "flat.npy has shape (4, 5): frames, (T, H, W)"),
        (["two.npz", *STEPS], "two.npz contains the arrays a, b: choose the frames with --dataset"),
    ],
)
def test_an_array_that_cannot_be_used_is_refused_in_a_line(words, message):
    Path("t.txt").write_text("0.1 0.2")
    for name in ("cut.npy", "cut.npz"):
        Path(name).write_bytes(Path(f"ball{Path(name).suffix}").read_bytes()[:700])
    np.save("complex.npy", np.zeros((4, 5, 6), np.complex128))
    np.save("negative.npy", np.full((4, 5, 6), -1, np.int16))
    np.save("flat.npy", np.zeros((4, 5), np.uint8))
    np.savez("two.npz", a=np.zeros((4, 5, 6), np.uint8), b=np.zeros((4, 5, 6), np.uint8))
    refused(message, "reconstruct", *words, "-o", "out.h5")


def test_what_an_array_or_an_archive_holds_is_reported():
    assert run("info ball.npy").out.split("\n")[1].split(maxsplit=1)[1] == "12 x 12 x 16, uint8"
    report = json.loads(run("info ball.npz --json").out)
    assert (report["travel"], report["dark"]) == ("12, float64", "one number, float64")
    Path("cut.npz").write_bytes(Path("ball.npz").read_bytes()[:700])
    assert run("info cut.npz").said.startswith("mirrorskin: cut.npz is not a NumPy array")


def test_an_import_without_the_pixel_size_names_the_commands_that_need_it():
    words = ("import", "ball.npy", "--motion", "vertical", *STEPS, "-o", "rec.h5")
    assert "no pixel size" in run(*words).said
    assert run(*words, *SIZE, "--overwrite").said == ""


# In Python.


def test_frames_in_memory_have_a_result_that_can_be_saved(stack):
    frames, expected = stack
    result = engine.reconstruct(frames, travel=TRAVEL, pixel_size=0.4, dark=0, bright=255)
    np.testing.assert_array_equal(result.height, expected.height)
    np.testing.assert_array_equal(result.x, expected.x)
    io.save_result(result, "saved.h5")
    np.testing.assert_array_equal(io.open_result("saved.h5").height, expected.height)


def test_frames_with_phases_are_a_rotation():
    phase = np.arange(8) * np.pi / 4
    frames = np.broadcast_to((100 + 20 * np.cos(phase))[:, None, None], (8, 6, 7)).astype(np.float32)
    result = engine.reconstruct(
        frames, phase=phase, tilt=0.05, pixel_size=(0.1, 0.1), zenith_gain=400.0, zenith_offset=0.0, noise=0.5
    )
    assert result.normals.shape == (6, 7, 3)
    assert result.process["source"] == "the array of frames"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "does not state the position of the body"),
        ({"travel": TRAVEL, "phase": TRAVEL}, "has travel and phase: give one of"),
        ({"travel": TRAVEL[:3]}, "travel given has shape \\(3,\\) for 12 frames"),
        ({"travel": TRAVEL, "pixel_size": -1.0}, "pixel size -1.0"),
        ({"travel": TRAVEL, "pixel_size": "0.1mm"}, "pixel_size is '0.1mm'"),
    ],
)
def test_frames_in_memory_that_do_not_fit_are_refused(stack, options, message):
    with pytest.raises(io.InputError, match=message):
        engine.reconstruct(stack[0], **options)


def test_a_recording_has_its_own_travel(folder):
    with io.open_recording("ball.npz") as opened, pytest.raises(io.InputError, match="of its own"):
        engine.reconstruct(opened, travel=TRAVEL)


def test_levels_that_were_not_given_are_named():
    words = ("reconstruct", "ball.npy", *STEPS, *SIZE, "-o", "out.h5", "--overwrite")
    text = run(*words).said
    assert "ball.npy: no dark and bright given: estimated as " in text
    assert text.count("\n") == 1
    assert "no bright given: estimated as " in run(*words, "--dark", 0).said
    assert "no dark" not in run(*words, "--dark", 0, "--bright", 255).said


def test_the_line_of_a_file_in_a_batch_names_levels_that_were_not_given():
    Path("batch.toml").write_text('[stack]\ntravel-step = "0.1mm"\npixel-size = "0.4mm"\n')
    out = run("batch ball.npy -o out --settings batch.toml").out
    assert "; no dark and bright given: estimated as " in out


def test_a_batch_takes_the_travel_of_a_file():
    Path("t.txt").write_text(" ".join(map(str, TRAVEL)))
    Path("batch.toml").write_text('[stack]\ntravel = "t.txt"\n')
    words = ("batch", "ball.npy", "-o", "out", "--settings", "batch.toml")
    assert "1 done" in run(*words).out
    assert "1 kept" in run(*words).out
    Path("t.txt").write_text(" ".join(map(str, 2 * TRAVEL)))
    assert "1 done" in run(*words).out


def test_levels_that_the_frames_do_not_show_are_warned_of():
    np.save("dark.npy", np.full((4, 5, 6), 12, np.uint8))
    text = run("reconstruct dark.npy", *STEPS, *SIZE, "-o", "out.h5").said
    assert "the range of the frames' type is taken, and heights may be wrong" in text


def test_a_result_without_an_answer_ends_with_the_reason():
    ended = run("reconstruct", "ball.npy", *STEPS, *SIZE, "--dark", 3000, "--bright", 4000, "-o", "none.h5")
    assert ended.code == 1
    assert "none.h5: no height at any of 192 pixels" in ended.out
    assert "no height at any pixel (never light at 100 %): samples are" in ended.said
    assert (
        "below the threshold of 3500 between dark 3000 and bright 4000: are these counts of the frames"
        in ended.said
    )


def test_a_slide_without_contact_ends_with_the_reason():
    np.save("still.npy", np.random.default_rng(1).integers(80, 120, (6, 40, 40)).astype(np.uint8))
    path = np.outer(np.arange(6), [0.1, 0.0])
    np.savez("slide.npz", frames=np.repeat(np.load("still.npy")[:1], 6, axis=0), displacement=path)
    ended = run("reconstruct", "slide.npz", "--pixel-size", "0.1mm", "-o", "none.h5")
    assert ended.code == 1
    assert "slip is known at no pixel (" in ended.said
    assert "mirrorskin: none.h5: no slip onset at any pixel: " in ended.said


def test_a_twist_in_degrees_is_reported():
    frames = np.random.default_rng(1).integers(80, 120, (6, 40, 40)).astype(np.uint8)
    np.savez("twist.npz", frames=frames, twist=2.0 * np.arange(6))
    with io.open_recording("twist.npz") as recording:
        assert [finding.text for finding in recording.findings] == [
            "the twist spans 10 rad, more than half a turn: is it in degrees?"
        ]
