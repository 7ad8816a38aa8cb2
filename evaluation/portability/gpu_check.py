"""Compile every kernel for GPUs that are not present, and compare their needs: ``make gpu-check``.

``gpu_check.py [FILE...] [--freeze]``: only these of the kernels' files; keep what is found as the new table.
Options are those of programs that are built while the frozen cases run on a device that is cut as a GPU
(evaluation/portability/README.md).
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mirrorskin.kernels.device import Device

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_name("gpu-check.json")
BITCODE = Path("/usr/lib/clc")
CLANG = ("-x", "cl", "-cl-std=CL1.2", "-Xclang", "-finclude-default-header", "-O3", "-Wno-linker-warnings")
NVIDIA = ("--target=nvptx64-nvidia-nvcl", "-march=sm_90", "nvptx64--nvidiacl.bc")
AMD = ("--target=amdgcn-amd-amdhsa", "-mcpu=gfx90a", "-nogpulib", "amdgcn--amdhsa.bc")

MORE = 1.15, 8  # factor, and registers or bytes besides, from which on a kernel takes clearly more
REGISTERS, WARPS, UNIT = (
    65536,
    64,
    256,
)  # of a multiprocessor of sm_90; registers that a warp is given at once

COLUMNS = (
    *("registers", "stack", "spills", "warps", "doubles", "byte loads"),
    *("AMD registers", "AMD scratch", "AMD spills", "AMD waves"),
)
COUNTED = tuple(name for name in COLUMNS if name not in ("warps", "AMD waves"))
HEAD = """# What kernels take on GPUs

