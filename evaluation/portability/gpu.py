"""Try a GPU in ten minutes: ``make gpu``; on a machine without network ``gpu.sh WHEELS``.

``gpu.py [RUN.json] [--seconds 540]``: copies and launches, every public call at 1 Mpx and at 4K, the frozen
answers of the CPU, and the device tests, in this order. The results are written to the JSON file, and to a
page beside it, after each section; a section that finds no time left is skipped. The device is the one that
OpenCL offers first, or that PYOPENCL_CTX names; one that is no GPU is treated as one with memory of its own,
and its times mean nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

from mirrorskin.cli.commands.bench.limits import measure_limits
from mirrorskin.cli.commands.bench.records import describe_run
from mirrorskin.evaluation.portability import gpu_calls
from mirrorskin.evaluation.portability.gpu_check import ROOT, from_tests, frozen_cases, taken_for_gpu
from mirrorskin.kernels.device import Device, list_devices, open_device
from mirrorskin.kernels.mapping import Mapping

LOOSER = 10  # times the tolerance of the frozen answers, which are those of one machine's arithmetic
FEW = 1e-3  # of an array may differ by more: pixels on the other side of a threshold
NO_CONTACT = re.compile(r"vectors|normals|azimuth|zenith|sigma|residual|process")  # these mean nothing there
COPIED = 64 << 20  # bytes
ROUNDS = 10
Data = dict[str, Any]


class Trial:
    """The sections that were run, and the time that is left."""

    def __init__(self, device: Device, output: Path, seconds: float) -> None:
        self.device, self.output, self.end = device, output, time.monotonic() + seconds
        self.quick = device.info.kind != "gpu"
        self.data: Data = {}

    @property
    def left(self) -> float:
        """Seconds."""
        return self.end - time.monotonic()

    def run(self, name: str, section: Callable[[Trial, float], object], seconds: float) -> None:
        """Run a section within so many seconds, and write what is known by then."""
        start, limit = time.monotonic(), min(seconds, self.left)
        if limit < 5:
            self.data[name] = "no time left"
        else:
            try:
                self.data[name] = section(self, start + limit)
            except Exception:
                self.data[name] = {"failed": traceback.format_exc()}
        print(f"{name}: {time.monotonic() - start:.0f} s", flush=True)
        self.write()

    def write(self) -> None:
        """Write all results so far."""
        self.output.write_text(json.dumps(self.data, indent=1, default=str) + "\n", encoding="utf-8")
        self.output.with_suffix(".md").write_text(page(self.data), encoding="utf-8")


def main() -> int:
    """Run all sections."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", default="gpu.json", metavar="RUN.json", type=Path)
    parser.add_argument("--seconds", type=float, default=540, help="time for everything")
    words = parser.parse_args()
    device = open_device()
    number = next(i for i, info in enumerate(list_devices()) if info.title == device.info.title)
    trial = Trial(device, words.output, words.seconds)
    run = describe_run(device, [], trial.quick)
    trial.data["run"] = {**json.loads(run.as_json()), "title": run.title}
    layout = f"{device.info.kind}{number}-copied-gpu"
    taken_for_gpu(device)
    shapes = ((96, 128), (128, 160)) if trial.quick else (gpu_calls.MEGAPIXEL, gpu_calls.UHD)
    trial.run("device", measure_device, 40)
    trial.run("calls at 1 Mpx", lambda trial, end: measure_calls(trial, end, shapes[0], 64), 120)
    trial.run("calls at 4K", lambda trial, end: measure_calls(trial, end, shapes[1], 240), 90)
    trial.run("answers", compare_answers, 170)
    trial.run("tests", lambda trial, end: run_tests(layout, end), 200)
    print(trial.output.with_suffix(".md").read_text(encoding="utf-8"))
    return 0 if is_right(trial.data) else 1


def is_right(data: Data) -> bool:
    """Whether all calls, answers and tests are as they should be."""
    failed = [row for name in data if name.startswith("calls") for row in data[name] if "failed" in row]
    return not (failed or any(data["answers"].values()) or not re.match(r"\d+ passed[^;]*$", data["tests"]))


