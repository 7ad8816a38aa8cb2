"""Bad input: one clear line, exit code 2, and nothing written."""

import h5py
import numpy as np
import pytest
from commands import refused, run

FRAMES = np.full((6, 5, 7), 20, np.uint8)
FRAMES[3:] = 200
TRAVEL = np.arange(6) * 0.1


def ours(path, **changes):
    """Write a small recording of ours by hand, with some of its parts replaced, or left out by None."""
    parts = {
        "/entry/instrument/detector/data": FRAMES,
        "/entry/instrument/stage/motion": "vertical",
        "/entry/instrument/stage/travel": TRAVEL,
        "/entry/instrument/detector/dark": np.full((5, 7), 20.0),
        "/entry/instrument/detector/bright": np.full((5, 7), 220.0),
    }
    folders = {"motion": "stage", "travel": "stage"}
    for name, value in changes.items():
        parts[f"/entry/instrument/{folders.get(name, 'detector')}/{name}"] = value
    with h5py.File(path, "w") as file:
        file.create_group("entry").attrs["mirrorskin_recording"] = 1
        for name, value in parts.items():
            if value is not None:
                file[name] = value


def foreign(path, **datasets):
    with h5py.File(path, "w") as file:
        for name, value in datasets.items():
            file[name] = value


def claims_too_much(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", (10**6, 1000, 1000), "u1")


def claims_chunks_it_lacks(*written):
    def make(path):
        with h5py.File(path, "w") as file:
            stack = file.create_dataset("frames", (10**6, 1000, 1000), "u1", chunks=(1, 1000, 1000))
            for number in written:
                stack[number] = 1

    return make


def unknown_filter(path):
    with h5py.File(path, "w") as file:
        stack = file.create_dataset(
            "frames", (2, 5, 7), "u1", chunks=(1, 5, 7), compression=32099, allow_unknown_filter=True
        )
        for number in range(2):
            stack.id.write_direct_chunk((number, 0, 0), b"\0" * 35)


def external_link(target):
    def make(path):
        with h5py.File(path, "w") as file:
            file["frames"] = h5py.ExternalLink(target, "/frames")

    return make


NAN_TRAVEL = np.where(np.arange(6) == 3, np.nan, TRAVEL)
GIVEN = ["--motion", "vertical", "--travel-step", "0.1mm"]
TWO = {"one": FRAMES, "two": FRAMES}
TEXT = np.array([[["a"]]] * 3, dtype="S1")

# What is made, the options beside it, and what the line must say.
CASES = {
    "no such file": (lambda path: None, [], "no such file"),
    "a folder": (lambda path: path.mkdir(), [], "folder"),
    "an empty file": (lambda path: path.touch(), [], "not an HDF5 file"),
    "not HDF5": (lambda path: path.write_text("hello\n" * 999), [], "not an HDF5 file"),
    "no stack": (lambda path: foreign(path, flat=FRAMES[0]), GIVEN, "no stack"),
    "several stacks": (lambda path: foreign(path, **TWO), GIVEN, "--dataset"),
    "a wrong name": (lambda path: foreign(path, **TWO), [*GIVEN, "--dataset", "three"], "three"),
    "a flat one": (lambda path: foreign(path, flat=FRAMES[0]), [*GIVEN, "--dataset", "flat"], "(T, H, W)"),
    "no frames": (lambda path: foreign(path, frames=FRAMES[:0]), GIVEN, "at least 2"),
    "one frame": (lambda path: foreign(path, frames=FRAMES[:1]), GIVEN, "at least 2"),
    "no rows": (lambda path: foreign(path, frames=FRAMES[:, :0]), GIVEN, "no pixels"),
    "complex": (lambda path: foreign(path, frames=FRAMES.astype("c8")), GIVEN, "uint8, uint16 or float32"),
    "strings": (lambda path: foreign(path, frames=TEXT), GIVEN, "uint8, uint16 or float32"),
    "negative": (
        lambda path: foreign(path, frames=-1 - FRAMES.astype("i2")),
        GIVEN,
        "int16 is read as uint16",
    ),
    "travel with NaN": (lambda path: ours(path, travel=NAN_TRAVEL), [], "nan at frame 3"),
    "an oscillation for a change-point": (
        lambda path: ours(path, travel=np.abs(TRAVEL - 0.2)),
        ["--method", "change-point"],
        "bad.h5: travel oscillates, which needs the method 'threshold'",
    ),
    "a release for a press": (
        lambda path: ours(path, travel=TRAVEL[::-1].copy()),
        [],
        "bad.h5: travel only falls: that is a release; give event release",
    ),
    "a press for a release": (
        ours,
        ["--event", "release"],
        "bad.h5: travel only rises: that is a press; give event onset",
    ),
    "travel missing": (lambda path: ours(path, travel=None), [], "--travel-step"),
    "travel too short": (lambda path: ours(path, travel=TRAVEL[:5]), [], "travel"),
    "travel not given": (lambda path: foreign(path, frames=FRAMES), GIVEN[:2], "--travel-step"),
    "motion not given": (lambda path: foreign(path, frames=FRAMES), GIVEN[2:], "--motion"),
    "motion unknown": (lambda path: ours(path, motion="sideways"), [], "sideways"),
    "a motion that contradicts the file": (
        ours,
        ["--motion", "twist"],
        "bad.h5 states the motion vertical, but --motion is twist: leave --motion out, or correct the file",
    ),
    "dark of another shape": (lambda path: ours(path, dark=np.zeros((5, 6))), [], "dark"),
    "bright not above dark": (lambda path: ours(path, bright=np.full((5, 7), 10.0)), [], "not above dark"),
    "swapped on the command line": (ours, ["--dark", "200", "--bright", "20"], "not above dark"),
    "a threshold above 1": (ours, ["--threshold", "1.5"], "threshold 1.5"),
    "no hold": (ours, ["--hold", "0"], "hold 0"),
    "a missing filter": (unknown_filter, GIVEN, "32099"),
    "an unknown device": (ours, ["--device", "abacus"], "abacus"),
    "a folder as output": (ours, ["-o", "."], "folder"),
    "a link to nothing": (external_link("nothing.h5"), [*GIVEN, "--dataset", "frames"], "nothing.h5"),
    "a link out of the folder": (external_link("/etc/passwd"), [*GIVEN, "--dataset", "frames"], "out of"),
    "a claim beyond the file": (claims_too_much, GIVEN, "claims"),
    "chunks that are not there": (
        claims_chunks_it_lacks(0, 9),
        GIVEN,
        "frames 1 to 8 of 1000000 were never written",
    ),
    "one chunk that is there": (claims_chunks_it_lacks(0), GIVEN, "contains 1 frame: at least 2"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_refused_in_one_line(tmp_path, case):
    make, options, words = CASES[case]
    path = tmp_path / "bad.h5"
    make(path)
    before = {entry.name for entry in tmp_path.iterdir()}
    refused(words, "reconstruct", path, *options)
    assert {entry.name for entry in tmp_path.iterdir()} == before


def test_the_made_up_recording_is_good_where_nothing_is_replaced(tmp_path):
    ours(tmp_path / "good.h5")
    assert run("reconstruct", tmp_path / "good.h5").code == 0
    assert (tmp_path / "good-result.h5").exists()


def test_the_input_is_not_overwritten(tmp_path):
    path = tmp_path / "good.h5"
    ours(path)
    kept = path.read_bytes()
    refused("is the input", "reconstruct", path, "-o", path)
    assert path.read_bytes() == kept


def test_an_output_below_a_file_is_refused(tmp_path):
    path = tmp_path / "good.h5"
    ours(path)
    refused("", "reconstruct", path, "-o", path / "result.h5")


def test_a_claim_is_refused_before_memory_is_taken(tmp_path, monkeypatch):
    claims_too_much(tmp_path / "bad.h5")
    taken = []
    monkeypatch.setattr(np, "empty", lambda *args, **kwargs: taken.append(args))
    code, *_ = run("reconstruct", tmp_path / "bad.h5", *GIVEN)
    assert code == 2
    assert not taken


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("simulate vertical -o no/such/a.h5", "no folder"),
        ("score nothing.h5 --truth nothing.h5", "no such file"),
        ("bench --against what.json", "no such file"),
        ("bench -o run.txt", "must end in .json"),
        ("bench -o no/such/run.json", "no folder"),
    ],
)
def test_other_commands_refuse_too(tmp_path, words, message):
    refused(message, words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["run mirrorskin.engine:Onset", "reconstruct"])
def test_a_result_is_not_written_as_another_format(tmp_path, command):
    ours(tmp_path / "press.h5")
    line = "write it so, then 'mirrorskin export' makes .csv of it"
    refused(line, *command.split(), tmp_path / "press.h5", "-o", tmp_path / "w.csv")
