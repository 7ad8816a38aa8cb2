"""The raw correlation of any stack, from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from commands import done, refused, run
from stacks import MadeUp, plot_of, random_stack, record, sphere

from mirrorskin import io
from mirrorskin.evaluation.scenes.rotations import UNEVEN

PHASES = " ".join(f"{np.degrees(phase)}deg" for phase in UNEVEN)


@pytest.fixture(autouse=True)
def folder(tmp_path):
    (tmp_path / "phases.txt").write_text(PHASES)


def theirs(name="theirs.h5", dtype="uint8"):
    with h5py.File(name, "w") as file:
        file["some/stack"] = random_stack(dtype)
    return name


def fitted(frames, phase):
    """Fit by NumPy's least squares: mean, cosine, sine, and what is left."""
    table = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1)
    counts = frames.reshape(len(frames), -1).astype(float)
    coefficients = np.linalg.lstsq(table, counts, rcond=None)[0]
    left = np.sqrt(np.sum((counts - table @ coefficients) ** 2, axis=0) / (len(frames) - 3))
    return [values.reshape(frames.shape[1:]) for values in (*coefficients, left)]


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize(
    ("words", "phase"),
    [
        (["--phases", "phases.txt"], np.array(UNEVEN)),
        (["--phase-step", "45deg"], np.arange(8) * np.pi / 4),
        (["--phase-step=-40deg", "--memory", "100B"], -np.arange(8) * np.pi / 4.5),
    ],
)
def test_any_stack_is_fitted_by_least_squares(dtype, words, phase):
    done("correlate", theirs(dtype=dtype), *words)
    result = io.open_result("theirs-correlation.h5")
    assert set(result.maps()) == {"mean", "cosine", "sine", "modulation", "azimuth", "residual"}
    mean, cosine, sine, residual = fitted(random_stack(dtype), phase)
    scale = np.iinfo(dtype).max
    for name, expected in {"mean": mean, "cosine": cosine, "sine": sine, "residual": residual}.items():
        np.testing.assert_allclose(getattr(result, name), expected, atol=2e-6 * scale, err_msg=name)
    np.testing.assert_allclose(result.modulation, np.hypot(cosine, sine), atol=2e-6 * scale)
    turned = result.azimuth - np.arctan2(sine, cosine)
    assert np.max(np.hypot(cosine, sine) * np.abs(np.sin(turned / 2))) < 2e-6 * scale


def test_the_output_is_printed_in_a_line_and_plotted():
    ended = run("correlate", theirs(), "--phases", "phases.txt", "-o", "out.h5")
    reach = io.open_result("out.h5").modulation
    assert ended.out == (
        f"out.h5: modulation at 35 of 35 pixels, from {reach.min():.3f} to {reach.max():.3f} counts\n"
    )
    assert ended.said == ""
    assert plot_of("out.h5")[1].name == "/entry/result/azimuth"


def test_the_process_is_stored():
    ended = run("correlate", theirs(), "--phases", "phases.txt", "--pixel-size", "0.5mm", "--json")
    report = json.loads(ended.out)
    assert report["output"] == "theirs-correlation.h5"
    assert report["summary"]["answered"] == 35
    assert report["profile"]
    process = io.open_result("theirs-correlation.h5").process
    assert report["process"] == process
    assert (process["source"], process["dataset"], process["frames"]) == ("theirs.h5", "/some/stack", 8)
    assert {"program", "version", "date", "device", "driver", "source_fingerprint"} <= set(process)
    assert io.open_result("theirs-correlation.h5").x[1] == -1.0


def test_a_rotation_has_its_own_phases_and_a_press_needs_them():
    record(MadeUp(random_stack(), io.Header("axial"), phase=np.array(UNEVEN)), Path("turn.h5"))
    assert run("correlate turn.h5").code == 0
    assert run("correlate", theirs(), "--phases", "phases.txt").code == 0
    recorded, replaced = (io.open_result(f"{name}-correlation.h5").cosine for name in ("turn", "theirs"))
    np.testing.assert_array_equal(recorded, replaced)
    record(sphere(), Path("press.h5"))
    assert run("correlate press.h5 --phase-step 45deg").code == 0
    assert "--phase-step" in run("correlate press.h5").said


