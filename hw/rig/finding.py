"""What a check of a rig found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "warning", "failed"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes
    ----------
    part : str
        Of the rig: stage, camera or move.
    what : str
        What was looked at.
    found : str
        What it is, with its unit.
    verdict : {"ok", "warning", "failed"}
        Whether a recording can be made with it.
    remedy : str
        What is wrong and what to do; empty if all is well.
    """

    part: str
    what: str
    found: str
    verdict: Verdict = "ok"
    remedy: str = ""
