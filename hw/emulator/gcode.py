"""What a controller answers to a line that it refuses."""

from __future__ import annotations

import copy
import math
import re
from dataclasses import dataclass, field

from mirrorskin.hw.emulator.motion import Arc, Line, Path, Place


class GrblError(Exception):
    """A line is refused with ``error:N``; see ``doc/csv/error_codes_en_US.csv`` of GRBL 1.1.

    Attributes
    ----------
    code : int
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


class SoftLimitError(Exception):
    """A move would leave the travel that the soft limits allow: ``ALARM:2``."""


NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)")

_GROUPS = {
    "motion": ("G0", "G1", "G2", "G3", "G80"),
    "plane": ("G17", "G18", "G19"),
    "units": ("G20", "G21"),
    "distance": ("G90", "G91"),
    "arc distance": ("G91.1",),
    "feed mode": ("G94",),
    "cutter": ("G40",),
    "tool length": ("G49",),
    "coordinates": ("G54", "G55", "G56", "G57", "G58", "G59"),
    "control": ("G61",),
    "once": ("G4", "G10", "G53", "G92", "G92.1"),
    "flow": ("M0", "M1", "M2", "M30"),
    "spindle": ("M3", "M4", "M5"),
    "coolant": ("M7", "M8", "M9"),
}
_GROUP_OF = {code: group for group, codes in _GROUPS.items() for code in codes}
_VALUES = "FIJKLNPRST"
_NOT_NEGATIVE = "FNPST"
_LINENUMBERS = 9_999_999


@dataclass(slots=True)
class Block:
    """The words of a line.

    Attributes
    ----------
    codes : dict of str to str
        The commands by their modal group, such as {"motion": "G1"}.
    values : dict of str to float
        The other words by their letter, axes included.
    """

    codes: dict[str, str] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)


def clean(line: str) -> str:
    """Return a line without comments, spaces and block deletes, in capitals."""
    text = re.sub(r"\([^)]*(\)|$)", "", line)
    return re.sub(r"[\x00-\x20/]", "", text.split(";")[0]).upper()


def parse(line: str, axes: str) -> Block:
    """Return the words of a cleaned line.

    Raises
    ------
    GrblError
        1: a letter is missing; 2: a number is; 4: a value is negative; 20: unknown; 21: two of one group;
        25: a word is repeated; 27: the line number is too large.
    """
    block = Block()
    at = 0
    while at < len(line):
        letter = line[at]
        if not ("A" <= letter <= "Z"):
            raise GrblError(1)
        number = NUMBER.match(line, at + 1)
        if number is None:
            raise GrblError(2)
        at = number.end()
        _sort(block, letter, float(number.group()), axes)
    _check(block)
    return block


def _sort(block: Block, letter: str, value: float, axes: str) -> None:
    if letter in "GM":
        code = f"{letter}{value:g}"
        if code not in _GROUP_OF:
            raise GrblError(20)
        group = _GROUP_OF[code]
        if group in block.codes:
            raise GrblError(21)
        block.codes[group] = code
        return
    if letter not in _VALUES and letter not in axes:
        raise GrblError(20)
    if letter in block.values:
        raise GrblError(25)
    block.values[letter] = value


def _check(block: Block) -> None:
    if any(block.values.get(letter, 0.0) < 0 for letter in _NOT_NEGATIVE):
        raise GrblError(4)
    if block.values.get("N", 0.0) > _LINENUMBERS:
        raise GrblError(27)


_INCH = 25.4
_PLANES = {"G17": (0, 1), "G18": (2, 0), "G19": (1, 2)}
_JOG_GROUPS = {"units", "distance"}
_TURN_EPSILON = 5e-7  # radians below which an arc is a whole turn
_NO_WAY = 1e-9  # axis units below which there is nothing to drive
_SYSTEMS = 6
_TOOLS = 255


@dataclass(frozen=True, slots=True)
class Drive:
    """Go along a path, at a feed in units a second, or as fast as may be (None)."""

    path: Path
    feed: float | None


@dataclass(frozen=True, slots=True)
class Dwell:
    """Wait until all motion has ended, and then some seconds more."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Pause:
    """Wait until all motion has ended, and then for a resume."""


@dataclass(frozen=True, slots=True)
class Say:
    """Wait until all motion has ended, and print a line."""

    text: str


Action = Drive | Dwell | Pause | Say

_MODES = {
    "motion": "G0",
    "coordinates": "G54",
    "plane": "G17",
    "units": "G21",
    "distance": "G90",
    "feed mode": "G94",
    "spindle": "M5",
    "coolant": "M9",
}
# What M2 and M30 set back: all but the units.
_END = {group: code for group, code in _MODES.items() if group != "units"} | {"motion": "G1"}


