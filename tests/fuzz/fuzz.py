"""Damaged files of every kind, read with the commands: nothing may crash, hang, or end in a traceback.

``make fuzz`` damages every kind of file that a command reads, what a controller says, and the arrays that
public functions are given, and has a process of its own read each. What was accepted is exported in every
format. Every exception but the documented ones counts, and what was neither read nor refused in one line is
kept.
"""

from __future__ import annotations

import argparse
import os
import random
import select
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import mutations
import numpy as np

from mirrorskin.io.formats.registry import export_suffixes

PATIENCE = 30.0
"""Seconds of a processor's time after which a reader hangs, or ten times as many by the clock."""

MEMORY = 4 << 30
"""Bytes that a reader may take, the OpenCL driver's among them."""

AT_ONCE = 3
"""Commands that read each damaged file, besides the functions that do."""

BATCH = """[stack]
pixel-size = "0.1mm"

[press]
threshold = 0.5

[rotation]
tilt = "2.5deg"
"""
REPLIES = b"""
Grbl 1.1h ['$' for help]
ok
$100=250.000
[MSG:Caution: Unlocked]
<Idle|MPos:0.000,1.500,-2.000|FS:0,0|WCO:0.000,0.000,0.000>
error:9
ALARM:1
<Hold:0|MPos:0.000,1.500,-2.000|Bf:15,128|FS:0,0>
"""
TRIANGLES = """solid ball
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 2 0 0
vertex 0 2 1
endloop
endfacet
facet normal 0 0 1
outer loop
vertex 2 0 0
vertex 2 2 0
vertex 0 2 1
endloop
endfacet
endsolid ball
"""
OBJ = "# a roof\nmtllib roof.mtl\nv 0 0 0\nv 2 0 0\nv 0 2 1\nv 2 2 0.5\nf 1 2 3\nf 2/1 4/2/3 3//1\n"
PLY = """ply
format ascii 1.0
comment made by hand
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
2 0 0
0 2 1
2 2 0.5
3 0 1 2
3 1 3 2
"""
OPTIONS = """--travel-step 0.1mm
--pixel-size 0.03mm,0.04mm
--region 2,3,10x8
--frames 1:8
--phase-step 45deg
--tilt 2.5deg
--noise 2.5
--threshold 0.5
--memory 256MB
--dark 10
--bright 180
"""
BOARDS = """charuco:7x5:2mm:1.5mm
dots:11x9:1mm
"""
NAMES = ["\x1b[2J", "$\\frac{$", "\u5de5\u5177", "<b>", "-", "a b"]
"""How names of files may begin."""

EXPORTS = export_suffixes()


def make_samples(folder: Path) -> list[Path]:
    """Write a small file of every kind and packing."""
    from calls import calls, to_bytes

    _make_recordings(folder)
    _make_frames(folder)
    _make_texts(folder)
    for name in calls():
        if arrays := to_bytes(name):
            (folder / f"{name}.call").write_bytes(arrays)
    return sorted(folder.iterdir())


def _make_recordings(folder: Path) -> None:
    """Write recordings, results, a calibration, and what is exported from them."""
    from calibrations import a_calibration
    from commands import run

    from mirrorskin import io

    small = ["--size", "24x20", "--pixel-size", "0.4mm", "-o"]
    for motion in ("vertical", "axial", "horizontal", "twist"):
        for compression in ("raw", "gzip", "bitshuffle"):
            path = folder / f"{motion}-{compression}.h5"
            _do(run("simulate", motion, "--compression", compression, "--frames", 12, *small, path))
        ended = run("reconstruct", folder / f"{motion}-raw.h5", "-o", folder / f"{motion}-result.h5")
        assert ended.code in (0, 1), ended.said  # 1: there is a result, without an answer
    io.save_calibration(a_calibration(), folder / "calibration.h5")
    result = folder / "vertical-result.h5"
    for suffix in (".ply", ".stl", ".zarr", ".npz", ".x3p", ".sur", ".gsf"):
        _do(run("export", result, "-o", folder / f"result{suffix}"))
    for suffix in (".mcap", ".zarr"):
        _do(run("export", folder / "vertical-raw.h5", "-o", folder / f"recording{suffix}"))
    shutil.make_archive(str(folder / "packed.zarr"), "zip", folder / "recording.zarr")


def _do(ended: Any) -> None:
    assert ended.code == 0, ended.said


