"""Which pixel size a part of a calibration was made with, and whether it is still that."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from mirrorskin.io.calibration.types import GROUPS, Calibration
from mirrorskin.io.types import InputError

SIZED = ("zenith", "precession", "gel")
"""The parts whose lengths come from the size of a pixel."""

_SAME = 1e-3
"""Share by which pixel sizes may differ: less than a calibration's lengths are known to."""

Size = tuple[float, float]


def size_facts(pixel_size: Size) -> dict[str, float]:
    """Return what a part's process keeps of the pixel size that it was made with, mm along x and y."""
    return {f"pixel_size_{axis}": float(size) for axis, size in zip("xy", pixel_size, strict=True)}


def differ(one: Size, other: Size) -> bool:
    """Tell whether two pixel sizes differ so much that lengths of both cannot be used together."""
    return not all(abs(left - right) <= _SAME * right for left, right in zip(one, other, strict=True))


def outdated(
    calibration: Calibration, pixel_size: Size, parts: Iterable[str] = SIZED
) -> Iterator[tuple[str, Size]]:
    """Yield the parts that were made with another pixel size, and which; of some that is not known.

    Parameters
    ----------
    calibration : Calibration
    pixel_size : (float, float)
        As it is known now, mm along x and y.
    parts : iterable of str
        Which are looked at, by the names of a calibration's attributes.
    """
    there = calibration.parts()
    for part in parts:
        told = [calibration.process.get(f"{GROUPS[part]}.{fact}") for fact in size_facts(pixel_size)]
        if part not in there or not all(isinstance(one, float | int) for one in told):
            continue
        x, y = (float(one) for one in told if one is not None)
        if differ((x, y), pixel_size):
            yield part, (x, y)


def check_sizes(
    calibration: Calibration, pixel_size: Size | None, what: str, parts: Iterable[str] = SIZED
) -> None:
    """Refuse parts that were made with another pixel size than the one that is known now.

    Parameters
    ----------
    calibration : Calibration
    pixel_size : (float, float) or None
        Millimetres along x and y; without it, nothing is refused.
    what : str
        What is to be read with it, for the message where the calibration has no scale.
    parts : iterable of str
        Which are needed, by the names of a calibration's attributes.

    Raises
    ------
    InputError
        Lengths of two scales would be mixed.
    """
    if pixel_size is None:
        return
    for part, before in outdated(calibration, pixel_size, parts):
        says = f"{what} says" if calibration.lens is None else "the scale now says"
        raise InputError(
            f"{calibration.name or 'the calibration'}: calibrate {GROUPS[part]} again: it was made with"
            f" pixels of {_words(before)}, {says} {_words(pixel_size)}"
        )


def _words(size: Size) -> str:
    x, y = (f"{one:.5g}" for one in size)
    return f"{x} mm" if x == y else f"{x} x {y} mm"
