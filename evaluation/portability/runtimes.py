"""Time every public call on each OpenCL runtime for CPUs of this machine.

``runtimes.py [NAME...] [--output TABLE.json]``: the runtimes of ``portability.py``, or those with one of
these in their names, each in a separate process with caches of its own. ``--layouts cores lanes`` compares
how work is cut: an item loops over a tile, or takes one pixel. ``--targets znver3`` has the wheel's PoCL also
compile for that processor, whose instructions this one must have: code for AVX2 can be tried where there
is AVX-512. A number is the median of a call's processor time on all cores, ms: it depends little on what else
runs.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mirrorskin.evaluation.portability.portability import CHECKS, environment_for
from mirrorskin.kernels.processor_name import VARIABLE

ROUNDS, SECONDS = 15, 1.5  # of a call, at most
THIS = "this processor"
HEAD = """# Public calls on OpenCL runtimes for CPUs

By `evaluation/portability/runtimes.py`: processor time of a call on all cores, ms, the median of up
to 15 calls with pictures of 1 Mpx, on {processor}. In the layout "cores" a
work-item loops over a tile; in "lanes" it takes one pixel. Runtimes compiled either for this
processor, which has AVX-512, or for the named one, with AVX2. The latter does not represent the
caches and execution units of processors without AVX-512.
"""
Column = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, and write it and its numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these, such as Intel or PoCL")
    parser.add_argument("--output", type=Path, metavar="TABLE.json", help="and TABLE.md")
    parser.add_argument("--layouts", nargs="+", default=["cores"], choices=("cores", "lanes"))
    parser.add_argument("--targets", nargs="+", default=[], metavar="CPU")
    parser.add_argument("--calls", nargs="+", default=[""], metavar="PART", help="with one in their names")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    words = parser.parse_args(arguments)
    if words.inside:
        print(json.dumps(time_calls(words.calls, words.layouts[0])))
        return 0
    columns = list(measure(words.names or [""], words.layouts, words.targets, words.calls))
    print(page(columns))
    if words.output:
        words.output.write_text(json.dumps(columns, indent=1) + "\n", encoding="utf-8")
        words.output.with_suffix(".md").write_text(page(columns), encoding="utf-8")
    return 0


def measure(
    names: Sequence[str], layouts: Sequence[str], targets: Sequence[str], calls: Sequence[str]
) -> Iterator[Column]:
    """Give a column for each runtime, target and layout."""
    for check in CHECKS:
        if check.faults or check.find() is None or not any(name in check.name for name in names):
            continue
        for target in (THIS, *(targets if "wheel" in check.name else ())):
            for layout in layouts:
                print(f"{check.name}, {target}, {layout}", file=sys.stderr)
                options = ["--inside", "--layouts", layout, "--calls", *calls]
                with tempfile.TemporaryDirectory() as folder:
                    environment = environment_for(check, Path(folder))
                    environment |= {} if target == THIS else {VARIABLE: target}
                    command = [sys.executable, "-W", "ignore", __file__, *options]
                    child = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
                yield {"runtime": check.name, "target": target, **json.loads(child.stdout)}


def time_calls(calls: Sequence[str], layout: str) -> Column:
    """Return the processor time of each public call on the first device."""
    import numpy as np

    from mirrorskin.cli.commands.bench.records import describe_run
    from mirrorskin.evaluation.portability import gpu_calls
    from mirrorskin.kernels.device import open_device
    from mirrorskin.kernels.layout import CPU_LAYOUT, GPU_LAYOUT

    device = open_device()
    device.layout = CPU_LAYOUT if layout == "cores" else GPU_LAYOUT
    times: dict[str, float] = {}
    for name, call in gpu_calls.calls(gpu_calls.MEGAPIXEL, device):
        if not any(part in name for part in calls):
            continue
        took: list[float] = []
        begin = time.monotonic()
        while len(took) < 4 or (len(took) < ROUNDS + 1 and time.monotonic() - begin < SECONDS):
            start = time.process_time()
            call()
            took.append(time.process_time() - start)
        times[name] = 1e3 * float(np.median(took[1:]))
    run = describe_run(device, (), quick=False)
    machine = {"processor": run.processor, "threads": run.threads, "system": platform.system()}
    return {"driver": device.info.driver, "layout": layout, "commit": run.commit, **machine, "ms": times}


def page(columns: Sequence[Column]) -> str:
    """Return the table, of one processor."""
    heads = [
        f"{column['runtime']} {column['driver']}; {column['target']}; {column['layout']}"
        for column in columns
    ]
    rows = [[name, *(f"{column['ms'][name]:.3g}" for column in columns)] for name in columns[0]["ms"]]
    lines = [["call", *heads], ["---"] * (1 + len(heads)), *rows]
    processor = f"{columns[0]['processor']} with {columns[0]['threads']} threads"
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{HEAD.format(processor=processor)}\n{table}\n"


if __name__ == "__main__":
    sys.exit(main())