def _make_frames(folder: Path) -> None:
    """Write frames as other programs do: arrays, pictures, videos, messages."""
    import cv2
    import tifffile
    from mcap_ros2.writer import Writer

    from mirrorskin import io

    with io.open_recording(folder / "vertical-raw.h5") as recording:
        block = recording.read(np.empty(recording.shape, recording.dtype))
        assert block is not None
        frames, travel = block.frames.copy(), recording.travel
    np.save(folder / "frames.npy", frames)
    np.savez(folder / "frames.npz", frames=frames, travel=travel, dark=np.float32(16))
    np.savez_compressed(folder / "packed.npz", frames=frames, travel=travel)
    np.save(folder / "travel.npy", travel)
    np.save(folder / "heights.npy", np.linspace(0, 1, 300).reshape(15, 20))
    cv2.imwrite(str(folder / "picture.png"), frames[-1])
    cv2.imwrite(str(folder / "deep.png"), frames[-1].astype(np.uint16) * 200)
    tifffile.imwrite(folder / "pages.tif", frames[:4], photometric="minisblack", compression="zlib")
    _make_stacks(folder, frames)
    assert travel is not None
    _make_containers(folder, frames, travel)
    tifffile.imwrite(folder / "heights.tif", np.linspace(-1, 0, 480, dtype=np.float32).reshape(20, 24))
    image = "std_msgs/Header header\nstring format\nuint8[] data\n" + "=" * 80
    image += "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
    with (folder / "compressed.mcap").open("wb") as file:
        messages = Writer(file)
        schema = messages.register_msgdef("sensor_msgs/msg/CompressedImage", image)
        for number, frame in enumerate(frames[:4]):
            data = cv2.imencode((".png", ".jpg")[number % 2], frame)[1].tobytes()
            head = {"stamp": {"sec": number, "nanosec": 0}, "frame_id": "a"}
            message = {"header": head, "format": "png", "data": data}
            messages.write_message("/camera", schema, message, number * 10**7)
        messages.finish()


def _make_containers(folder: Path, frames: np.ndarray[Any, Any], travel: np.ndarray[Any, Any]) -> None:
    """Write stacks with coordinates, packed values and named axes, as xarray and MATLAB do."""
    import h5py
    import xarray

    places = {"travel": ("travel", 1000 * travel, {"units": "um"})}
    for name, count, unit in (("y", frames.shape[1], "mm"), ("x", frames.shape[2], "um")):
        places[name] = (name, np.arange(count) * 0.4, {"units": unit})
    dataset = xarray.Dataset({"frames": (("travel", "y", "x"), frames)}, places)
    packed = {"frames": {"dtype": "i2", "scale_factor": 0.5, "add_offset": -3.0, "_FillValue": -1}}
    dataset.astype("f8").to_netcdf(folder / "packed-netcdf.h5", engine="h5netcdf", encoding=packed)
    dataset.transpose("y", "x", "travel").to_netcdf(folder / "named-netcdf.h5", engine="h5netcdf")
    dataset.to_zarr(folder / "xarray.zarr", encoding={"frames": {"_FillValue": 255}}, consolidated=False)
    with h5py.File(folder / "matlab.h5", "w", userblock_size=512) as file:
        file["frames"] = frames.transpose(0, 2, 1).astype(np.float64)
        file["frames"].attrs["MATLAB_class"] = np.bytes_("double")


def _make_stacks(folder: Path, frames: np.ndarray[Any, Any]) -> None:
    """Write TIFFs, pictures and videos of several kinds."""
    import av
    import cv2
    import tifffile

    grey: dict[str, Any] = {"photometric": "minisblack"}
    tifffile.imwrite(folder / "imagej.tif", frames, imagej=True, truncate=True, **grey)
    tifffile.imwrite(
        folder / "channels.tif", np.stack([frames, frames], 1), ome=True, metadata={"axes": "TCYX"}, **grey
    )
    cv2.imwritemulti(str(folder / "lzw.tif"), [*frames[:4]])
    table = np.arange(256, dtype=np.uint16)[None].repeat(3, 0) * 257
    tifffile.imwrite(folder / "table.tif", frames[:4], photometric="palette", colormap=table)
    for name in ("picture.jpg", "picture.bmp", "picture.pgm"):
        cv2.imwrite(str(folder / name), frames[-1].astype(np.uint8))
    kinds = {
        "film.avi": ("mjpeg", "yuvj420p"),
        "film.mp4": ("mpeg4", "yuv420p"),
        "film.mkv": ("ffv1", "gray16le"),
        "film.mov": ("png", "gray16be"),
    }
    for name, (codec, pixels) in kinds.items():
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=25)
            stream.height, stream.width, stream.pix_fmt = 48, 64, pixels
            for number in range(8):
                picture = av.VideoFrame.from_ndarray(np.full((48, 64), 20 * number, np.uint8), "gray")
                container.mux(stream.encode(picture.reformat(format=pixels)))
            container.mux(stream.encode(None))


