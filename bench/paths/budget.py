"""How much memory a path takes when its file is ten times as large as the budget."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import hdf5plugin

from mirrorskin import io
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.ours import OURS
from mirrorskin.bench.paths import files
from mirrorskin.bench.paths.child import Memory, is_told
from mirrorskin.bench.paths.equal import check_equal
from mirrorskin.bench.paths.press import make_press, maps_of, search_of
from mirrorskin.bench.results import Case, Target
from mirrorskin.engine.streaming import push_block
from mirrorskin.io.layout import SERIES, STACK
from mirrorskin.kernels.device import Device, DeviceInfo, list_devices

Write = Callable[[files.Frames, Path], None]

_MORE = 1.1  # of the budget that may be taken
_TIMES = 10  # by which a file is larger
_CHILD = "from mirrorskin.bench.paths.child import main; main()"
_FEW = 8  # frames that are reconstructed before
_PIECE = 8  # of the chunks that are long in time: parts of the picture along either axis, and of the stack
_MAPS = 64  # bytes a pixel for all maps


@dataclass(frozen=True, slots=True)
class BudgetCase(files.FileCase):
    """A press in files of several kinds, ten times as large as the memory that is given."""

    @property
    def budget(self) -> int:
        """Bytes."""
        return self.bytes // _TIMES

    @property
    def title(self) -> str:
        """What is measured, in one line."""
        size = " x ".join(map(str, self.shape))
        return f"peak memory of a process from file to result, file {_TIMES} times the budget; {size} uint8"


def run_budget(case: BudgetCase, device: Device, quick: bool) -> Case:
    """Reconstruct in child processes, and tell how much memory came on top of what they had before.

    Each child has reconstructed a few frames of the same kind by then. Maps count, and pages of mapped files
    as well.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory, or room for files.
    DisagreementError
        A child found other maps than there are without a budget.
    """
    if not is_told():
        return Case(case.name, case.title, [], {OURS: "this system does not tell how much memory is taken"})
    check_memory(case.name, 2 * case.bytes)
    with files.new_folder(case.name, 2 * case.bytes + _MAPS * math.prod(case.shape[1:])) as folder:
        press = make_press(case.shape)
        search = search_of(press, device)
        push_block(search, press.block)
        expected = maps_of(search.result())
        targets = []
        for kind, write in KINDS.items():
            memory = _run_child(case, press, write, folder, device)
            found = io.open_result(folder / "result.h5").maps()
            check_equal(f"{OURS}, {kind}", expected, found, f"{OURS}, in memory")
            targets.append(_judge(case, kind, memory))
    return Case(case.name, case.title, [], {}, (), () if quick else tuple(targets))


def _run_child(case: BudgetCase, press: files.Frames, write: Write, folder: Path, device: Device) -> Memory:
    """Let a child reconstruct a press that is stored in some way, into ``result.h5``."""
    few, source = folder / "few.h5", folder / "press.h5"
    write(press.first(_FEW), few)
    write(press, source)
    numbers = str(case.budget), str(_number_of(device.info))
    paths = map(str, (few, source, folder / "result.h5"))
    command = [sys.executable, "-c", _CHILD, *paths, *numbers]
    run = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    source.unlink()
    return Memory(**json.loads(run.stdout))


def _number_of(info: DeviceInfo) -> int:
    """Return the number by which a device is opened in another process."""
    return [one.title for one in list_devices()].index(info.title)


def _judge(case: BudgetCase, kind: str, memory: Memory) -> Target:
    bound = f"at most {_MORE * case.budget / 1e6:.0f} MB, the budget of {case.budget / 1e6:.0f} and 10 %"
    told = f"{memory.peak / 1e6:.0f} MB, {memory.anonymous / 1e6:.0f} of these its own"
    return Target(f"{OURS}, peak memory, {kind}", bound, told, memory.peak <= _MORE * case.budget)


def _write_long(press: files.Frames, path: Path) -> None:
    """Write chunks of few pixels and many frames, packed, as programs do that look at pixels over time."""
    files.record(press.first(2), path)
    block, travel = press.block, SERIES["travel"][0]
    chunk = tuple(max(1, length // _PIECE) for length in press.shape)
    with h5py.File(path, "r+") as file:
        del file[STACK], file[travel]
        file[travel] = block.travel
        file[travel].attrs["units"] = "mm"
        packing = hdf5plugin.Bitshuffle(cname="lz4")
        stack = file.create_dataset(STACK, press.shape, press.dtype, chunks=chunk, **packing)
        for start in range(0, press.shape[0], chunk[0]):
            stack[start : start + chunk[0]] = block.frames[start : start + chunk[0]]
    files.settle(path)


KINDS: dict[str, Write] = {
    "contiguous": files.record,
    "bitshuffle-LZ4": lambda press, path: files.record(press, path, "bitshuffle"),
    "chunks long in time": _write_long,
}
