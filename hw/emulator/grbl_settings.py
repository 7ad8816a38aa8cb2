"""The ``$`` settings of GRBL 1.1, with defaults of a small, quick stage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from mirrorskin.hw.emulator.grbl_errors import GrblError

_COMMON: dict[int, float] = {
    0: 10,  # step pulse, us
    1: 25,  # step idle delay, ms
    2: 0,
    3: 0,
    4: 0,
    5: 0,
    6: 0,
    10: 1,  # status report: 1 machine position, 2 buffers
    11: 0.010,  # junction deviation
    12: 0.002,  # arc tolerance
    13: 0,  # report in inches
    20: 0,  # soft limits
    21: 0,  # hard limits
    22: 0,  # homing
    23: 0,  # homing direction: bits of the axes that home downwards
    24: 25.0,  # homing: slow rate a minute
    25: 500.0,  # homing: quick rate a minute
    26: 250,  # homing: debounce, ms
    27: 1.0,  # homing: pull-off
    30: 1000,
    31: 0,
    32: 0,
}
# Of each axis: steps a unit, rate a minute, acceleration in units/s^2, travel.
_PER_AXIS: dict[int, float] = {100: 1000.0, 110: 1800.0, 120: 500.0, 130: 200.0}
_WITH_DECIMALS = {11, 12, 24, 25, 27}
_POSITIVE = {24, 25}


class Settings:
    """What ``$$`` shows and ``$N=value`` sets.

    Parameters
    ----------
    axes : int
        How many there are.
    changed : mapping of int to float
        What differs from the defaults.

    Raises
    ------
    GrblError
        A number is unknown or a value cannot be.
    """

    def __init__(self, axes: int, changed: Mapping[int, float]) -> None:
        self._axes = axes
        self._values = dict(_COMMON)
        for base, value in _PER_AXIS.items():
            self._values.update({base + axis: value for axis in range(axes)})
        for number in sorted(changed, reverse=True):  # homing ($22) before the soft limits that need it ($20)
            self.set(number, changed[number])

    def __getitem__(self, number: int) -> float:
        """Return a setting by its number."""
        return self._values[number]

    def per_axis(self, base: int) -> tuple[float, ...]:
        """Return a setting of all axes: 110 rates a minute, 120 accelerations, 130 travels."""
        return tuple(self._values[base + axis] for axis in range(self._axes))

    def set(self, number: int, value: float) -> None:
        """Change a setting, as ``$N=value`` does."""
        if number not in self._values:
            raise GrblError(3)
        if value < 0 or (value == 0 and (number >= 100 or number in _POSITIVE)):
            raise GrblError(4)
        if number == 0 and value < 3:
            raise GrblError(6)
        if number == 20 and value and not self._values[22]:
            raise GrblError(10)
        if number == 22 and not value:
            self._values[20] = 0
        self._values[number] = value

    def lines(self) -> Iterable[str]:
        """Yield what ``$$`` prints."""
        for number, value in sorted(self._values.items()):
            decimals = number >= 100 or number in _WITH_DECIMALS
            yield f"${number}={value:.3f}" if decimals else f"${number}={value:.0f}"
