"""What a controller prints of itself: the status report, parameters, modes and build."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mirrorskin.hw.emulator.grbl_gcode import Interpreter
from mirrorskin.hw.emulator.grbl_paths import Place
from mirrorskin.hw.emulator.grbl_settings import Settings

BANNER = "Grbl 1.1h ['$' for help]"
HELP = "[HLP:$$ $# $G $I $N $x=val $J=line $SLP $C $X $H ~ ! ? ctrl-x]"
_INCH = 25.4
_AT_REST = {"Idle", "Alarm", "Check", "Sleep"}
# How often the offset and the overrides are told: every so many reports at rest, and otherwise.
_OFFSET_EVERY = (10, 30)
_OVERRIDES_EVERY = (10, 20)


@dataclass(frozen=True, slots=True)
class Status:
    """What a status report is made of.

    Attributes
    ----------
    state : str
    place, offset : tuple of float
        Machine coordinates, and where work coordinates begin in them.
    speed : float
        Units a minute.
    spindle : float
    blocks, bytes : int
        Room in the planner and in the receive buffer.
    """

    state: str
    place: Place
    offset: Place
    speed: float
    spindle: float
    blocks: int
    bytes: int


class Reporter:
    """Status reports, and what is only told in some of them."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Tell the offset in the next report, the overrides in the one after."""
        self._offset: Place | None = None
        self._until_offset = 0
        self._until_overrides = 0

    def line(self, status: Status, settings: Settings) -> str:
        """Return a status report."""
        scale, decimals = (1 / _INCH, 4) if settings[13] else (1.0, 3)
        mask = int(settings[10])
        place = status.place
        if not mask & 1:
            place = tuple(a - b for a, b in zip(place, status.offset, strict=True))
        fields = [status.state, f"{'MPos' if mask & 1 else 'WPos'}:{_numbers(place, scale, decimals)}"]
        if mask & 2:
            fields.append(f"Bf:{status.blocks},{status.bytes}")
        fields.append(f"FS:{status.speed * scale:.0f},{status.spindle:.0f}")
        fields += self._sometimes(status, scale, decimals)
        return f"<{'|'.join(fields)}>"

    def _sometimes(self, status: Status, scale: float, decimals: int) -> list[str]:
        busy = status.state not in _AT_REST
        if status.offset != self._offset:
            self._offset, self._until_offset = status.offset, 0
        if self._until_offset == 0:
            self._until_offset = _OFFSET_EVERY[busy] - 1
            self._until_overrides = max(self._until_overrides, 1)
            return [f"WCO:{_numbers(status.offset, scale, decimals)}"]
        self._until_offset -= 1
        if self._until_overrides == 0:
            self._until_overrides = _OVERRIDES_EVERY[busy] - 1
            return ["Ov:100,100,100"]
        self._until_overrides -= 1
        return []


def parameters(program: Interpreter) -> Iterable[str]:
    """Yield what ``$#`` prints."""
    none = _numbers((0.0,) * len(program.axes))
    for number, offset in enumerate(program.systems):
        yield f"[G{54 + number}:{_numbers(offset)}]"
    yield f"[G28:{none}]"
    yield f"[G30:{none}]"
    yield f"[G92:{_numbers(program.shift)}]"
    yield "[TLO:0.000]"
    yield f"[PRB:{none}:0]"


def modes(program: Interpreter) -> str:
    """Return what ``$G`` prints."""
    groups = (
        *("motion", "coordinates", "plane", "units", "distance", "feed mode"),
        *("spindle", "coolant"),
    )
    words = " ".join(program.modes[group] for group in groups)
    return f"[GC:{words} T{program.tool} F{program.feed:.0f} S{program.spindle:.0f}]"


def build(blocks: int, room: int) -> Iterable[str]:
    """Yield what ``$I`` prints."""
    yield "[VER:1.1h.20190825:]"
    yield f"[OPT:VM,{blocks},{room}]"


def _numbers(values: Iterable[float], scale: float = 1.0, decimals: int = 3) -> str:
    # Adding 0 makes plain zeros of negative ones.
    return ",".join(f"{round(value * scale, decimals) + 0.0:.{decimals}f}" for value in values)
