"""Getting acquainted with a controller: is it GRBL, what is it set to, and is it awake."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.grbl.link import RESET, Link, Seen
from mirrorskin.hw.grbl.replies import Message, Setting
from mirrorskin.io import InputError

PREPARE = "G21G90G94"
"""Millimetres, absolute places, feeds a minute."""

_OLDEST = (1, 1)
_UNLOCK = "$X"
_REFRESH = 2.0  # seconds in which a report gives the work offset, at 20 questions a second


@dataclass(frozen=True, slots=True)
class Controller:
    """What a controller is.

    Attributes
    ----------
    firmware : str
        Its name and version, as it says them.
    settings : dict of int to float
        Its ``$`` settings, those that are numbers.
    """

    firmware: str
    settings: dict[int, float]

    def on(self, number: int) -> bool:
        """Return whether a switch among the settings is on; the first bit of a mask of bits."""
        return bool(int(self.settings.get(number, 0)) & 1)


def greet(link: Link, name: str, timeout: float) -> Controller:
    """Find out that GRBL answers, bring it to rest, and read its settings.

    Raises
    ------
    InputError
        Nothing answers, or something that is not GRBL 1.1, or it is set to what cannot be worked with.
    """
    seen = _first(link, name, timeout)
    if seen.status.state not in ("idle", "alarm"):  # left so by whoever spoke to it before
        link.restart(timeout)
        _first(link, name, timeout)
    controller = _identity(link, name, timeout)
    if controller.on(13):
        raise InputError(f"{name}: it reports in inches; set $13=0")
    return controller


def unlock(link: Link, name: str, timeout: float) -> None:
    """Lift the lock after an alarm or a start, where there are no switches to home against."""
    if link.seen is not None and link.seen.status.state == "alarm":
        link.ask(_UNLOCK, timeout)
        link.until(lambda: _state(link, "idle"), timeout, "unlock")


def offset_known(link: Link, name: str, timeout: float, known: Callable[[], bool]) -> None:
    """Wait until a report has told where the work coordinates begin.

    Raises
    ------
    InputError
        None does.
    """
    try:
        link.until(lambda: known() or None, max(timeout, _REFRESH), "tell its work offset")
    except HardwareError as error:
        raise InputError(f"{name}: its reports lack the work offset (WCO); switch it on in $10") from error


def _first(link: Link, name: str, timeout: float) -> Seen:
    """Wait for the first report; a controller that is locked hard answers only after a reset."""
    try:
        try:
            return link.until(lambda: link.seen, timeout / 2, "answer")
        except HardwareError:
            link.send(RESET)
            return link.until(lambda: link.seen, timeout / 2, "answer")
    except HardwareError as error:
        if link.gone:
            raise InputError(f"{name}: the line closed at once; is anything behind this port?") from error
        if link.banner is not None:
            raise InputError(f"{name}: {link.banner.text!r} does not report as GRBL 1.1 does") from error
        heard = link.noise.total > 0
        what = (
            "what answers is not GRBL 1.1 or grblHAL" if heard else f"nothing answers within {timeout:.3g} s"
        )
        raise InputError(f"{name}: {what}; look at the port, the baud rate and the power") from error


def _identity(link: Link, name: str, timeout: float) -> Controller:
    told = {m.text.partition(":")[0]: m.text for m in link.ask("$I", timeout) if isinstance(m, Message)}
    version = told.get("VER", "").removeprefix("VER:").strip(":")
    match = re.match(r"(\d+)\.(\d+)", version)
    number = (int(match[1]), int(match[2])) if match else link.banner.version if link.banner else (0, 0)
    if number < _OLDEST:
        raise InputError(f"{name}: it says that it is version {version or '?'}; GRBL 1.1 or later is needed")
    size = re.match(r"OPT:[^,]*,\d+,(\d+)", told.get("OPT", ""))
    if size:
        link.window.size = int(size[1])
    settings = {}
    for said in link.ask("$$", timeout):
        if isinstance(said, Setting) and re.fullmatch(r"-?\d+(\.\d*)?", said.value):
            settings[said.number] = float(said.value)
    firmware = link.banner.text.partition(" [")[0] if link.banner else f"Grbl {version}"
    return Controller(firmware, settings)


def _state(link: Link, state: str) -> bool | None:
    return True if link.seen is not None and link.seen.status.state == state else None
