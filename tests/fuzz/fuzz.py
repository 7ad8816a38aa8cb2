"""Damaged files of every kind, read as users read them: nothing may crash, hang, or end in a traceback.

``make fuzz`` damages recordings, results, calibrations, settings, lists of phases, height maps, what a
controller says, and the arrays that public functions are given, and has a process of its own read each. What
is neither read nor refused in one line is kept.
"""

from __future__ import annotations

import argparse
import random
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

PATIENCE = 20.0
"""Seconds after which a reader hangs."""

MEMORY = 4 << 30
"""Bytes that a reader may take, the OpenCL driver's among them."""

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

NUMBERS = [0, 1, 2, 7, 8, 0xFF, 1 << 15, 1 << 31, (1 << 31) - 1, (1 << 32) - 1, 1 << 62, (1 << 63) - 1]


def make_samples(folder: Path) -> list[Path]:
    """Write a small file of every kind and packing."""
    from calibrations import a_calibration
    from calls import calls, to_bytes
    from commands import run

    from mirrorskin import io
    from mirrorskin.hw.rig_file import TEMPLATE

    small = ["--size", "24x20", "--pixel-size", "0.4mm", "-o"]
    for motion in ("vertical", "axial", "horizontal", "twist"):
        for compression in ("raw", "gzip", "bitshuffle"):
            path = folder / f"{motion}-{compression}.h5"
            ended = run("simulate", motion, "--compression", compression, "--frames", 12, *small, path)
            assert ended.code == 0, ended.said
    for motion in ("vertical", "axial"):
        ended = run("reconstruct", folder / f"{motion}-raw.h5", "-o", folder / f"{motion}-result.h5")
        assert ended.code == 0, ended.said
    io.save_calibration(a_calibration(), folder / "calibration.h5")
    (folder / "rig.toml").write_text(TEMPLATE)
    (folder / "batch.toml").write_text(BATCH)
    (folder / "phases.csv").write_text("0deg\n45deg 90.5deg\n3.1rad # last\n")
    (folder / "controller.txt").write_bytes(REPLIES)
    for name in calls():
        if arrays := to_bytes(name):
            (folder / f"{name}.call").write_bytes(arrays)
    np.save(folder / "heights.npy", np.linspace(0, 1, 300).reshape(15, 20))
    return sorted(folder.iterdir())


def damage(data: bytearray, chance: random.Random) -> str:
    """Damage a file in one of the ways that files are; return which."""
    kind = chance.choice(["bits", "bytes", "number", "copy", "zeros", "cut"])
    for _ in range(chance.choice([1, 1, 1, 2, 4, 16])):
        at = chance.randrange(len(data))
        if kind == "bits":
            data[at] ^= 1 << chance.randrange(8)
        elif kind == "bytes":
            data[at] = chance.randrange(256)
        elif kind == "number":
            width, number = chance.choice([2, 4, 8]), chance.choice(NUMBERS)
            data[at : at + width] = (number % (1 << 8 * width)).to_bytes(width, "little")
        elif kind == "copy":
            start, length = chance.randrange(len(data)), chance.choice([8, 64, 512])
            data[at : at + length] = data[start : start + length]
        elif kind == "zeros":
            data[at : at + chance.choice([8, 64, 512])] = bytes(8)
        else:
            del data[at:]
            break
    return kind


def read(path: str) -> bool:
    """Read a file in every way; tell whether one of them took it for good."""
    from calls import call_with

    from mirrorskin import engine, io
    from mirrorskin.cli.settings import read_settings
    from mirrorskin.cli.stack import read_phases
    from mirrorskin.hw.rig_file import load_rig
    from mirrorskin.hw.twin.object_files import load_height_map
    from mirrorskin.kernels.errors import DeviceError

    good = False
    readers: dict[str, list[Callable[[Any], object]]] = {
        ".h5": [io.describe, io.open_heights, io.open_result, io.open_calibration, reconstruct],
        ".toml": [load_rig, lambda path: read_settings(Path(path), 1 << 28)],
        ".csv": [lambda path: read_phases(Path(path))],
        ".npy": [lambda path: load_height_map(path, (0.1, 0.1))],
        ".txt": [listen],
        ".call": [lambda path: call_with(Path(path).stem, Path(path).read_bytes())],
    }
    for reader in readers[Path(path).suffix]:
        try:
            reader(path)
            good = True
        except (io.InputError, engine.NotConverged, DeviceError) as error:
            said = str(error)
            if "\n" in said or len(said) > 1000:
                raise AssertionError(f"no line: {said[:200]}") from error
    return good