def _make_texts(folder: Path) -> None:
    """Write settings, tables, meshes and replies."""
    from mirrorskin.hw.base.rig_file import TEMPLATE

    (folder / "rig.toml").write_text(TEMPLATE)
    (folder / "batch.toml").write_text(BATCH)
    (folder / "phases.csv").write_text(
        "".join(f"{30 * number}deg\n" for number in range(11)) + "5.7rad # last\n"
    )
    (folder / "table.csv").write_text("frame;travel [um]\n" + "".join(f"{k};{50 * k}\n" for k in range(12)))
    (folder / "travel.csv").write_text("travel [mm]\n" + "".join(f"{0.1 * number}\n" for number in range(12)))
    (folder / "readings.csv").write_text("recording,newtons\nvertical-raw.h5,1.5\n")
    (folder / "ascii.stl").write_text(TRIANGLES)
    (folder / "ascii.ply").write_text(PLY)
    (folder / "roof.obj").write_text(OBJ)
    (folder / "options.words").write_text(OPTIONS)
    (folder / "boards.words").write_text(BOARDS)
    (folder / "controller.txt").write_bytes(REPLIES)


Line = tuple[object, ...]


def _of_hdf5(path: Path, sound: Path, out: Path) -> list[Line]:
    """Return the commands that read recordings, results and calibrations."""
    press, turn, result = (sound / f"{name}.h5" for name in ("vertical-raw", "axial-raw", "vertical-result"))
    exports = [("export", path, "-o", out / f"a{suffix}") for suffix in EXPORTS]
    return [
        *exports,
        *exports,
        ("info", path),
        ("info", path, "--json"),
        ("info", path, "--verify"),
        ("export", path, "-o", out / "a.ply", "--points", "--turn", 0),
        ("view", path, "-o", out / "a.png"),
        ("view", path, "-o", out),
        ("report", path, "-o", out / "a.html"),
        ("report", path, "-o", out / "a.html"),
        ("measure", path),
        ("measure", path, "--json", "--form", "sphere"),
        ("score", path, "--truth", press),
        ("score", result, "--truth", path),
        ("stitch", path, result, "-o", out / "a.h5", "--overwrite"),
        ("fuse", path, turn, "-o", out / "a.h5", "--overwrite"),
        ("fuse", press, path, "-o", out / "a.h5", "--overwrite"),
        ("correlate", path, "--phase-step", "45deg", "-o", out / "a.h5", "--overwrite"),
        ("reconstruct", path, "-o", out / "a.h5", "--overwrite"),
        (
            "reconstruct",
            path,
            "--motion",
            "vertical",
            "--travel-step",
            "0.1mm",
            "-o",
            out / "a.h5",
            "--overwrite",
        ),
        ("reconstruct", path, "-o", out / "a.zarr"),
        ("reconstruct", path, "-o", out / "a.h5", "--overwrite", "--json", "--method", "change-point"),
        ("reconstruct", press, "--calibration", path, "-o", out / "a.h5", "--overwrite"),
        ("reconstruct", turn, "--heights", path, "-o", out / "a.h5", "--overwrite"),
        ("calibrate", "show", path),
        ("calibrate", "show", path, "-o", out / "maps"),
        ("batch", path, "-o", out / "results"),
    ]


def _of_frames(path: Path, sound: Path, out: Path) -> list[Line]:
    """Return the commands that read frames of other programs."""
    press = ("--motion", "vertical", "--pixel-size", "0.4mm", "-o", out / "a.h5")
    return [
        ("info", path),
        ("info", path, "--channel", 1),
        ("check", path, "--travel-step", "0.1mm", "--dataset", 0, "--channel", 0),
        ("import", path, *press, "--travel-step", "0.1mm"),
        ("import", path, *press),
        ("import", path, *press, "--travel", sound / "travel.csv"),
        ("import", path, "--motion", "axial", "--phase-step", "30deg", "-o", out / "a.h5"),
        ("reconstruct", path, "--travel-step", "0.1mm", "-o", out / "a.h5", "--overwrite"),
        ("correlate", path, "--phase-step", "45deg", "-o", out / "a.h5", "--overwrite"),
    ]


