"""The G-code that the driver uses: straight moves and arcs, absolute and relative, in millimetres.

Error codes are those of GRBL 1.1; anything else is refused with ``error:20``.
"""

from __future__ import annotations

import math
import re

from mirrorskin.twin.emulator.motion import Arc, Line, Path, Place

_WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+))?")
_GROUPS = {
    "motion": ("G0", "G1", "G2", "G3"),
    "plane": ("G17", "G18", "G19"),
    "units": ("G21",),
    "distance": ("G90", "G91"),
    "feed mode": ("G94",),
    "machine": ("G53",),
}
_GROUP_OF = {code: group for group, codes in _GROUPS.items() for code in codes}
_PLANES = {"G17": (0, 1), "G18": (2, 0), "G19": (1, 2)}
_TURN_EPSILON = 5e-7  # radians below which an arc is a whole turn
_MIN_MOVE = 1e-9  # axis units; shorter moves are ignored

Drive = tuple[Path, float]
"""A path, and the feed along it in units per second; infinite for the maximum speed."""


class GrblError(Exception):
    """A line is refused with ``error:N``; see ``doc/csv/error_codes_en_US.csv`` of GRBL 1.1."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")


class Interpreter:
    """The modal state and the position of the program, in machine coordinates.

    ``offset`` is that of the work coordinates, in which lines are, unless they begin with ``G53``.
    """

    def __init__(self, axes: str, place: Place) -> None:
        self.axes = axes
        self.offset: Place = (0.0,) * len(axes)
        self.reset(place)

    def reset(self, place: Place) -> None:
        """Restart at a position, as after a reset."""
        self.place: Place = place
        self._modes = {"motion": "G0", "plane": "G17", "distance": "G90"}
        self._feed = 0.0  # units per minute

    def run(self, line: str) -> Drive | None:
        """Execute a line without spaces, and return its motion; after a `GrblError` nothing has changed."""
        codes, values = self._words(line)
        modes = self._modes | {group: code for group, code in codes.items() if group in self._modes}
        feed = values.get("F", self._feed)
        drive = None
        if any(axis in values for axis in self.axes) or "motion" in codes:
            drive = self._drive(modes, values, "machine" in codes, feed)
        self._modes, self._feed = modes, feed
        if drive is not None:
            self.place = drive[0].end
        return drive

    def set_offset(self, line: str) -> bool:
        """Execute ``G92`` or ``G10 L2 P1`` with places; return whether the line is one of these."""
        given = re.fullmatch(rf"(G92|G10L2P1)((?:[{self.axes}][+-]?[\d.]+)+)", line)
        if given is None:
            return False
        values = {word[0]: float(word[1:]) for word in re.findall(r"[A-Z][^A-Z]+", given[2])}
        self.offset = tuple(
            before if letter not in values else at - values[letter] if given[1] == "G92" else values[letter]
            for letter, at, before in zip(self.axes, self.place, self.offset, strict=True)
        )
        return True

    def _words(self, line: str) -> tuple[dict[str, str], dict[str, float]]:
        """Return the commands by group, and the other numbers by letter."""
        codes: dict[str, str] = {}
        values: dict[str, float] = {}
        at = 0
        while at < len(line):
            word = _WORD.match(line, at)
            if word is None or word[2] is None:
                raise GrblError(1 if word is None else 2)
            at, letter, value = word.end(), word[1], float(word[2])
            allowed = codes if letter in "GM" else values
            if letter in "GM":
                code = f"{letter}{value:g}"
                if code not in _GROUP_OF:
                    raise GrblError(20)
                if _GROUP_OF[code] in codes:
                    raise GrblError(24 if _GROUP_OF[code] == "motion" else 21)
                codes[_GROUP_OF[code]] = code
            elif letter not in self.axes and letter not in "FIJK":
                raise GrblError(20)
            elif letter in allowed:
                raise GrblError(25)
            else:
                values[letter] = value
        return codes, values

    def _drive(
        self, modes: dict[str, str], values: dict[str, float], machine: bool, feed: float
    ) -> Drive | None:
        motion = modes["motion"]
        if motion != "G0" and not feed:
            raise GrblError(22)
        relative = modes["distance"] == "G91" and not machine
        end = tuple(
            at + values.get(letter, 0.0)
            if relative or letter not in values
            else values[letter] + (0.0 if machine else offset)
            for letter, at, offset in zip(self.axes, self.place, self.offset, strict=True)
        )
        if motion in ("G2", "G3"):
            plane = _PLANES[modes["plane"]]
            named = {axis for axis, letter in enumerate(self.axes) if letter in values}
            if not named:
                raise GrblError(26)
            if not named <= set(plane):  # the firmware would move along a helix
                raise GrblError(20)
            return self._arc(plane, values, end, motion == "G2"), feed / 60
        if math.dist(self.place, end) < _MIN_MOVE:
            return None
        return Line(self.place, end), math.inf if motion == "G0" else feed / 60

    def _arc(self, plane: tuple[int, int], values: dict[str, float], end: Place, clockwise: bool) -> Arc:
        """Return the arc about the centre given by I, J and K relative to its start."""
        offsets = [values.get("IJK"[axis]) for axis in plane]
        if offsets == [None, None]:
            raise GrblError(35)
        x, y = (-(offset or 0.0) for offset in offsets)
        centre = (self.place[plane[0]] - x, self.place[plane[1]] - y)
        u, v = (end[axis] - middle for axis, middle in zip(plane, centre, strict=True))
        start_radius, end_radius = math.hypot(x, y), math.hypot(u, v)
        mismatch = abs(start_radius - end_radius)
        if (
            min(start_radius, end_radius) < _MIN_MOVE
            or mismatch > 0.5
            or (mismatch > 0.005 and mismatch > 0.001 * start_radius)
        ):
            raise GrblError(33)
        angle = math.atan2(x * v - y * u, x * u + y * v)
        if clockwise:
            sweep = angle - 2 * math.pi if angle >= -_TURN_EPSILON else angle
        else:
            sweep = angle + 2 * math.pi if angle <= _TURN_EPSILON else angle
        return Arc(self.place, end, plane, centre, sweep)