By `make gpu-check`, which compiles and runs nothing: for NVIDIA (`ptxas`, sm_90) and AMD (clang,
gfx90a), the most that each kernel takes with any set of options that the frozen answers build for a
GPU. Registers and bytes are a lane's. Warps are those that a multiprocessor has room for, of 64,
waves of a SIMD, of 8. Doubles are instructions in double precision, byte loads those of single
bytes from global memory.
"""

# Frozen cases that take long in the GPU's cut and build nothing more; and those that
# look for GPUs themselves.
LEFT_OUT = re.compile(
    r"fuse_|score|measure|export|info|recorded_|and_say_so|each_turn|other_options|block|batch|devices"
    r"|cuts|missing_slopes"
)

Row = dict[str, Any]
Build = tuple[str, tuple[str, ...]]  # a file, and its options


def main() -> int:
    """Print the table and what is worse than in the stored one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", metavar="FILE", help="such as onset; all by default")
    parser.add_argument("--freeze", action="store_true", help="keep what is found as the table")
    words = parser.parse_args()
    tools = find_tools()
    if isinstance(tools, str):
        print(f"make gpu-check: {tools}", file=sys.stderr)
        return 2
    builds = {build: names for build, names in record().items() if build[0] in (words.files or [build[0]])}
    rows = worst(row for build in builds.items() for row in examine(build, tools))
    stored = json.loads(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}
    print(page(rows))
    gone = [] if words.files else sorted(stored.keys() - rows.keys())
    if words.freeze:
        stored = rows = {**(stored if words.files else {}), **rows}
        gone = []
        TABLE.write_text(json.dumps(rows, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        TABLE.with_suffix(".md").write_text(page(rows), encoding="utf-8")
    wrong = [line for name, row in rows.items() for line in complaints(row, stored.get(name))]
    wrong += [f"{name} is in {TABLE.name}, and no longer built: gpu_check.py --freeze" for name in gone]
    print(*wrong, sep="\n", end="\n" * bool(wrong), file=sys.stderr)
    return 1 if wrong else 0


def find_tools() -> tuple[str, str] | str:
    """Return clang and ptxas, or in one line what to install."""
    clang = next(filter(None, map(shutil.which, [*(f"clang-{n}" for n in range(30, 14, -1)), "clang"])), None)
    if clang is None or not all((BITCODE / target[-1]).exists() for target in (NVIDIA, AMD)):
        return "install a clang and its libclc first (Debian: apt install clang-19 libclc-19)"
    wheel = importlib.util.find_spec("nvidia")
    folders = (
        [Path(place, "cuda_nvcc", "bin") for place in (wheel.submodule_search_locations or [])]
        if wheel
        else []
    )
    ptxas = next(
        filter(None, (shutil.which("ptxas", path=path) for path in [*map(str, folders), None])), None
    )
    return (clang, ptxas) if ptxas else "install ptxas first (pip install nvidia-cuda-nvcc-cu12)"


def record() -> dict[Build, set[str]]:
    """Run the frozen cases on a device taken for a GPU; return what is built, and which kernels of it run."""
    from mirrorskin.kernels.device import Device, open_device

    device = open_device()
    taken_for_gpu(device)
    builds: dict[Build, set[str]] = {}
    make = Device._make_kernel

    def made(self: Device, file: str | Path, name: str, options: tuple[str, ...]) -> Any:
        builds.setdefault((str(file), options), set()).add(name)
        return make(self, file, name, options)

    Device._make_kernel = made  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for _, case in frozen_cases():
            case.make()
    # No frozen case is under a cylinder's wall.
    walls = from_tests("test_normals_wall")
    for name in walls.CASES:
        walls.test_kernel_and_reference_agree(device, name)
    return builds


def taken_for_gpu(device: Device) -> None:
    """Let a device be given work as a GPU with memory of its own is."""
    from mirrorskin.kernels.layout import GPU_LAYOUT

    device.layout = GPU_LAYOUT
    device.info = dataclasses.replace(device.info, kind="gpu", shares_memory=False)


def frozen_cases() -> Iterator[tuple[str, Any]]:
    """Give the frozen cases, by name, but those that are left out."""
    cases = from_tests("cases").CASES
    warnings.simplefilter("ignore")
    return ((name, case) for name, case in cases.items() if not LEFT_OUT.search(name))


def from_tests(name: str) -> Any:
    """Return a module of the tests, which hold the frozen answers."""
    for folder in ("golden", "support", "kernels/rotation"):
        if (path := str(ROOT / "tests" / folder)) not in sys.path:
            sys.path.insert(0, path)
    return importlib.import_module(name)


def examine(build: tuple[Build, set[str]], tools: tuple[str, str]) -> list[Row]:
    """Compile a file with its options for both; return what each kernel that runs takes."""
    from mirrorskin.kernels.device import source_file

    (file, options), names = build
    path = Path(file) if file.endswith(".cl") else source_file(f"{file}.cl")
    with tempfile.TemporaryDirectory() as folder:
        ptx, assembly = (
            compile_for(target, path, options, tools[0], Path(folder)) for target in (NVIDIA, AMD)
        )
        command = [tools[1], "-v", "-arch=sm_90", str(ptx), "-o", str(Path(folder, "cubin"))]
        report = subprocess.run(command, check=True, capture_output=True, text=True).stderr
        nvidia, amd = read_ptxas(report, ptx.read_text()), read_assembly(assembly.read_text())
    frame = next((option.removeprefix("-DFRAME=") for option in options if option.startswith("-DFRAME=")), "")
    return [
        {"kernel": f"{name} {frame}".strip(), "options": " ".join(options), **nvidia[name], **amd[name]}
        for name in sorted(names)
    ]


def compile_for(
    target: tuple[str, ...], path: Path, options: Iterable[str], clang: str, folder: Path
) -> Path:
    """Compile a file for a target of clang; return the assembly."""
    *words, library = target
    output = folder / library
    command = [clang, *CLANG, *words, "-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(BITCODE / library)]
    command += ["-I", str(ROOT / "kernels")]
    process = subprocess.run(
        [*command, "-S", "-o", str(output), *options, str(path)], capture_output=True, text=True
    )
    if process.returncode != 0:
        raise SystemExit(
            f"{path.name} {' '.join(options)} does not compile for {target[0]}:\n{process.stderr}"
        )
    return output


def read_ptxas(report: str, ptx: str) -> dict[str, Row]:
    """Return what ptxas says of each kernel, how many warps have room, and what its instructions are."""
    pattern = re.compile(
        r"properties for (\w+)\n"
        r"\s+(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads\n"
        r".*?Used (\d+) registers"
    )
    bodies = dict(re.findall(r"\.entry (\w+)\(.*?\n\{(.*?)\n\}", ptx, re.DOTALL))
    rows = {}
    for name, *rest in pattern.findall(report):
        stack, stores, loads, registers = map(int, rest)
        each = -(-32 * registers // UNIT) * UNIT
        rows[name] = {
            "registers": registers,
            "stack": stack,
            "spills": stores + loads,
            "warps": min(REGISTERS // each // 4 * 4, WARPS),  # in groups of four
            "doubles": len(re.findall(r"\.f64\b", bodies[name])),
            "byte loads": len(re.findall(r"\bld\.global\S*\.[usb]8\b", bodies[name])),
        }
    return rows


def read_assembly(text: str) -> dict[str, Row]:
    """Return what clang says of each kernel for AMD: of a lane, and how many waves a SIMD has room for."""
    pattern = re.compile(
        r"\.name: +(\w+)\n +\.private_segment_fixed_size: (\d+)\n(?: +[.-].*\n)*?"
        r" +\.vgpr_count: +(\d+)\n +\.vgpr_spill_count: (\d+)"
    )
    rows = {}
    for name, scratch, vgprs, spills in pattern.findall(text):
        waves = re.compile(r"; Occupancy: (\d+)").search(text, text.index(f"\n{name}:"))
        rows[name] = {
            "AMD registers": int(vgprs),
            "AMD scratch": int(scratch),
            "AMD spills": int(spills),
            "AMD waves": int(waves[1]) if waves else 0,
        }
    return rows


def worst(rows: Iterable[Row]) -> dict[str, Row]:
    """Return, for each kernel and type of frames, the row that takes the most registers and stack."""
    worst_rows: dict[str, Row] = {}
    for row in sorted(
        rows, key=lambda row: (row["spills"], row["AMD spills"], row["registers"], row["stack"])
    ):
        of_all = worst_rows.get(row["kernel"], {})
        highest = {key: max(value, of_all.get(key, 0)) for key, value in row.items() if key in COUNTED}
        worst_rows[row["kernel"]] = {**row, **highest}
    return dict(sorted(worst_rows.items()))


def complaints(row: Row, stored: Row | None) -> Iterator[str]:
    """Say in a line each what no kernel may take, and what one takes clearly more of than in the table."""
    for key in ("spills", "AMD spills", "doubles"):
        if row[key]:
            yield f"{row['kernel']}: {row[key]} {key}, with {row['options']}"
    if stored is None:
        yield f"{row['kernel']} is not in {TABLE.name}: gpu_check.py --freeze"
        return
    for key in COUNTED:
        if row[key] > MORE[0] * stored[key] + MORE[1]:
            yield f"{row['kernel']}: {row[key]} {key} where it took {stored[key]}, with {row['options']}"


def page(rows: dict[str, Row]) -> str:
    """Return the table in Markdown."""
    lines = [f"| kernel | {' | '.join(COLUMNS)} |", "|---" * (len(COLUMNS) + 1) + "|"]
    lines += [f"| {name} | {' | '.join(str(rows[name][key]) for key in COLUMNS)} |" for name in sorted(rows)]
    return "\n".join([HEAD, *lines, ""])


if __name__ == "__main__":
    sys.exit(main())
