"""Findings about frames and results, which are issued as warnings and stored in ``process``."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mirrorskin.io.result import Result

_BETWEEN = "; "


class MirrorskinWarning(UserWarning):
    """Input or a result that may be misleading; the message is one line with the remedy."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding about frames or a result that the user should know.

    Attributes
    ----------
    kind : str
        A fixed phrase, such as "lost frames"; see the list in the documentation.
    text : str
        One line with the problem, and the remedy if there is one.
    warning : bool
        Whether results may be wrong; otherwise it is a note.
    """

    kind: str
    text: str
    warning: bool = True


def in_process(findings: Iterable[Finding], process: Mapping[str, Any]) -> dict[str, str]:
    """Return the ``warnings`` and ``notes`` of a process, with those of findings added.

    Examples
    --------
    >>> in_process([Finding("flicker", "the light flickers by 3 %")], {})
    {'warnings': 'the light flickers by 3 %'}
    """
    known = {}
    for name, wanted in (("warnings", True), ("notes", False)):
        texts = [str(process[name])] if name in process else []
        texts += [one.text for one in findings if one.warning is wanted]
        if texts:
            known[name] = _BETWEEN.join(dict.fromkeys(texts))
    return known


def warnings_in(process: Mapping[str, Any]) -> list[str]:
    """Return the warnings of a process, including those of fused recordings.

    Examples
    --------
    >>> warnings_in({"vertical_warnings": "frame 3: lost", "noise": 1.2})
    ['frame 3: lost']
    """
    return [str(text) for name, text in process.items() if f"_{name}".endswith("_warnings")]


def with_findings(result: Result, *findings: Finding) -> Result:
    """Return a result with findings added to its process."""
    return result.assign(process={**result.process, **in_process(findings, result.process)})


def named(name: str, said: str) -> str:
    """Return a message with the name of its source as a prefix."""
    return said if said.startswith(name) else f"{name}: {said}"


def warn(name: str, process: Mapping[str, Any]) -> None:
    """Issue a `MirrorskinWarning` with the ``warnings`` of a process, and the name of the source."""
    said = str(process.get("warnings", ""))
    if not said:
        return
    level, frame = 1, sys._getframe()  # the line of the first caller outside of mirrorskin is shown
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("mirrorskin."):
        level, frame = level + 1, frame.f_back
    warnings.warn(named(name, said), MirrorskinWarning, stacklevel=level)
