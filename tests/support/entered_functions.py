"""The functions of the project that a call enters."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import mirrorskin

PACKAGE = Path(mirrorskin.__file__).parent
_UNNAMED = {"<lambda>", "<listcomp>", "<genexpr>", "<dictcomp>", "<setcomp>"}


def functions_entered(call: Callable[[], object]) -> dict[str, list[str]]:
    """Return the names of the functions that the second of two calls enters in all threads, by their file.

    These are the distinct code objects of the package, without lambdas and comprehensions.
    """
    codes: set[CodeType] = set()

    def profile(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            codes.add(frame.f_code)

    call()
    gc.collect()  # destructors of earlier objects are not part of the call
    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    entered: dict[str, list[str]] = {}
    for code in codes:
        path = Path(code.co_filename)
        if path.is_relative_to(PACKAGE) and code.co_name not in _UNNAMED:
            entered.setdefault(path.relative_to(PACKAGE).as_posix(), []).append(code.co_qualname)
    return {file: sorted(names) for file, names in sorted(entered.items())}


def as_text(entered: dict[str, list[str]]) -> str:
    """Return the number of functions of each file, with the names of at most three, and their sums."""
    lines = []
    for file, names in sorted(entered.items(), key=lambda item: (-len(item[1]), item[0])):
        lines.append(f"{len(names):4} {file}" + (f": {', '.join(names)}" if len(names) <= 3 else ""))
    few = sum(len(names) <= 3 for names in entered.values())
    total = f"{sum(map(len, entered.values()))} functions in {len(entered)} files"
    return "\n".join([*lines, f"{total}; {few} of the files are entered for at most 3 functions"])