def _of_objects(path: Path, sound: Path, out: Path) -> list[Line]:
    """Return the commands that read meshes, height maps and pictures."""
    small = ("--size", "24x20", "--pixel-size", "0.4mm", "--frames", 3, "-o", out / "a.h5")
    commands = [("simulate", "vertical", "--object", path, *small)]
    if path.suffix in (".png", ".tif", ".jpg", ".bmp", ".pgm"):
        folder = out / "frames"
        folder.mkdir()
        shutil.copy(sound / "picture.png", folder / "frame1.png")
        shutil.copy(path, folder / f"frame2{path.suffix}")
        board = ("--board", "dots:5x4:1mm", "-o", out / "cal.h5")
        commands += [
            ("import", folder, "--motion", "vertical", "--travel-step", "0.1mm", "-o", out / "b.h5"),
            ("simulate", "axial", "--pattern", path, *small),
            ("calibrate", "scale", path, *board),
        ]
    return commands


def _of_tables(path: Path, sound: Path, out: Path) -> list[Line]:
    """Return the commands that read positions and readings."""
    press, out = sound / "vertical-raw.h5", out / "a.h5"
    return [
        ("reconstruct", sound / "frames.npy", "--travel", path, "-o", out, "--overwrite"),
        ("correlate", press, "--phases", path, "-o", out, "--overwrite"),
        ("calibrate", "force", press, "--readings", path, "-o", out),
    ]


def _of_words(path: Path, sound: Path, out: Path) -> list[Line]:
    """Return the commands that take options which a file holds, a line each."""
    press, frames = sound / "vertical-raw.h5", sound / "frames.npy"
    lines = [line.replace("\0", "") for line in path.read_text("utf-8", "replace").splitlines()]
    if path.stem == "boards":
        return [("calibrate", "scale", "board", "--board", line, "-o", out / "a.png") for line in lines] + [
            ("calibrate", "scale", sound / "picture.png", "--board", line, "-o", out / "a.h5")
            for line in lines
        ]
    steps = ("--travel-step", "0.1mm", "-o", out / "a.h5")
    return [
        command
        for line in lines
        for words in [line.partition(" ")]
        for command in (
            ("reconstruct", press, "-o", out / "a.h5", "--overwrite", words[0], words[2]),
            ("reconstruct", frames, *steps, words[0], words[2]),
            ("view", sound / "vertical-result.h5", "-o", out / "a.png", "--section", words[2]),
        )
    ]


Commands = Callable[[Path, Path, Path], list[Line]]
COMMANDS: dict[str, list[Commands]] = {
    ".h5": [_of_hdf5],
    ".zarr": [_of_hdf5],
    ".zip": [_of_hdf5],
    **{key: [_of_hdf5] for key in (".x3p", ".sur", ".gsf")},
    ".mcap": [_of_frames],
    ".npz": [_of_frames],
    ".npy": [_of_frames, _of_objects, _of_tables],
    ".png": [_of_objects],
    ".tif": [_of_frames, _of_objects],
    **{key: [_of_objects] for key in (".jpg", ".bmp", ".pgm")},
    **{key: [_of_frames] for key in (".avi", ".mp4", ".mkv", ".mov")},
    ".stl": [_of_objects],
    ".ply": [_of_objects],
    ".obj": [_of_objects],
    ".csv": [_of_tables],
    ".words": [_of_words],
}
"""The commands that read files, by their suffix."""


def read(path: str, sound: Path | None = None) -> bool:
    """Read a file in every way, and with some of the commands; return whether one of them accepted it.

    Commands need a folder of sound files.
    """
    from mirrorskin import engine, io
    from mirrorskin.kernels.errors import DeviceError

    good = False
    for reader in _readers(Path(path).suffix):
        try:
            reader(path)
            good = True
        except (io.InputError, engine.NotConverged, DeviceError) as error:
            text = str(error)
            if "\n" in text or len(text) > 1000:
                raise AssertionError(f"no line: {text[:200]}") from error
    if sound is not None:
        good |= _command(Path(path), sound)
    return good


