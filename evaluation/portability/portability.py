"""Run the device tests on every OpenCL implementation of this machine: ``make portability``.

``portability.py [--whole] [NAME...]``: every device test, not the part that takes 20 minutes; only those with
one of these in their names. Each runs in a separate process that sees no other device. Intel's runtime, and
a root of Debian's testing that holds Mesa and a younger PoCL, are looked for in the folder
MIRRORSKIN_PORTABILITY, else in the user's cache (evaluation/portability/README.md).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import platformdirs
import pyopencl

from mirrorskin.evaluation.portability.faults import FAULTS, NEVER_SET

ROOT = Path(__file__).resolve().parents[2]
ROW = "| {:<32} | {:<30} | {:<18} | {:<7} | {:>5} |"
PLACE = Path(os.environ.get("MIRRORSKIN_PORTABILITY", platformdirs.user_cache_path("mirrorskin-portability")))
WHEELS = Path(pyopencl.__file__).parent / ".libs"
TESTING = PLACE / "testing"  # with an environment for Python in /env

OCLGRIND = "/usr/lib/oclgrind/liboclgrind-rt-icd.so"
# It keeps records of all memory at each launch: with its usual 128 MB a launch takes a second.
LITTLE_MEMORY = {"OCLGRIND_GLOBAL_MEM_SIZE": "8000000"}

# Whole frames of the twin are hours in an interpreter as well.
KERNELS = ("tests/engine", "tests/kernels")
# Tests that need many pixels because they judge statistics: hours in an interpreter.
STATISTICS = (
    "honest or cost_little or longer_than or never_gets or hovers or noise_alone or as_good_as or _targets"
)
# Kernels of vectors of flags, which an interpreter of optimised ones gets wrong.
VECTORS = "normals or axial"
# It does not know what LLVM writes where it inlines a function that returns a structure.
UNOPTIMISED = {"OCLGRIND_BUILD_OPTIONS": "-cl-opt-disable -Dalways_inline=noinline"}
# Tests on few pixels that still reach all kernels and types. Of vectors of eight pixels its watch crashes.
SMALL = (
    "odd_sizes or references_of_each_pixel or used_again or is_light or (read_all and 127)"
    " or (triad_all and 127) or displacement_ or gpu-pose_equations or gpu-pose_follow or pose_gradient"
    " or gpu-pose_records"
)


@dataclass(frozen=True)
class Check:
    """An OpenCL implementation, its environment variables, and the tests that it is given."""

    name: str
    remedy: str  # where it is missing
    library: str  # a pattern
    tests: str = ""  # of those marked "device", as pytest's -k has it
    folders: tuple[str, ...] = ("tests",)  # of the whole
    part: tuple[str, ...] = ("tests/kernels",)  # of what is run without being asked for the whole
    faults: tuple[str, ...] = ()  # that it must report
    variables: Mapping[str, str] = field(default_factory=dict)

    def find(self) -> Path | None:
        """Return the library; None if it is not installed."""
        return next(iter(sorted(Path("/").glob(self.library.removeprefix("/")))), None)


RACES = tuple(name for name in FAULTS if name != NEVER_SET)
BUILT = "make the root of Debian testing as described in evaluation/portability/README.md"

CHECKS = (
    Check("PoCL, the wheel", "pip install pocl-binary-distribution", f"{WHEELS}/libpocl-*.so"),
    Check("PoCL, the system's", BUILT, "/usr/lib/*/libpocl.so.2"),
    Check(
        "rusticl, llvmpipe",
        BUILT,
        "/usr/lib/*/libRusticlOpenCL.so.1",
        variables={"RUSTICL_ENABLE": "llvmpipe"},
    ),
    Check(
        "Intel",
        f"python3 -m venv {PLACE}/intel; {PLACE}/intel/bin/pip install intel-opencl-rt intel-cmplr-lib-rt",
        f"{PLACE}/intel/lib/libintelocl.so",
    ),
    Check(
        "Oclgrind: races",
        "apt install oclgrind",
        OCLGRIND,
        tests=f"not ({STATISTICS} or {VECTORS})",
        folders=KERNELS,
        part=(
            "tests/kernels/integration/test_multigrid.py",
            "tests/kernels/integration/test_links.py",
            "tests/kernels/rotation/test_edges.py",
            "tests/kernels/test_references.py",
        ),
        faults=RACES,
        variables={"OCLGRIND_DATA_RACES": "1", **LITTLE_MEMORY},
    ),
    Check(
        "Oclgrind: races between vectors",
        "apt install oclgrind",
        OCLGRIND,
        tests=f"({VECTORS}) and not ({STATISTICS})",
        folders=KERNELS,
        part=("tests/kernels/rotation/test_normals_wall.py", "tests/kernels/rotation/test_normals_pose.py"),
        faults=RACES,
        variables={"OCLGRIND_DATA_RACES": "1", **UNOPTIMISED, **LITTLE_MEMORY},
    ),
    Check(
        "Oclgrind: unset",
        "apt install oclgrind",
        OCLGRIND,
        tests=SMALL,
        folders=KERNELS,
        faults=(NEVER_SET,),
        # Of optimised kernels it does not know all instructions, and crashes on some.
        variables={"OCLGRIND_UNINITIALIZED": "1", **UNOPTIMISED, **LITTLE_MEMORY},
    ),
)


@dataclass(frozen=True)
class Finding:
    """What came of one check; ``details`` say what is wrong, and are empty where nothing is."""

    version: str
    tests: str
    reports: str
    details: tuple[str, ...] = ()


def main(arguments: Sequence[str] | None = None) -> int:
    """Print one row a check; 0 where all is well, 1 where not, 2 where one is missing."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these, such as Intel or PoCL")
    parser.add_argument("--whole", action="store_true", help="all tests, which take hours")
    parser.add_argument("--inside", action="store_true", help="in a root of its own: run what is there")
    words = parser.parse_args(arguments)
    checks = [check for check in CHECKS if not words.names or any(name in check.name for name in words.names)]
    here = [check for check in checks if check.find() is not None]
    if not words.inside:
        print(ROW.format("implementation", "version", "device tests passed", "reports", "min"))
        print("|---" * 5 + "|", flush=True)
    details: list[str] = []
    for check in here:
        begin = time.monotonic()
        finding = examine(check, words.whole)
        row = check.name, finding.version, finding.tests, finding.reports
        print(ROW.format(*row, f"{(time.monotonic() - begin) / 60:.1f}"), flush=True)
        details += finding.details
    wrong = bool(details)
    print(*details, sep="\n", end="\n" * wrong, file=sys.stderr)
    if words.inside:
        return wrong
    elsewhere = TESTING.is_dir()
    if elsewhere:
        wrong |= inside(TESTING, words.names, words.whole) != 0
    missing = {c.remedy for c in checks if c not in here and not (elsewhere and c.remedy == BUILT)}
    if missing:
        print(f"make portability: not all are here: {'; '.join(sorted(missing))}", file=sys.stderr)
    return 1 if wrong else 2 if missing else 0


