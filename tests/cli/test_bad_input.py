"""Rare faults of files, in real processes: one line, exit code 2, and nothing written."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest
from commands import Ended, done, refused, run
from stacks import MadeUp, random_stack, record, sphere

from mirrorskin import engine, io
from mirrorskin.io.files.recorder import packing
from mirrorskin.io.storage import hdf5 as storage_hdf5

PHASE = np.arange(8) * np.pi / 4
GIVEN = ["--motion", "vertical", "--travel-step", "0.1mm"]
DAMAGED = bytes(range(200, 250))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Work in an empty folder inside another one."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    return home


def process(*words, command=("-m", "mirrorskin.cli.main"), **settings):
    """Run the command line as a user does."""
    command = [sys.executable, *command, *words]
    process = subprocess.run(command, capture_output=True, check=False, **settings)
    return Ended(
        process.returncode, process.stdout.decode(errors="replace"), process.stderr.decode(errors="replace")
    )


def change(name, value=None):
    """Make a recording of the twin, a part of which is replaced, or left out."""

    def make():
        twin = sphere()
        record(twin, Path("bad.h5"), truth=twin.truth)
        with h5py.File("bad.h5", "r+") as file:
            del file[f"entry/{name}"]
            if value is not None:
                file[f"entry/{name}"] = value

    return make


def other_motion(motion, **header):
    return lambda: record(MadeUp(random_stack(), io.Header(motion, **header), phase=PHASE), Path("bad.h5"))


def stack(**storage):
    """Make someone else's file with a stack that is stored in some way."""

    def make():
        with h5py.File("bad.h5", "w") as file:
            file.create_dataset("x", (8, 50, 70), "u1", **storage)[...] = 1

    return make


def damaged_chunk():
    stack(chunks=(2, 50, 70), compression="gzip")()
    with h5py.File("bad.h5") as file:
        chunk = file["x"].id.get_chunk_info(1)
    # No more than that one: which of several is found first, is the threads' business.
    damaged = DAMAGED[: chunk.size]
    data = bytearray(Path("bad.h5").read_bytes())
    data[chunk.byte_offset : chunk.byte_offset + len(damaged)] = damaged
    Path("bad.h5").write_bytes(data)


def cut_to(length):
    def make():
        record(sphere(), Path("bad.h5"))
        Path("bad.h5").write_bytes(Path("bad.h5").read_bytes()[:length])

    return make


def link(target):
    """Make a file that leads to another, which stands outside of its folder, too."""

    def make():
        with h5py.File("../outside.h5", "w") as file:
            file["x"] = random_stack()
        Path("symlink.h5").symlink_to("../outside.h5")
        with h5py.File("bad.h5", "w") as file:
            file["x"] = target

    return make


def a_result():
    io.save_result(io.Result(height=np.zeros((5, 7), np.float32)), "bad.h5")


def typed(dtype):
    def make():
        with h5py.File("bad.h5", "w") as file:
            file.create_dataset("x", (8, 5, 7), dtype)

    return make