def _readers(suffix: str) -> list[Callable[[Any], object]]:
    from calls import call_with

    from mirrorskin import io
    from mirrorskin.cli.settings import read_settings
    from mirrorskin.cli.stack import read_phases, read_travel
    from mirrorskin.hw.base.rig_file import load_rig
    from mirrorskin.twin.object_files import load_height_map

    stores = [io.describe, io.open_heights, io.open_result, io.open_calibration, reconstruct, show]
    readers: dict[str, list[Callable[[Any], object]]] = {
        ".h5": stores,
        ".zarr": stores,
        ".zip": stores,
        **{key: [io.describe, io.open_heights, io.open_result, show] for key in (".x3p", ".sur", ".gsf")},
        ".toml": [load_rig, lambda path: read_settings(Path(path), 1 << 28)],
        ".csv": [lambda path: read_phases(Path(path)), lambda path: read_travel(Path(path))],
        ".npy": [lambda path: load_height_map(path, (0.1, 0.1))],
        ".txt": [listen],
        ".call": [lambda path: call_with(Path(path).stem, Path(path).read_bytes())],
    }
    return readers.get(suffix, [])


def _command(path: Path, sound: Path) -> bool:
    """Run some commands on a file; return whether one of them did it."""
    from commands import run

    data = path.read_bytes() if path.is_file() else str(path).encode()
    chance, good = random.Random(zlib.crc32(data)), False
    for _ in range(AT_ONCE):
        with tempfile.TemporaryDirectory() as folder:
            choices = [
                command
                for make in COMMANDS.get(path.suffix, [])
                for command in make(path, sound, Path(folder))
            ]
            if not choices:
                return good
            words = chance.choice(choices)
            try:
                ended = run(*words)
            except BaseException as error:
                raise AssertionError(f"mirrorskin {' '.join(map(str, words))[:200]}") from error
        text = ended.out + ended.said
        if ended.code not in (0, 1, 2) or not text.replace("\n", "").isprintable():
            raise AssertionError(f"mirrorskin {' '.join(map(str, words))[:200]}: {ended.code} {text[:200]!r}")
        lines = ended.said.splitlines()
        stated = bool(lines) and lines[-1].startswith("mirrorskin: ")
        if ended.code == 1:  # a result without an answer
            stated = stated or any(line.startswith("warning: ") for line in lines)
        if ended.code and words[0] != "batch" and not stated:
            raise AssertionError(
                f"mirrorskin {' '.join(map(str, words))[:200]}: no reason {ended.said[:200]!r}"
            )
        good |= ended.code == 0
    return good


def show(path: str) -> None:
    """Show a result as notebooks do."""
    from mirrorskin import io

    result = io.open_result(path)
    assert str(result)
    assert result._repr_html_()
    assert result.to_xarray().sizes is not None


def reconstruct(path: str) -> object:
    """Do what ``mirrorskin reconstruct`` does."""
    from mirrorskin import engine, io

    with io.open_recording(path) as recording:
        return engine.reconstruct(recording)


def listen(path: str) -> None:
    """Hear what a controller says, in pieces as they arrive."""
    from mirrorskin.hw.stages.replies import Splitter, parse, salvage

    data, splitter = Path(path).read_bytes(), Splitter()
    for at in range(0, len(data), 7):
        for line, _ in splitter.feed(data[at : at + 7], at / 1000):
            parse(line)
            salvage(line)


def serve(sound: Path | None) -> None:
    """Read the files that are named on standard input, and say how it went."""
    import resource
    import traceback

    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    answers = sys.stdout
    for line in sys.stdin:
        try:
            outcome = "read" if read(line.rstrip("\n"), sound) else "refused"
        except BaseException as error:
            cause = error.__cause__ if isinstance(error, AssertionError) and error.__cause__ else error
            lines = "".join(traceback.format_exception(cause, chain=False)).splitlines()[-16:]
            outcome = f"traceback {error} | " + " | ".join(
                line.strip() for line in lines if line.strip("^~ ")
            )
            outcome = " ".join(outcome.split())
        print(outcome, file=answers, flush=True)