def inside(root: Path, names: Sequence[str], whole: bool) -> int:
    """Run the checks of what another root holds there, on a copy of this tree; return their status."""
    tree = root / "mirrorskin"
    files = subprocess.run(["git", "-C", str(ROOT), "ls-files", "-z"], check=True, capture_output=True).stdout
    copy = f"rm -rf {tree} && mkdir {tree} && tar -C {ROOT} --null --files-from=- -c | tar -x -C {tree}"
    subprocess.run(copy, shell=True, input=files, check=True)
    words = ["evaluation/portability/portability.py", "--inside", *["--whole"] * whole, *names]
    return subprocess.run(
        ["chroot", str(root), "sh", "-c", f"cd /mirrorskin && /env/bin/python {' '.join(words)}"]
    ).returncode


def examine(check: Check, whole: bool = False) -> Finding:
    """See that it is sound, that it reports what it should, and what the device tests make of it."""
    with tempfile.TemporaryDirectory() as folder:
        environment = environment_for(check, Path(folder))
        log = Path(environment["OCLGRIND_LOG"])
        child = run_kernel(environment)
        if child.returncode != 0 or reports_in(log):
            return Finding("?", "-", "-", ("a sound kernel fails:", child.stderr, read(log)))
        missed = missed_faults(check.faults, environment, log)
        if missed:
            return Finding(child.stdout.strip(), "-", "-", (f"not reported: {', '.join(missed)}",))
        tests, details = run_tests(check, environment, Path(folder, "tests.xml"), whole)
        reports = reports_in(log)
        if reports:
            details += (read(log),)
        shown = str(len(reports)) if check.faults else "-"
        return Finding(child.stdout.strip(), tests, shown, details)