DETECTOR, STAGE = "instrument/detector", "instrument/stage"
NAMED = [*GIVEN, "--dataset", "x"]
CASES = {
    "axial, of no known tilt": (other_motion("axial", zenith_gain=np.array(50.0)), [], "tilt"),
    "horizontal": (other_motion("horizontal"), [], "pixel size"),
    "a result": (a_result, [], "is a result: give the recording that it was made from"),
    "no data": (change(f"{DETECTOR}/data"), [], "name the stack with --dataset"),
    "dangling travel": (
        change(f"{STAGE}/travel", h5py.SoftLink("/gone")),
        [],
        "the link travel leads to /gone",
    ),
    "dangling dark": (change(f"{DETECTOR}/dark", h5py.SoftLink("/gone")), [], "the link dark leads to /gone"),
    "infinite travel": (change(f"{STAGE}/travel", [*range(7), np.inf]), [], "inf at"),
    "travel in words": (
        change(f"{STAGE}/travel", ["a"] * 8),
        [],
        "travel contains no numbers: give --travel-step",
    ),
    "an incomplete truth": (change("truth/zenith"), [], "/entry/truth has no zenith"),
    "a negative pixel": (change(f"{DETECTOR}/x_pixel_size", -1.0), [], "above zero"),
    "an endless pixel": (change(f"{DETECTOR}/x_pixel_size", 1e308), [], "above zero: 1e-9 to 1e6"),
    "a pixel that is no number": (
        change(f"{DETECTOR}/x_pixel_size", np.nan),
        [],
        "not finite: give --pixel-size",
    ),
    "a negative pixel given": (stack(), [*GIVEN, "--pixel-size=-1mm"], "above zero"),
    "a named group": (change(f"{STAGE}/travel"), ["--dataset", "/entry"], "/entry is not a dataset"),
    "compound": (typed([("r", "u1"), ("g", "u1")]), GIVEN, "frames are uint8, uint16 or float32"),
    "a damaged chunk": (damaged_chunk, GIVEN, "frames 2 to 3 of /x cannot be read"),
    "a large chunk": (
        stack(chunks=(8, 50, 70), **hdf5plugin.Bitshuffle()),
        [*GIVEN, "--memory", "9kB"],
        "h5repack",
    ),
    "cut in the signature": (cut_to(5), [], "is not an HDF5 file"),
    "cut in the superblock": (cut_to(30), [], "copy it again"),
    "cut in the metadata": (cut_to(900), [], "truncated"),
    "cut in the data": (cut_to(-40), [], "truncated"),
    "a link up": (link(h5py.ExternalLink("../outside.h5", "/x")), NAMED, "leads out of its folder"),
    "a link by symlink": (link(h5py.ExternalLink("symlink.h5", "/x")), NAMED, "leads out of its folder"),
    "a link in a circle": (link(h5py.SoftLink("/x")), NAMED, "links form a cycle"),
    "steps back": (stack(), ["--motion", "vertical", "--travel-step=-0.1mm"], "give event release"),
    "an output that is a pipe": (
        lambda: (stack()(), os.mkfifo("pipe")),
        [*GIVEN, "-o", "pipe"],
        "is not a regular file",
    ),
    "an output with a long name": (stack(), [*GIVEN, "-o", "x" * 300], "File name too long; choose another"),
    "an input with a long name": (lambda: None, ["x" * 300], "File name too long"),
}


@pytest.mark.parametrize("case", CASES)
def test_reconstruct_refuses_in_one_line(case):
    make, options, message = CASES[case]
    make()
    name = [] if case == "an input with a long name" else ["bad.h5"]
    refused(message, "reconstruct", *name, *options)


@pytest.mark.parametrize(
    ("make", "words", "message"),
    [
        (cut_to(30), ["reconstruct", "bad.h5"], "bad.h5: it is "),
        (
            damaged_chunk,
            ["reconstruct", "bad.h5", *GIVEN],
            "bad.h5: frames 2 to 3 of /x cannot be read: it is damaged",
        ),
    ],
)
def test_a_process_ends_with_one_line(make, words, message):
    make()
    refused(message, *words, run=process)


@pytest.mark.parametrize(
    ("make", "words", "message"),
    [
        (a_result, ["score", "bad.h5", "--truth", "bad.h5"], "bad.h5 is a result: give the recording"),
        (
            change("title"),
            ["score", "bad.h5", "--truth", "bad.h5"],
            "bad.h5 is not a result: 'mirrorskin reconstruct'",
        ),
        (change(f"{STAGE}/motion"), ["info", "bad.h5"], "does not state how the sensor moved"),
        (cut_to(900), ["info", "bad.h5"], "truncated"),
        (lambda: None, ["reconstruct", "."], ". is a folder without numbered pictures"),
        (
            stack(),
            ["reconstruct", "bad.h5", *GIVEN, "-o", "bad.h5/r.h5"],
            "there is no folder bad.h5: make it first",
        ),
        (stack(), ["import", "bad.h5", *GIVEN, "-o", "bad.h5"], "bad.h5 is the input"),
        (stack(), ["simulate", "vertical", "--object", "bad.h5", "-o", "bad.h5"], "bad.h5 is the input"),
    ],
)
def test_other_commands_refuse_in_one_line(make, words, message):
    make()
    refused(message, *words)