def measure_device(trial: Trial, end: float) -> dict[str, float]:
    """Measure copies and launches, and the device's memory and arithmetic."""
    size = COPIED >> (6 * trial.quick)
    rows = {**measure_copies(trial.device, size), **measure_launches(trial.device)}
    case = measure_limits(trial.device, (1 << 30) >> (8 * trial.quick), 1 if trial.quick else ROUNDS)
    for row in case.rows:
        if row.bytes:
            rows[f"{row.name}, GB/s in kernels"] = row.kernel_bandwidth / 1e9
        elif row.operations:
            rows[f"{row.name}, Tflop/s"] = 2 * row.operations / row.kernel / 1e12
    return rows


def measure_copies(device: Device, size: int) -> dict[str, float]:
    """Measure copies from and to both kinds of memory on the host, and on the host itself."""
    array, plain = device.array("copied", (size,), np.uint8), np.ones(size, np.uint8)
    buffer, flags = array.buffer, cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
    pinned = np.asarray(
        Mapping(device.copies, cl.Buffer(device.context, flags, size), (size,), np.dtype(np.uint8))
    )
    pinned[:] = 1
    seconds = {
        f"{name} {direction}": median(partial(cl.enqueue_copy, device.queue, *pair))
        for name, host in (("pageable", plain), ("pinned", pinned))
        for direction, pair in (("up", (buffer, host)), ("down", (host, buffer)))
    }

    def write() -> None:
        array.write(plain)
        array.read(0)  # waits

    seconds |= {"staged up": median(write), "staged down": median(array.read)}
    other = np.empty_like(plain)
    parts = np.split(other, 4), np.split(plain, 4)
    seconds["host to host, one thread"] = median(partial(np.copyto, other, plain))
    with ThreadPoolExecutor(4) as pool:
        seconds["host to host, four threads"] = median(lambda: list(pool.map(np.copyto, *parts)))
    rows = {f"{name}, GB/s": size / 1e9 / each for name, each in seconds.items()}
    allocation = median(lambda: device.array("room", (size,), np.uint8, zeroed=False))
    return {**rows, "an array of 64 MB, us": 1e6 * allocation}


def measure_launches(device: Device) -> dict[str, float]:
    """Measure what it takes to start a kernel and to wait for it."""
    few, word = device.array("few", (64,), np.uint32), np.zeros(1, np.uint32)
    kernel = device.kernel("limits", "copy_all", STRIDE=1, LANES=4, WORDS=1)

    def launch(count: int) -> None:
        for _ in range(count):
            kernel(1, words=few, count=1, moved=32)
        device.finish()

    single, many = median(partial(launch, 1)), median(partial(launch, 1000))
    return {
        "a launch and a wait, us": 1e6 * single,
        "a further launch, us": 1e6 * (many - single) / 999,
        "4 bytes down, us": 1e6 * median(partial(cl.enqueue_copy, device.queue, word, few.buffer)),
    }