def environment_for(check: Check, folder: Path) -> dict[str, str]:
    """Return an environment in which there is one implementation, and nothing compiled yet."""
    hidden = ("PYOPENCL_CTX", "POCL_CACHE_DIR")
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    ours = {
        "OCL_ICD_VENDORS": str(check.find()),
        "OCLGRIND_LOG": str(folder / "reports"),
        "XDG_CACHE_HOME": str(folder / "cache"),
    }
    return {**kept, **ours, **check.variables}


def missed_faults(faults: Iterable[str], environment: Mapping[str, str], log: Path) -> list[str]:
    """Return which of the faults are not reported: a check that lets one pass proves nothing."""
    missed = []
    for name in faults:
        run_kernel(environment, name)
        if not any(report.startswith(FAULTS[name][1]) for report in reports_in(log)):
            missed.append(name)
        log.unlink(missing_ok=True)
    return missed


def run_kernel(environment: Mapping[str, str], *fault: str) -> subprocess.CompletedProcess[str]:
    """Run the sound kernel of ``faults.py``, or one with a fault, in a child process."""
    command = [sys.executable, str(Path(__file__).with_name("faults.py")), *fault]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


def run_tests(
    check: Check, environment: Mapping[str, str], record: Path, whole: bool = True
) -> tuple[str, tuple[str, ...]]:
    """Run a check's tests marked ``device``; return how many pass, and what pytest says if not all do."""
    marked = "device" if whole else "device and not slow"
    options = ["-m", marked, "-k", check.tests, "-q", "-p", "no:cacheprovider", f"--junitxml={record}"]
    command = [sys.executable, "-P", "-m", "pytest", *options, *(check.folders if whole else check.part)]
    child = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if not record.exists():
        return f"ended with {child.returncode}", (child.stdout, child.stderr)
    tests, passed = count_tests(record)
    details = () if child.returncode == 0 and passed == tests > 0 else (child.stdout, child.stderr)
    return f"{passed} of {tests}", details


def count_tests(record: Path) -> tuple[int, int]:
    """Return how many tests pytest's XML tells of, and how many of them passed."""
    suites = ET.parse(record).getroot().iter("testsuite")
    numbers = {"tests": 0, "failures": 0, "errors": 0, "skipped": 0}
    for suite in suites:
        for name in numbers:
            numbers[name] += int(suite.get(name, 0))
    tests = numbers.pop("tests")
    return tests, tests - sum(numbers.values())


def reports_in(log: Path) -> list[str]:
    """Return the first line of each of Oclgrind's reports; what belongs to one is indented."""
    return [line for line in read(log).splitlines() if line and not line[0].isspace()]


def read(log: Path) -> str:
    """Return a log's text; Oclgrind makes no log until it has something to say."""
    return log.read_text(errors="replace") if log.exists() else ""


if __name__ == "__main__":
    sys.exit(main())