class Reader:
    """A process that reads files, begun anew when it did not survive one."""

    def __init__(self, sound: Path | None = None) -> None:
        self._words = ["--serve", *([] if sound is None else ["--sound", str(sound)])]
        self._process: subprocess.Popen[str] | None = None

    def read(self, path: Path) -> str:
        """Return "read", "refused", or what is wrong."""
        if self._process is None:
            command = [sys.executable, __file__, *self._words]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):
            process.stdin.write(f"{path}\n")
            process.stdin.flush()
        ready = self._wait(process)
        text = process.stdout.readline().rstrip("\n") if ready else "hang"
        if text and ready:
            return text
        if ready:
            text = f"crash {process.wait()}"
        self.close()
        return text

    def _wait(self, process: subprocess.Popen[str]) -> bool:
        """Wait for an answer; return whether it came."""
        assert process.stdout is not None
        end, begun = time.monotonic() + 10 * PATIENCE, _processor_time(process.pid)
        while time.monotonic() < end and _processor_time(process.pid) < begun + PATIENCE:
            if select.select([process.stdout], [], [], PATIENCE / 10)[0]:
                return True
        return False

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            with suppress(BrokenPipeError), self._process:
                self._process = None


def _processor_time(process: int) -> float:
    """Return the seconds that a process has computed, on all processors together."""
    with suppress(OSError):
        numbers = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, numbers[11:13])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def attack(
    samples: list[Path], seed: int, go_on: Callable[[int], bool], keep: Path
) -> Iterator[tuple[str, str]]:
    """Yield each damaged file's kind and outcome."""
    whole = {path: path.read_bytes() for path in samples if path.is_file()}
    reader, number = Reader(samples[0].parent), 0
    with tempfile.TemporaryDirectory() as folder:
        while go_on(number):
            chance = random.Random(f"{seed} {number}")
            sample = chance.choice(samples)
            odd = sample.suffix not in (".call", ".words") and chance.random() < 0.2
            mutant = Path(folder) / f"{chance.choice(NAMES) if odd else ''}{sample.name}"
            if sample.is_dir():
                damage_store(sample, mutant, chance)
            else:
                mutant.write_bytes(mutations.mutate(sample, whole, chance))
            outcome = reader.read(mutant)
            if outcome not in ("read", "refused"):
                keep.mkdir(parents=True, exist_ok=True)
                shutil.move(mutant, keep / f"{seed}-{number}-{sample.name}")
            elif mutant.is_dir():
                shutil.rmtree(mutant)
            number += 1
            yield sample.suffix, outcome
    reader.close()


def damage_store(sample: Path, mutant: Path, chance: random.Random) -> None:
    """Copy a folder, and drop or damage one of its files."""
    shutil.copytree(sample, mutant)
    victim = chance.choice(sorted(path for path in mutant.rglob("*") if path.is_file()))
    data = victim.read_bytes()
    if chance.random() < 0.1:
        victim.unlink()
    elif victim.suffix == ".json" and chance.random() < 0.7:
        victim.write_bytes(mutations.change_json(data, chance))
    else:
        victim.write_bytes(mutations.damage(data, chance))


def main() -> int:
    """Attack, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--serve", action="store_true")
    parser.add_argument("--sound", type=Path)
    parser.add_argument("--kinds", nargs="*", help="suffixes of the files to damage, instead of all")
    options = parser.parse_args()
    if options.serve:
        serve(options.sound)
        return 0
    end = time.monotonic() + 60 * options.minutes
    counts_by_kind: dict[str, Counter[str]] = {}

    def go_on(number: int) -> bool:
        return number < options.count if options.count is not None else time.monotonic() < end

    with tempfile.TemporaryDirectory() as folder:
        samples = make_samples(Path(folder))
        if options.kinds:
            samples = [path for path in samples if path.suffix in options.kinds]
        for kind, outcome in attack(samples, options.seed, go_on, options.keep):
            word = outcome.split()[0]
            counts_by_kind.setdefault(kind, Counter())[word] += 1
            if word not in ("read", "refused"):
                print(kind, outcome, flush=True)
    words = ("read", "refused", "traceback", "hang", "crash")
    print(f"| file | damaged | {' | '.join(words)} |\n|---|{'---|' * (len(words) + 1)}")
    for kind, counts in sorted(counts_by_kind.items()):
        print(f"| {kind} | {counts.total()} | {' | '.join(str(counts[word]) for word in words)} |")
    return int(any(counts.total() > counts["read"] + counts["refused"] for counts in counts_by_kind.values()))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent / "support"))
    sys.exit(main())