def test_a_result_of_another_size_is_not_scored():
    twin = sphere()
    record(twin, Path("truth.h5"), truth=twin.truth)
    io.save_result(io.Result(height=np.zeros((4, 7), np.float32)), "bad.h5")
    refused("not of one stack", "score bad.h5 --truth truth.h5")


def test_a_recording_without_the_truth_is_not_scored():
    record(sphere(), Path("blind.h5"))
    a_result()
    refused("holds no truth", "score bad.h5 --truth blind.h5")


def test_references_may_be_unknown_at_some_pixels():
    dark = np.full((5, 7), 16, np.float32)
    dark[2, 3] = np.nan
    change(f"{DETECTOR}/dark", dark)()
    done("reconstruct bad.h5")
    result = io.open_result("bad-result.h5")
    assert result.status[2, 3] == 0
    assert np.count_nonzero(result.status == 0) == 1


@pytest.mark.parametrize("name", ["five yen.h5", "Münze 五円.h5"])
def test_any_name_is_accepted(name):
    record(sphere(), Path(name))
    done("reconstruct", name)
    result = name.replace(".h5", "-result.h5")
    done("info", result)
    assert io.open_result(result).process["source"] == name


def test_a_name_that_is_not_text_is_accepted():
    name = Path(os.fsdecode(b"no \xff text.h5"))
    record(sphere(), Path("plain.h5")).rename(name)
    assert process("reconstruct", name, "-o", "result.h5")[0] == 0
    assert io.open_result("result.h5").process["source"] == "no \ufffd text.h5"


FULL = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))
from mirrorskin.cli.main import main
main()
"""


def test_a_full_disk_is_one_line():
    # A limit to the size of files stands for the full disk; kernels that are built keep within it.
    words = ["simulate", "vertical", "--size", "700x200", "--references", "exact", "-o", "press.h5"]
    refused(
        "press.h5 could not be written: File too large", *words, run=partial(process, command=("-c", FULL))
    )


def test_the_suffix_of_another_kind_of_file_is_refused(folder):
    run("simulate", "vertical", "--size", "12x10", "--frames", "6", "-o", "press.h5")
    for words in ("reconstruct press.h5 -o x.txt", "simulate vertical --size 12x10 --frames 6 -o x.dat"):
        refused("this is written as HDF5. Name it x.h5", *words.split())
    with pytest.raises(io.InputError, match=r"Name it flat\.h5"):
        io.save_result(io.Result(height=np.zeros((2, 3), np.float32)), "flat.xls")
    run("reconstruct", "press.h5", "-o", "run.2")  # a number is no kind of file
    assert {path.name for path in folder.iterdir()} == {"press.h5", "run.2"}


def test_an_array_of_colours_says_so(tmp_path):
    np.save(tmp_path / "rgb.npy", np.zeros((8, 12, 10, 3), np.uint8))
    travel = ["--motion", "vertical", "--travel-step", "0.1mm", "-o"]
    refused(
        "the last axis is one of colours", "reconstruct", tmp_path / "rgb.npy", *travel, tmp_path / "r.h5"
    )
    with pytest.raises(io.InputError, match=r"take one colour, frames\[\.\.\., 1\]") as caught:
        engine.find_onset(np.zeros((8, 12, 10, 3), np.uint8), np.arange(8) * 0.1)
    assert caught.value.__cause__ is None


def test_codecs_are_an_extra_that_messages_name(monkeypatch):
    stack(chunks=(8, 50, 70), **hdf5plugin.Bitshuffle())()
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(io.InputError, match=r"pip install 'mirrorskin\[codecs\]', or choose gzip"):
        packing("bitshuffle")
    assert packing("gzip")["compression"] == "gzip"
    monkeypatch.setattr(storage_hdf5, "find_spec", lambda _: None)
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: code < 300)
    with pytest.raises(io.InputError, match=r"which is not installed: pip install 'mirrorskin\[codecs\]'"):
        io.open_recording("bad.h5", travel=np.arange(8) * 0.1)