def reconstruct(path: str) -> object:
    """Do what ``mirrorskin reconstruct`` does."""
    from mirrorskin import engine, io

    with io.open_recording(path) as recording:
        return engine.reconstruct(recording)


def listen(path: str) -> None:
    """Hear what a controller says, in pieces as they arrive."""
    from mirrorskin.hw.grbl.replies import Splitter, parse, salvage

    data, splitter = Path(path).read_bytes(), Splitter()
    for at in range(0, len(data), 7):
        for line, _ in splitter.feed(data[at : at + 7], at / 1000):
            parse(line)
            salvage(line)


def serve() -> None:
    """Read the files that are named on standard input, and say how it went."""
    import resource
    import traceback

    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    for line in sys.stdin:
        try:
            outcome = "read" if read(line.rstrip("\n")) else "refused"
        except BaseException:
            outcome = "traceback " + " | ".join(traceback.format_exc().splitlines()[-4:])
        print(outcome, flush=True)


class Reader:
    """A process that reads files, begun anew when it did not survive one."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def read(self, path: Path) -> str:
        """Return "read", "refused", or what is wrong."""
        if self._process is None:
            command = [sys.executable, __file__, "--serve"]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):
            process.stdin.write(f"{path}\n")
            process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], PATIENCE)
        said = process.stdout.readline().rstrip("\n") if ready else "hang"
        if said and ready:
            return said
        if ready:
            said = f"crash {process.wait()}"
        self.close()
        return said

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            with suppress(BrokenPipeError), self._process:
                self._process = None


def attack(
    samples: list[Path], seed: int, go_on: Callable[[int], bool], keep: Path
) -> Iterator[tuple[str, str]]:
    """Yield each damaged file's kind and outcome."""
    whole = {path: path.read_bytes() for path in samples}
    reader, number = Reader(), 0
    with tempfile.TemporaryDirectory() as folder:
        while go_on(number):
            chance = random.Random(f"{seed} {number}")
            sample = chance.choice(samples)
            data = bytearray(whole[sample])
            damage(data, chance)
            mutant = Path(folder) / sample.name
            mutant.write_bytes(data)
            outcome = reader.read(mutant)
            if outcome not in ("read", "refused"):
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{seed}-{number}-{sample.name}").write_bytes(data)
            number += 1
            yield sample.suffix, outcome
    reader.close()


def main() -> int:
    """Attack, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--serve", action="store_true")
    given = parser.parse_args()
    if given.serve:
        serve()
        return 0
    end = time.monotonic() + 60 * given.minutes
    found: dict[str, Counter[str]] = {}

    def go_on(number: int) -> bool:
        return number < given.count if given.count is not None else time.monotonic() < end

    with tempfile.TemporaryDirectory() as folder:
        for kind, outcome in attack(make_samples(Path(folder)), given.seed, go_on, given.keep):
            word = outcome.split()[0]
            found.setdefault(kind, Counter())[word] += 1
            if word not in ("read", "refused"):
                print(kind, outcome, flush=True)
    words = ("read", "refused", "traceback", "hang", "crash")
    print(f"| file | damaged | {' | '.join(words)} |\n|---|{'---|' * (len(words) + 1)}")
    for kind, counts in sorted(found.items()):
        print(f"| {kind} | {counts.total()} | {' | '.join(str(counts[word]) for word in words)} |")
    return int(any(counts.total() > counts["read"] + counts["refused"] for counts in found.values()))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent / "support"))
    sys.exit(main())
