"""Batches ended at random moments: how often, which, and the state that must remain."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import stacks

from mirrorskin import io
from mirrorskin.engine.batch import worker
from mirrorskin.engine.batch.jobs import Job
from mirrorskin.engine.batch.work import Outcome
from mirrorskin.twin import Axial, Body, Camera, Twin

PRESSES, TURNS = 6, 1
_ONCE = (7,)
_COMMAND = [sys.executable, "-P", "-c", "from mirrorskin.cli.main import main; main()", "batch"]
_START = 60  # seconds, for a busy machine
_HEADINGS = ("what", "seed", "whole then", "done after", "seconds")


def seeds() -> tuple[int, ...]:
    """Return one seed that is always the same, or as many at random as MIRRORSKIN_SOAK says.

    The random ones follow from MIRRORSKIN_SOAK_SEED, where it is set.
    """
    rounds = int(os.environ.get("MIRRORSKIN_SOAK", "0"))
    if not rounds:
        return _ONCE
    first = int(os.environ.setdefault("MIRRORSKIN_SOAK_SEED", str(time.time_ns() % 1_000_000)))
    return tuple(random.Random(first).sample(range(1_000_000), rounds))


@dataclass(frozen=True, slots=True)
class Round:
    """What one disturbed batch came to: results on disk when it ended, and what was done after that."""

    what: str
    seed: int
    whole: int
    after: int
    seconds: float


ROUNDS: list[Round] = []


def table() -> list[str]:
    """Return the rounds so far, a line each, and how many there were of a kind."""
    rows = [
        (round_.what, *map(str, (round_.seed, round_.whole, round_.after)), f"{round_.seconds:.1f}")
        for round_ in ROUNDS
    ]
    widths = [max(map(len, column)) for column in zip(_HEADINGS, *rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (_HEADINGS, *rows)
    ]


def make_recordings(folder: Path) -> list[Path]:
    """Record the twin's presses and turns on a ball, each with noise of its own."""
    files = []
    for seed in range(PRESSES + TURNS):
        turn = seed >= PRESSES
        files.append(folder / f"{'turn' if turn else 'press'}-{seed}.h5")
        stacks.record(_turn(seed) if turn else _press(seed), files[-1], block=8)
    return files


def _press(seed: int) -> Twin:
    return stacks.ball((48, 64), (0.1, 0.1), np.arange(24) * 0.05, seed=seed)


def _turn(seed: int) -> Twin:
    return Twin(
        object="sphere",
        shape=(20, 24),
        pixel_size=(0.1, 0.1),
        movement=Axial(np.arange(8) * np.pi / 4, np.radians(2.5), press=1.45),
        pattern="linear",
        body=Body(height=1e5, scatter=0.0),
        camera=Camera(seed=seed),
    )


class Batch:
    """``mirrorskin batch`` in a process group of its own, told to stop at any moment."""

    def __init__(self, recordings: list[Path], folder: Path, *words: str) -> None:
        self.folder = folder
        self._child = subprocess.Popen(
            [*_COMMAND, *map(str, recordings), "-o", str(folder), *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def end(self, number: signal.Signals, results: int, delay: float, all_of_it: bool = False) -> str:
        """Send a signal so many seconds after so many results are there; return what it complained of.

        ``all_of_it`` sends it to all processes of the batch, as the terminal does with Ctrl-C.
        """
        deadline = time.monotonic() + _START
        while self._child.poll() is None and not self._is_under_way(results):
            assert time.monotonic() < deadline, "the batch does not come to work"
            time.sleep(0.002)
        time.sleep(delay)
        (os.killpg if all_of_it else os.kill)(self._child.pid, number)
        return self._child.communicate(timeout=_START)[1]

    def _is_under_way(self, results: int) -> bool:
        return self.folder.is_dir() and len(list(self.folder.glob("*-result.h5"))) >= results

    @property
    def code(self) -> int:
        """How it ended: minus the signal that killed it, or its exit code."""
        return self._child.returncode


def results(folder: Path) -> dict[str, tuple[int, int]]:
    """Return which file each result is, by its name: that it was written again would show."""
    stats = {path.name: path.stat() for path in folder.glob("*-result.h5")}
    return {name: (status.st_ino, status.st_mtime_ns) for name, status in stats.items()}


def leftovers(folder: Path) -> list[Path]:
    """Return the half-written files of a folder."""
    return list(folder.glob(".mirrorskin-*"))


def data(path: Path) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
    """Return every array of a result to the last bit, and every word of how it came about but the date."""
    io.open_result(path)  # it is a whole result
    states = {}

    def keep(name: str, item: h5py.HLObject) -> None:
        if isinstance(item, h5py.Dataset) and name != "entry/process/date":
            value = np.asarray(item[()])
            kept = repr(item[()]).encode() if value.dtype.hasobject else value.tobytes()
            states[name] = str(item.dtype), item.shape, kept

    with h5py.File(path) as file:
        file.visititems(keep)
    return states


def all_data(folder: Path) -> dict[str, dict[str, tuple[str, tuple[int, ...], bytes]]]:
    """Return the same of each result in a folder, by its name."""
    return {path.name: data(path) for path in sorted(folder.glob("*-result.h5"))}


def die_with(recording: str, delay: float, mark: Path) -> None:
    """Let this process end so many seconds into a recording, or when that is done and not yet told.

    It does so unless the mark is there, which says how many results were there then.
    """
    run_job = worker.run_job

    def end() -> None:
        mark.write_text(str(len(results(mark.parent))))
        os.kill(os.getpid(), signal.SIGKILL)

    def die(job: Job, *rest: Any) -> Outcome:
        if job.source.name != recording or mark.exists():
            return run_job(job, *rest)
        threading.Timer(delay, end).start()
        run_job(job, *rest)
        time.sleep(_START)
        raise AssertionError("it should have ended")

    worker.run_job = die
