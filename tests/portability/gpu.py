"""Try a GPU for the first time, in ten minutes: ``make gpu``.

``gpu.py [RUN.json]``: device tests, the frozen answers of the CPU, limits and benchmarks, into JSON and a
page beside it. The device is the one that OpenCL offers first, or that PYOPENCL_CTX names; one that is no GPU
is treated as one with memory of its own, and its times mean nothing.
"""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from gpu_check import ROOT, frozen_cases, taken_for_gpu
from suite import report

from mirrorskin.cli.bench.operations import MEASUREMENTS
from mirrorskin.cli.bench.records import describe_run
from mirrorskin.kernels.device import list_devices, open_device

TESTS_TAKE = 240  # seconds at most
LOOSER = 10  # times the tolerance of the frozen answers, which are those of one machine's arithmetic
FEW = 1e-3  # of an array may differ by more: pixels on the other side of a threshold
NO_CONTACT = re.compile(r"vectors|normals|azimuth|zenith|sigma|residual|process")  # these mean nothing there


def main() -> int:
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "gpu.json")
    begin = time.monotonic()
    device = open_device()
    number = next(i for i, info in enumerate(list_devices()) if info.title == device.info.title)
    tests = run_tests(f"{device.info.kind}{number}-copied-gpu")
    say("device tests", tests, begin)
    quick = device.info.kind != "gpu"
    taken_for_gpu(device)
    answers = compare_answers()
    wrong = {name: said for name, said in answers.items() if said}
    say("answers", f"{len(answers) - len(wrong)} of {len(answers)} as on the CPU", begin)
    cases = [measure(device, quick) for measure in MEASUREMENTS]
    say("benchmarks", f"{len(cases)} cases", begin)
    run = describe_run(device, cases, quick)
    data = {**json.loads(run.as_json()), "tests": tests, "answers": answers}
    output.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    lines = [
        f"{len(answers) - len(wrong)} of {len(answers)} answers are the CPU's; device tests: {tests}.",
        "",
    ]
    lines += [f"- {name}: {key} {words}" for name, said in wrong.items() for key, words in said.items()]
    page = "\n".join([report.as_markdown(run), "## Tests and answers", "", *lines, ""])
    output.with_suffix(".md").write_text(page, encoding="utf-8")
    print(*lines, f"written to {output} and {output.with_suffix('.md')}", sep="\n")
    return 0 if not wrong and re.fullmatch(r"\d+ passed.*", tests) else 1


def say(what: str, outcome: str, begin: float) -> None:
    print(f"{what}: {outcome} ({time.monotonic() - begin:.0f} s)", flush=True)


def run_tests(way: str) -> str:
    """Run the kernels' tests on one device in one way of holding memory; return pytest's last line."""
    words = f"-q -n auto -p no:cacheprovider -m device -k {way} tests/kernels".split()
    command = [sys.executable, "-P", "-m", "pytest", *words]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TESTS_TAKE)
    except subprocess.TimeoutExpired:
        return f"not done within {TESTS_TAKE} s"
    *said, last = done.stdout.strip().splitlines() or ["pytest says nothing"]
    return "; ".join([last.partition(" in ")[0], *(line for line in said if line.startswith("FAILED"))])


def compare_answers() -> dict[str, dict[str, str]]:
    """Run the frozen cases; return how each one's arrays differ from the frozen ones, where they do."""
    found: dict[str, dict[str, str]] = {}
    cases = frozen_cases()  # golden is on the path from here
    import golden

    known = golden.load()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, _ in cases:
            try:
                answers, frozen = golden.answers(name), known[name]
            except Exception as error:  # the next ones are tried all the same
                found[name] = {"fails with": f"{type(error).__name__}: {error}"}
                continue
            within = {key: golden.CASES[name].within(key) for key in answers}
            said = {key: differs(answers, frozen, key, within[key]) for key in answers}
            found[name] = {key: words for key, words in said.items() if words}
    return found


def differs(answers: dict[str, Any], frozen: dict[str, Any], key: str, within: tuple[float, float]) -> str:
    """Say how an array differs in more than a few pixels; nothing where it does not."""
    from golden import compare

    mine, theirs, loose = answers[key], frozen[key], (LOOSER * within[0], LOOSER * within[1])
    contact = frozen.get(".".join([*key.split(".")[:-1], "contact"]), np.array(True))
    if NO_CONTACT.search(key) and contact.ndim == 2 and contact.shape == mine.shape[:2] == theirs.shape[:2]:
        mine, theirs = mine[contact != 0], theirs[contact != 0]
    same, said = compare(mine, theirs, loose)
    if same or mine.shape != theirs.shape or mine.dtype.kind == "U":
        return "" if same else said
    wrong = ~np.isclose(mine.astype(float), theirs.astype(float), *loose, equal_nan=True)
    return "" if np.mean(wrong) <= FEW else f"{said}; {np.count_nonzero(wrong)} of {wrong.size} by too much"


if __name__ == "__main__":
    sys.exit(main())
