"""Commands, run in this process in a common folder; each case first makes the files that it needs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import tifffile
from commands import run
from engine_cases import PROCESS, RECONSTRUCTED, named, result_maps
from golden import FITTED, KERNEL, Answer, Tolerance, case
from scenes import press

from mirrorskin import io

SIZE = ("--size", "48x40", "--pixel-size", "0.2mm")
RECORDINGS = {
    "press.h5": ("simulate", "vertical", "--object", "sphere", *SIZE, "--frames", "20"),
    "release.h5": ("simulate", "vertical", "--object", "sphere", *SIZE, "--frames", "12", "--release"),
    "turn.h5": ("simulate", "axial", "--object", "sphere", *SIZE, "--pattern", "linear", "--press", "1.5mm"),
    "turns.h5": (
        *("simulate", "axial", "--object", "step", *SIZE, "--pattern", "linear", "--press", "1.5mm"),
        *("--frames", "16", "--dtype", "uint16"),
    ),
    "moved.h5": (
        "simulate",
        "horizontal",
        "--object",
        "coin",
        *SIZE,
        "--frames",
        "4",
        "--contact",
        "elastic",
    ),
    "twisted.h5": ("simulate", "twist", "--object", "texture", *SIZE, "--frames", "4", "--dtype", "float32"),
    "elastic.h5": (
        *("simulate", "vertical", "--object", "sphere", *SIZE, "--frames", "6", "--contact", "elastic"),
        *("--optics", "cylinder", "--gain-deviation", "0.05", "--electrons", "60", "--point-spread", "0.7"),
    ),
    "leaning.h5": (
        *("simulate", "axial", "--object", "cone", *SIZE, "--contact", "elastic", "--optics", "cylinder"),
        *("--pattern", "linear", "--frames", "4", "--camera-distance", "150mm", "--asymmetry", "0.05"),
    ),
    "gel.h5": (
        *("simulate", "vertical", "--object", "sphere", "--size", "60x60", "--pixel-size", "0.12mm"),
        *("--travel-step", "0.04mm", "--frames", "32", "--contact", "elastic", "--optics", "cylinder"),
    ),
    "press-result.h5": ("reconstruct", "press.h5"),
    "turn-result.h5": ("reconstruct", "turn.h5"),
    "turns-result.h5": ("reconstruct", "turns.h5", "--per-turn"),
    "fused.h5": ("fuse", "press.h5", "turn.h5"),
    "gel-cal.h5": ("calibrate", "elastic", "gel.h5", "--ball", "10mm"),
}


def command(*words: object) -> str:
    """Run a command that must succeed, on what it needs; return what it prints."""
    for word in words:
        make(str(word))
    ended = run(*words)
    assert ended.code == 0, ended.said
    return ended.out


def make(name: str) -> str:
    """Make a file of the list above, once."""
    if name in RECORDINGS and not Path(name).exists():
        command(*RECORDINGS[name], "-o", f"./{name}")
    return name


def json_of(*words: object) -> Any:
    """Run a command that prints JSON, and return that."""
    return json.loads(command(*words, "--json"))


def recording(name: str) -> Answer:
    """Return the frames of a recording, where the body was, and what it says of its truth."""
    with io.open_recording(make(name)) as source:
        read = []
        while (block := source.read(np.empty(source.shape, source.dtype))) is not None:
            read.append((block.frames.copy(), block))
        header, truth = source.header, source.truth
    frames = np.concatenate([block_frames for block_frames, _ in read])
    places = {}
    for name in ("travel", "phase", "displacement", "twist"):
        parts = [getattr(block, name) for _, block in read]
        places[name] = None if parts[0] is None else np.concatenate(parts)
    levels = {"dark": header.dark, "bright": header.bright, "gain": header.zenith_gain}
    maps = {}
    if truth is not None:
        maps = {"truth_height": truth.height, "truth_zenith": truth.zenith, "truth_contact": truth.contact}
        maps["truth_slip"] = truth.slip
    return {"frames": frames, **places, **levels, **maps}


def result(*words: object) -> Answer:
    """Run a command that writes a result, and return that."""
    command(*words, "-o", "some-result.h5", "--overwrite")
    return result_maps(io.open_result("some-result.h5"))


TWIN = {"travel": Tolerance(0.0, 1e-9), "truth_height": KERNEL, "truth_zenith": KERNEL}
RESULT = {"tolerance": FITTED, **RECONSTRUCTED}


@case(FITTED, **TWIN)
def simulate_a_press() -> Answer:
    return named(press=recording("press.h5"), release=recording("release.h5"))


@case(FITTED, **TWIN)
def simulate_a_rotation() -> Answer:
    return named(turn=recording("turn.h5"), turns=recording("turns.h5"))


@case(FITTED, frames=Tolerance(1e-5), **TWIN)
def simulate_other_motions() -> Answer:
    return named(moved=recording("moved.h5"), twisted=recording("twisted.h5"))


@case(FITTED, **TWIN)
def simulate_an_elastic_body() -> Answer:
    return named(press=recording("elastic.h5"), turn=recording("leaning.h5"))


@case(FITTED)
def import_pictures() -> Answer:
    frames = press("uint16", (21, 30), 6)[0]
    Path("pictures").mkdir(exist_ok=True)
    for number, frame in enumerate(frames):
        cv2.imwrite(f"pictures/frame_{number:03d}.png", frame)
    where = (
        "--motion",
        "vertical",
        "--travel-step",
        "0.1mm",
        "--travel-start",
        "0.3mm",
        "--pixel-size",
        "0.03mm",
    )
    command("import", "pictures", "-o", "pictures.h5", *where, "--compression", "bitshuffle")
    return recording("pictures.h5")


@case(**RESULT)
def reconstruct_others_layouts() -> Answer:
    frames = press("uint8", (21, 30), 14)[0]
    with h5py.File("theirs.h5", "w") as file:
        file["raw/images"] = frames
        file.create_dataset("packed/images", data=frames, chunks=(1, 21, 30), compression="gzip")
    where = ("--motion", "vertical", "--travel-step", "0.1mm", "--pixel-size", "0.03mm")
    levels = ("--dark", "16", "--bright", "224")
    answers = {}
    for name in ("raw", "packed"):
        words = ("reconstruct", "theirs.h5", "--dataset", f"/{name}/images", *where, *levels)
        answers[name] = result(*words)
    return named(**answers)


@case(**RESULT)
def reconstruct_a_recorded_press() -> Answer:
    return named(
        whole=result("reconstruct", "press.h5"),
        options=result(
            "reconstruct", "press.h5", "--no-fill", "--no-subframe", "--hold", "3", "--noise", "2"
        ),
        part=result("reconstruct", "press.h5", "--region", "8,6,31x25", "--frames", "0:15"),
        change=result("reconstruct", "press.h5", "--method", "change-point"),
    )


@case(**RESULT)
def reconstruct_a_recorded_release() -> Answer:
    return named(
        down=result("reconstruct", "release.h5"),
        up=result("reconstruct", "release.h5", "--event", "release"),
        change=result("reconstruct", "release.h5", "--event", "release", "--method", "change-point"),
    )


@case(fragile=True, **RESULT)
def reconstruct_a_recorded_rotation() -> Answer:
    return named(
        exact=result("reconstruct", "turn.h5"),
        paper=result("reconstruct", "turn.h5", "--method", "paper", "--noise", "1.5"),
        robust=result("reconstruct", "turns.h5", "--robust"),
        tilt=result("reconstruct", "turn.h5", "--tilt", "estimate"),
        heights=result("reconstruct", "turn.h5", "--heights", "press-result.h5"),
    )


@case(**RESULT)
def reconstruct_recorded_turns() -> Answer:
    return result("reconstruct", "turns.h5", "--per-turn")


@case(**RESULT)
def reconstruct_and_say_so() -> Answer:
    return {
        "press": json_of("reconstruct", "press.h5", "-o", "some-result.h5", "--overwrite")["summary"],
        "turn": json_of("reconstruct", "turn.h5", "-o", "some-result.h5", "--overwrite")["summary"],
    }


@case(**RESULT)
def correlate_recordings() -> Answer:
    return named(
        turn=result("correlate", "turn.h5"), part=result("correlate", "turns.h5", "--region", "5,4,30x29")
    )


@case(fragile=True, **RESULT)
def fuse_recordings() -> Answer:
    return named(
        plain=result("fuse", "press.h5", "turn.h5"),
        still=result("fuse", "press.h5", "turn.h5", "--no-register"),
        robust=result("fuse", "press.h5", "turn.h5", "--robust"),
    )


@case(PROCESS, fragile=True)
def score_results() -> Answer:
    return {
        "press": json_of("score", "press-result.h5", "--truth", "press.h5"),
        "turn": json_of("score", "turn-result.h5", "--truth", "turn.h5"),
        "turns": json_of("score", "turns-result.h5", "--truth", "turns.h5"),
        "fused": json_of("score", "fused.h5", "--truth", "press.h5"),
    }


@case(PROCESS, fragile=True)
def info_of_files() -> Answer:
    names = ("press.h5", "turn.h5", "press-result.h5", "turn-result.h5", "fused.h5", "gel-cal.h5")
    return {name: json_of("info", name) for name in names}


@case(PROCESS, fragile=True)
def measure_results() -> Answer:
    return {
        "fused": json_of("measure", "fused.h5"),
        "section": json_of("measure", "fused.h5", "--section=-3mm,0mm:3mm,1mm", "--form", "plane"),
        "part": json_of("measure", "turn-result.h5", "--region", "10,10,25x20", "--form", "sphere"),
        "turn": json_of("measure", "turns-result.h5", "--turn", "1"),
    }


@case(FITTED, fragile=True)
def export_results() -> Answer:
    names = [f"fused.{kind}" for kind in ("ply", "stl", "xyz", "png", "tif", "npz")]
    command("export", "fused.h5", *(word for name in names for word in ("-o", f"./{name}")))
    command("export", "fused.h5", "-o", "points.ply", "--points")
    command("export", "fused.h5", "-o", "fused.csv", "--section", "apex")
    command("export", "fused.h5", "-o", "cut.csv", "--section=-3mm,0mm:3mm,1mm")
    with np.load("fused.npz") as file:
        arrays = {f"npz_{name}": file[name] for name in file.files if file[name].dtype.kind in "fiu"}
    return {
        "ply_head": ply_head("fused.ply"),
        "points_head": ply_head("points.ply"),
        "stl": np.frombuffer(Path("fused.stl").read_bytes()[84:], STL)["corners"],
        "xyz": np.loadtxt("fused.xyz"),
        "picture_png": cv2.imread("fused.png", cv2.IMREAD_UNCHANGED),
        "picture_tif": tifffile.imread("fused.tif"),
        "csv": table("fused.csv"),
        "cut": table("cut.csv"),
        **arrays,
    }


STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])


def ply_head(path: str) -> str:
    """Return what a PLY says of itself, but for comments."""
    head = Path(path).read_bytes().split(b"end_header")[0].decode()
    return "\n".join(line for line in head.splitlines() if not line.startswith("comment"))


def table(path: str) -> Any:
    """Return the numbers of a table, and NaN for empty cells."""
    lines = [line for line in Path(path).read_text(encoding="utf-8").splitlines() if line[0] != "#"]
    return np.array([[float(cell or "nan") for cell in line.split(",")] for line in lines[1:]])


@case(**RESULT)
def batch_of_recordings() -> Answer:
    make("press.h5"), make("turn.h5")
    report = json_of("batch", "press.h5", "turn.h5", "-o", "results")
    counts = {name: report[name] for name in ("failed", "files")} if Path("results").exists() else {}
    kept = {name: io.open_result(f"results/{name}-result.h5") for name in ("press", "turn")}
    alone = {name: io.open_result(make(f"{name}-result.h5")) for name in kept}
    for name, batch_result in kept.items():
        for key, values in batch_result.maps().items():
            np.testing.assert_array_equal(values, alone[name].maps()[key])
    files = [[Path(file["result"]).name, file["message"]] for file in counts["files"]]
    return {
        "failed": counts["failed"],
        "files": files,
        **named(**{n: result_maps(r) for n, r in kept.items()}),
    }


@case(Tolerance(1e-3, 1e-5))
def calibrate_a_gel() -> Answer:
    make("gel-cal.h5")
    learned = json_of("calibrate", "elastic", "gel.h5", "--ball", "10mm", "-o", "again-cal.h5")
    check = json_of("calibrate", "check", "gel.h5", "--ball", "10mm", "--calibration", "gel-cal.h5")
    return {
        "gel": learned["gel"],
        "check": {when: check[when]["height"]["rms"] for when in ("before", "after")},
        "shown": json_of("calibrate", "show", "gel-cal.h5")["numbers"],
    }


@case(**RESULT)
def reconstruct_with_a_gel() -> Answer:
    return result("reconstruct", "gel.h5", "--calibration", "gel-cal.h5")


@case()
def paint_a_board() -> Answer:
    command("calibrate", "board", "--board", "dots:7x5:1mm", "--dpi", "300", "-o", "board.png")
    command("calibrate", "board", "--board", "charuco:7x5:2mm:1.5mm", "--dpi", "300", "-o", "marked.png")
    names = ("board", "marked")
    pictures = {name: cv2.imread(f"{name}.png", cv2.IMREAD_UNCHANGED) for name in names}
    return {name: hashlib.md5(picture.tobytes()).hexdigest() for name, picture in pictures.items()}


@case()
def devices_are_told() -> Answer:
    return {"found": bool(json_of("devices")["devices"])}