def test_pictures_are_imported_with_their_phases():
    for number, frame in enumerate(random_stack()):
        cv2.imwrite(f"light{number}.png", frame)
    words = ["--motion", "axial", "--phases", "phases.txt"]
    assert run("import .", *words, "-o", "lights.h5").code == 0
    with io.open_recording("lights.h5") as recording:
        np.testing.assert_allclose(recording.phase, UNEVEN)
    Path("phases.txt").write_text("1deg 2deg 3deg")
    ended = run("import .", *words, "-o", "no.h5")
    assert ended == (2, "", "mirrorskin: phases.txt lists 3 phases for 8 frames: one a frame is needed\n")


def several():
    with h5py.File("theirs.h5", "w") as file:
        file["one"], file["two"] = random_stack(), random_stack()


CASES = {
    "no phases": (
        theirs,
        [],
        "theirs.h5 does not state the position of the body in each frame: give --phase-step or --ph",
    ),
    "both": (theirs, ["--phase-step", "45deg", "--phases", "phases.txt"], "Remove one of them"),
    "seven phases": (theirs, ["--phases", "seven.txt"], "seven.txt lists 7 phases for 8 frames"),
    "no such phases": (theirs, ["--phases", "gone.txt"], "gone.txt: no such file"),
    "a number": (theirs, ["--phases", "number.txt"], "number.txt, line 2: 45: a unit is needed"),
    "the same again": (theirs, ["--phase-step", "360deg"], "at 1 phase do not determine"),
    "two phases": (theirs, ["--phase-step", "180deg"], "2 different phases"),
    "almost one phase": (theirs, ["--phase-step", "0.001deg"], "too close together"),
    "several stacks": (several, ["--phase-step", "45deg"], "choose with --dataset"),
    "no such stack": (theirs, ["--phase-step", "45deg", "--dataset", "gone"], "there is no gone"),
    "its own output": (theirs, ["--phase-step", "45deg", "-o", "theirs.h5"], "is the input"),
    "no file": (lambda: None, ["--phase-step", "45deg"], "no such file"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_line(case):
    make, words, message = CASES[case]
    make()
    Path("seven.txt").write_text(PHASES.rpartition(" ")[0])
    Path("number.txt").write_text("0deg\n45\n90deg")
    before = set(Path().iterdir())
    refused(message, "correlate theirs.h5", *words)
    assert set(Path().iterdir()) == before


def oscillating(hertz=3.0, count=64, rate=25.0):
    """A stack in which all pixels oscillate, with a second harmonic."""
    angle = 2 * np.pi * hertz * np.arange(count) / rate
    counts = 100 + 30 * np.cos(angle - 0.5) + 10 * np.cos(2 * angle)
    noise = np.random.default_rng(4).normal(0, 1, (count, 5, 7))
    with h5py.File("dither.h5", "w") as file:
        file["x"] = np.rint(counts[:, None, None] + noise).astype(np.uint8)
    return "dither.h5"


@pytest.mark.parametrize(("harmonic", "amplitude"), [(1, 30), (2, 10)])
@pytest.mark.parametrize("frequency", ["3", "estimate"])
def test_a_frequency_takes_the_place_of_the_phase(frequency, harmonic, amplitude):
    words = ["--frequency", frequency, "--frame-rate", "25", "--harmonic", str(harmonic)]
    done("correlate", oscillating(), *words)
    result = io.open_result("dither-correlation.h5")
    np.testing.assert_allclose(result.modulation, amplitude, atol=2)
    assert result.process["frequency"] == pytest.approx(3, abs=0.01)
    assert ("frequency_sigma" in result.process) == (frequency == "estimate")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--frequency", "3"], "the time of each frame is unknown"),
        (["--frequency", "3", "--phase-step", "45deg"], "Remove --phase-step and --phases"),
        (["--frequency", "3", "--frame-rate", "0"], "frame_rate 0.0: a number in frames/s above 0 is needed"),
    ],
)
def test_an_impossible_frequency_is_one_line(words, line):
    refused(line, "correlate", oscillating(), *words)