class Interpreter:
    """The modes, offsets and the place that the program has come to; machine coordinates.

    Parameters
    ----------
    axes : str
        The axes' letters; the first three take part in arcs.

    Attributes
    ----------
    place : tuple of float
        Where the last move ends.
    systems : list of list of float
        The six work coordinate systems' offsets, which outlive a reset.
    """

    def __init__(self, axes: str, place: Place) -> None:
        self.axes = axes
        self.systems = [[0.0] * len(axes) for _ in range(_SYSTEMS)]
        self.reset(place)

    def reset(self, place: Place) -> None:
        """Begin anew at a place, as after a reset."""
        self.place = place
        self.shift = [0.0] * len(self.axes)  # of G92
        self.modes = dict(_MODES)
        self.feed = 0.0  # a minute
        self.spindle = 0.0
        self.tool = 0

    @property
    def offset(self) -> Place:
        """What work coordinates lie below machine coordinates."""
        system = self._system(self.modes["coordinates"])
        return tuple(a + b for a, b in zip(system, self.shift, strict=True))

    def run(self, line: str) -> list[Action]:
        """Take a cleaned line.

        Returns
        -------
        list
            What it asks for, in order. The modes are changed already.

        Raises
        ------
        GrblError
            The line is refused, and nothing is changed.
        """
        before = copy.deepcopy(self.__dict__)
        try:
            return self._run(parse(line, self.axes))
        except GrblError:
            self.__dict__.update(before)
            raise

    def _run(self, block: Block) -> list[Action]:
        modes = self.modes | {g: c for g, c in block.codes.items() if g in self.modes}
        waits = any(modes[group] != self.modes[group] for group in ("coordinates", "spindle", "coolant"))
        _to_millimetres(block, modes["units"], self.axes)
        once = block.codes.get("once")
        moves = self._moves(block, modes, once)
        self.feed = block.values.pop("F", self.feed)
        drives = self._drive(block, modes, once == "G53", self.feed) if moves else []
        first = self._once(block, once, modes)
        if waits:
            first.append(Dwell(0.0))
        self._take_rest(block)
        self.modes = modes
        self._arrive(drives)
        return [*first, *drives, *self._flow(block)]

    def jog(self, line: str) -> list[Action]:
        """Take what stands behind ``$J=``, which changes no modes.

        Raises
        ------
        GrblError
            16: another command; 22: no feed; 26: no axes; 36: words of no use.
        """
        block = parse(line, self.axes)
        other = {group: code for group, code in block.codes.items() if group not in _JOG_GROUPS}
        if other not in ({}, {"once": "G53"}):
            raise GrblError(16)
        modes = self.modes | {g: c for g, c in block.codes.items() if g in _JOG_GROUPS} | {"motion": "G1"}
        _to_millimetres(block, modes["units"], self.axes)
        if not self._words(block):
            raise GrblError(26)
        feed = block.values.pop("F", 0.0)
        block.values.pop("N", None)
        actions = self._drive(block, modes, bool(other), feed)
        if block.values:
            raise GrblError(36)
        self._arrive(actions)
        return actions

    def _moves(self, block: Block, modes: dict[str, str], once: str | None) -> bool:
        """Tell whether the line drives, and refuse axes that two commands would use, or none."""
        words = self._words(block)
        uses_axes = once in ("G10", "G92")
        if uses_axes and block.codes.get("motion", "G80") != "G80":
            raise GrblError(24)
        if uses_axes and not words:
            raise GrblError(26)
        if once == "G53" and modes["motion"] not in ("G0", "G1"):
            raise GrblError(30)
        if uses_axes or not (words or "motion" in block.codes):
            return False
        if modes["motion"] == "G80":
            if words:
                raise GrblError(31)
            return False
        return True

    def _drive(self, block: Block, modes: dict[str, str], machine: bool, feed: float) -> list[Action]:
        motion = modes["motion"]
        if motion != "G0" and not feed:
            raise GrblError(22)
        words = self._words(block)
        end = self._target(block, modes, machine)
        for letter in words:
            del block.values[letter]
        if motion in ("G2", "G3"):
            path: Path = self._arc(block, modes, words, end)
        else:
            if math.dist(self.place, end) < _NO_WAY:
                return []
            path = Line(self.place, end)
        return [Drive(path, None if motion == "G0" else feed / 60)]

    def _target(self, block: Block, modes: dict[str, str], machine: bool) -> Place:
        target = list(self.place)
        system = self._system(modes["coordinates"])
        for axis, letter in enumerate(self.axes):
            if letter not in block.values:
                continue
            value = block.values[letter]
            if machine:
                target[axis] = value
            elif modes["distance"] == "G91":
                target[axis] += value
            else:
                target[axis] = value + system[axis] + self.shift[axis]
        return tuple(target)

    def _arc(self, block: Block, modes: dict[str, str], words: set[str], end: Place) -> Arc:
        plane = _PLANES[modes["plane"]]
        if not words:
            raise GrblError(26)
        if not words & {self.axes[axis] for axis in plane}:
            raise GrblError(32)
        clockwise = modes["motion"] == "G2"
        begins = (self.place[plane[0]], self.place[plane[1]])
        ends = (end[plane[0]], end[plane[1]])
        if "R" in block.values:
            centre = _centre(begins, ends, block.values.pop("R"), clockwise)
        else:
            offsets = [block.values.pop("IJK"[axis], None) for axis in plane]
            if offsets == [None, None]:
                raise GrblError(35)
            centre = (begins[0] + (offsets[0] or 0.0), begins[1] + (offsets[1] or 0.0))
        _check_radii(math.dist(begins, centre), math.dist(ends, centre))
        return Arc(self.place, end, plane, centre, _sweep(begins, ends, centre, clockwise))

    def _once(self, block: Block, once: str | None, modes: dict[str, str]) -> list[Action]:
        """Do what G4, G10 and G92 ask for."""
        values = block.values
        if once == "G4":
            if "P" not in values:
                raise GrblError(28)
            return [Dwell(values.pop("P"))]
        if once == "G10":
            self._set_system(block, modes)
        elif once == "G92":
            system = self._system(modes["coordinates"])
            for axis, letter in enumerate(self.axes):
                if letter in values:
                    self.shift[axis] = self.place[axis] - system[axis] - values.pop(letter)
        elif once == "G92.1":
            self.shift = [0.0] * len(self.axes)
        else:
            return []
        return [Dwell(0.0)]

    def _set_system(self, block: Block, modes: dict[str, str]) -> None:
        values = block.values
        if "P" not in values or "L" not in values:
            raise GrblError(28)
        kind, number = values.pop("L"), values.pop("P")
        if kind not in (2, 20) or "R" in values:
            raise GrblError(20)
        if number > _SYSTEMS:
            raise GrblError(29)
        system = self.systems[int(number) - 1] if number else self._system(modes["coordinates"])
        for axis, letter in enumerate(self.axes):
            if letter in values:
                value = values.pop(letter)
                system[axis] = value if kind == 2 else self.place[axis] - self.shift[axis] - value

    def _take_rest(self, block: Block) -> None:
        """Take the words that are always of use, and refuse what is left."""
        used = {letter: block.values.pop(letter) for letter in "NST" if letter in block.values}
        if used.get("T", 0.0) > _TOOLS:
            raise GrblError(38)
        if block.values:
            raise GrblError(36)
        self.spindle = used.get("S", self.spindle)
        self.tool = int(used.get("T", self.tool))

    def _flow(self, block: Block) -> list[Action]:
        flow = block.codes.get("flow")
        if flow == "M0":
            return [Pause()]
        if flow in ("M2", "M30"):
            self.modes |= _END
            return [Say("[MSG:Pgm End]")]
        return []

    def _arrive(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Drive):
                self.place = action.path.end

    def _words(self, block: Block) -> set[str]:
        return {letter for letter in block.values if letter in self.axes}

    def _system(self, code: str) -> list[float]:
        return self.systems[int(code[1:]) - 54]


