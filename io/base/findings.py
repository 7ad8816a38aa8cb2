"""Findings about frames and results, which are issued as warnings and stored in ``process``."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mirrorskin.io.model.result import Result

_BETWEEN = "; "
_CARRIED = "of an input"
_KINDS = "warnings", "notes"


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


def in_process(findings: Sequence[Finding], process: Mapping[str, Any]) -> dict[str, str]:
    """Return the ``warnings`` and ``notes`` of a process, with those of findings added.

    Examples
    --------
    >>> in_process([Finding("flicker", "the light flickers by 3 %")], {})
    {'warnings': 'the light flickers by 3 %'}
    """
    texts = {}
    for name, is_warning in zip(_KINDS, (True, False), strict=True):
        text = str(process.get(name, ""))
        for finding in findings:
            repeated = f"{_BETWEEN}{finding.text}{_BETWEEN}" in f"{_BETWEEN}{text}{_BETWEEN}"
            if finding.warning is is_warning and not repeated:
                text = f"{text}{_BETWEEN}{finding.text}" if text else finding.text
        if text:
            texts[name] = text
    return texts


def carried(process: Mapping[str, Any], /, **inputs: Mapping[str, Any]) -> dict[str, str]:
    """Return the ``warnings`` and ``notes`` of a process, with those of the results that it is computed from.

    Each is preceded by the name of its input. A finding that the process contains already is not repeated.

    Parameters
    ----------
    process : mapping
        Of the new result.
    **inputs : mapping
        The processes of its inputs, by their names.

    Examples
    --------
    >>> carried({"noise": 1.2}, heights={"warnings": "frame 3: lost"}, normals={"tilt": 0.04})
    {'warnings': 'heights: frame 3: lost'}
    """
    findings = [finding for name, source in inputs.items() for finding in findings_of(name, source)]
    return in_process(findings, process)


def merged(*processes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of processes, later ones replacing earlier ones, with the findings of all of them.

    Examples
    --------
    >>> merged({"noise": 1.2, "warnings": "frame 3: lost"}, {"noise": 1.5, "warnings": "flicker"})
    {'noise': 1.5, 'warnings': 'frame 3: lost; flicker'}
    """
    values: dict[str, Any] = {}
    for process in processes:
        carried = [
            Finding(_CARRIED, str(process[kind]), kind == _KINDS[0]) for kind in _KINDS if kind in process
        ]
        values = {**values, **process, **in_process(carried, values)}
    return values


def findings_of(name: str, process: Mapping[str, Any]) -> list[Finding]:
    """Return the findings in the process of an input, with its name.

    Examples
    --------
    >>> [finding.text for finding in findings_of("result", {"warnings": "frame 3: lost"})]
    ['result: frame 3: lost']
    """
    return [
        Finding(_CARRIED, named(name, text), kind == _KINDS[0])
        for kind in _KINDS
        for text in _texts(process, kind)
    ]


def warnings_in(process: Mapping[str, Any]) -> list[str]:
    """Return the warnings of a process, including those of fused recordings.

    Examples
    --------
    >>> warnings_in({"vertical_warnings": "frame 3: lost", "noise": 1.2})
    ['frame 3: lost']
    """
    return _texts(process, "warnings")


def _texts(process: Mapping[str, Any], kind: str) -> list[str]:
    """Return the warnings or notes of a process, with those of fused recordings."""
    return [str(text) for name, text in process.items() if f"_{name}".endswith(f"_{kind}")]


def with_findings(result: Result, *findings: Finding) -> Result:
    """Return a result with findings added to its process."""
    return result.assign(process={**result.process, **in_process(findings, result.process)})


def named(name: str, text: str) -> str:
    """Return a message with the name of its source as a prefix."""
    return text if text.startswith(name) else f"{name}: {text}"


def warn(name: str, process: Mapping[str, Any]) -> None:
    """Issue a `MirrorskinWarning` with the ``warnings`` of a process, and the name of the source."""
    text = str(process.get("warnings", ""))
    if not text:
        return
    level, frame = 1, sys._getframe()  # the line of the first caller outside of mirrorskin is shown
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("mirrorskin."):
        level, frame = level + 1, frame.f_back
    warnings.warn(named(name, text), MirrorskinWarning, stacklevel=level)
