"""Compare answers with the frozen ones: python tests/golden/compare.py [CASE...] [--freeze]."""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import sys
import tempfile
import time
import warnings
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "support")]

import golden  # noqa: E402
from cases import CASES  # noqa: E402


def main() -> int:
    """Run the cases, and print what differs; with --freeze, keep the new answers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "cases", nargs="*", metavar="CASE", help="names, such as 'find_onset*'; all by default"
    )
    parser.add_argument("--freeze", action="store_true", help="keep what they answer now")
    words = parser.parse_args()
    selected = [
        n for n in CASES if not words.cases or any(fnmatch.fnmatch(n, pattern) for pattern in words.cases)
    ]
    warnings.simplefilter("error")
    frozen, wrong = golden.load(), 0
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name in selected:
            wrong += not report(name, frozen, words.freeze)
    if words.freeze:
        golden.save({name: frozen[name] for name in CASES if name in frozen})
    return 1 if wrong and not words.freeze else 0


def report(name: str, frozen: dict[str, dict[str, golden.NDArray]], freeze: bool) -> bool:
    """Print how a case's arrays differ, and tell whether they are the same; take them over if asked."""
    begin = time.perf_counter()
    try:
        answers, expected = golden.answers(name), frozen.get(name, {})
    except Exception as error:
        print(f"{name}: FAILS with {type(error).__name__}: {error}")
        return False
    wrong = golden.differences(name, answers, expected)
    print(f"{name}: {'DIFFERS' if wrong else 'same'} ({time.perf_counter() - begin:.2f} s)")
    for key in sorted(answers.keys() | expected.keys()):
        if key in answers and key in expected:
            same, text = golden.compare(answers[key], expected[key], CASES[name].within(key, expected))
        else:
            same, text = False, "is new" if key in answers else "is missing"
        print(f"    {'  ' if same else '! '}{key}: {text}")
    if freeze:
        frozen[name] = answers
    return not wrong


if __name__ == "__main__":
    sys.exit(main())