def _to_millimetres(block: Block, units: str, axes: str) -> None:
    if units == "G20":
        for letter in block.values:
            if letter in axes or letter in "FIJKR":
                block.values[letter] *= _INCH


def _centre(
    begins: tuple[float, float], ends: tuple[float, float], radius: float, clockwise: bool
) -> tuple[float, float]:
    """Return the centre of the arc of a radius; negative: the longer of the two arcs."""
    x, y = ends[0] - begins[0], ends[1] - begins[1]
    chord = math.hypot(x, y)
    if chord < _NO_WAY:
        raise GrblError(33)
    square = radius * radius - chord * chord / 4
    if square < 0:
        raise GrblError(34)
    side = math.copysign(math.sqrt(square) / chord, radius) * (-1 if clockwise else 1)
    return (begins[0] + x / 2 - side * y, begins[1] + y / 2 + side * x)


def _check_radii(begins: float, ends: float) -> None:
    apart = abs(begins - ends)
    if begins < _NO_WAY or ends < _NO_WAY or apart > 0.5 or (apart > 0.005 and apart > 0.001 * begins):
        raise GrblError(33)


def _sweep(
    begins: tuple[float, float], ends: tuple[float, float], centre: tuple[float, float], clockwise: bool
) -> float:
    """Return the angle of an arc, radians: a whole turn where it ends where it began."""
    x, y = begins[0] - centre[0], begins[1] - centre[1]
    u, v = ends[0] - centre[0], ends[1] - centre[1]
    angle = math.atan2(x * v - y * u, x * u + y * v)
    if clockwise:
        return angle - 2 * math.pi if angle >= -_TURN_EPSILON else angle
    return angle + 2 * math.pi if angle <= _TURN_EPSILON else angle