def median(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Return the median seconds of a work after one round that does not count."""
    seconds = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[1:]))


def measure_calls(trial: Trial, end: float, shape: tuple[int, int], frames: int) -> list[Data]:
    """Time every public call, as long as there is time."""
    rows: list[Data] = []
    calls = gpu_calls.calls(shape, trial.device, frames if not trial.quick else 16)
    while time.monotonic() < end:
        try:
            name, call = next(calls)
        except StopIteration:
            return rows
        except Exception:
            return [*rows, {"call": "the next one", "failed": traceback.format_exc()}]
        try:
            rows.append(gpu_calls.measure(name, call, trial.device, ROUNDS, 3.0))
        except Exception:
            rows.append({"call": name, "failed": traceback.format_exc()})
        print(f"  {name}: {rows[-1].get('ms', 'failed')}", flush=True)
    return [*rows, {"call": "the others", "failed": "no time left"}]


def run_tests(layout: str, end: float) -> str:
    """Run the kernels' tests on one device in one way of holding memory; return pytest's last line."""
    words = f"-q -n auto -p no:cacheprovider -p no:benchmark -m device -k {layout} tests/kernels".split()
    command = [sys.executable, "-P", "-m", "pytest", *words]
    try:
        limit = end - time.monotonic()
        process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return f"not done within {limit:.0f} s"
    *lines, last = process.stdout.strip().splitlines() or ["pytest says nothing"]
    wrong = [line for line in lines if re.match(r"FAILED|ERROR|E  ", line)]
    return "; ".join(
        [last.partition(" in ")[0], *wrong, *([process.stderr[-2000:]] if process.stderr else [])]
    )


def compare_answers(trial: Trial, end: float) -> dict[str, dict[str, str]]:
    """Run the frozen cases; return how each one's arrays differ from the frozen ones, where they do."""
    differences: dict[str, dict[str, str]] = {}
    golden = from_tests("golden")
    frozen_answers = golden.load()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, _ in frozen_cases():
            if time.monotonic() > end:
                differences[name] = {"not run": "no time left"}
                continue
            try:
                answers, frozen = golden.answers(name), frozen_answers[name]
            except ModuleNotFoundError as error:
                differences[name] = {"not run": str(error)}
                continue
            except Exception as error:  # the next ones are tried all the same
                differences[name] = {"fails with": f"{type(error).__name__}: {error}"}
                continue
            within = {key: golden.CASES[name].within(key, frozen) for key in answers}
            texts = {key: differs(answers, frozen, key, within[key]) for key in answers}
            differences[name] = {key: words for key, words in texts.items() if words}
    return differences


def differs(answers: dict[str, Any], frozen: dict[str, Any], key: str, within: tuple[float, float]) -> str:
    """Say how an array differs in more than a few pixels; nothing where it does not."""
    mine, theirs, loose = answers[key], frozen[key], (LOOSER * within[0], LOOSER * within[1])
    contact = frozen.get(".".join([*key.split(".")[:-1], "contact"]), np.array(True))
    if NO_CONTACT.search(key) and contact.ndim == 2 and contact.shape == mine.shape[:2] == theirs.shape[:2]:
        mine, theirs = mine[contact != 0], theirs[contact != 0]
    same, text = from_tests("golden").compare(mine, theirs, loose)
    if same or mine.shape != theirs.shape or mine.dtype.kind == "U":
        return "" if same else text
    wrong = ~np.isclose(mine.astype(float), theirs.astype(float), *loose, equal_nan=True)
    return "" if np.mean(wrong) <= FEW else f"{text}; {np.count_nonzero(wrong)} of {wrong.size} by too much"


def page(data: Data) -> str:
    """Return the results in Markdown."""
    lines = [f"# {data['run']['title']}", ""]
    for name, section in data.items():
        if name == "run":
            continue
        lines += [f"## {name[0].upper()}{name[1:]}", ""]
        if isinstance(section, str) or "failed" in section:
            lines += [str(section), ""]
        elif name == "device":
            lines += ["| what | measured |", "|---|---|"]
            lines += [f"| {key} | {value:.3g} |" for key, value in section.items()] + [""]
        elif name == "answers":
            wrong = {key: arrays for key, arrays in section.items() if arrays}
            lines += [f"{len(section) - len(wrong)} of {len(section)} are the CPU's.", ""]
            lines += [
                f"- {case}: {key} {words}" for case, arrays in wrong.items() for key, words in arrays.items()
            ]
            lines += [""]
        else:
            lines += [*table(section), ""]
    return "\n".join(lines)


def table(rows: list[Data]) -> list[str]:
    """Return calls in Markdown."""
    lines = [
        "| call | first, ms | ms | launches | in kernels, ms | up, MB (copies) | down, MB (copies)"
        " | waits | longest, ms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if "failed" in row:
            lines.append(f"| {row['call']} | failed: {row['failed'].strip().splitlines()[-1]} ||||||||")
            continue
        longest = ", ".join(f"{name} {ms:.3g}" for name, (_, ms) in [*row["longest"].items()][:3])
        lines.append(
            f"| {row['call']} | {row['first_ms']:.0f} | {row['ms']:.2f} | {row['kernels']}"
            f" | {row['kernel_ms']:.2f} | {row['upload_MB']:.1f} ({row['uploads']})"
            f" | {row['download_MB']:.1f} ({row['downloads']}) | {row['waits']} | {longest} |"
        )
    return lines


if __name__ == "__main__":
    sys.exit(main())
