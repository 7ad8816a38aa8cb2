"""Which part of a stack is meant, as it is written on the command line."""

from __future__ import annotations

import re

from mirrorskin.io import InputError, Region


def region(text: str, option: str = "") -> Region:
    """Read a rectangle of the picture, as in ``100,50,640x480``.

    Parameters
    ----------
    text : str
        Column and row of its first pixel, from the picture's top left corner, then columns and rows.
    option : str, optional
        What to call it in messages.

    Raises
    ------
    InputError
        It is not that.
    """
    found = Region.read("".join(text.split()))
    if found is None:
        raise InputError(
            f"{option} {text}: the first column and row, and how many of each, are needed;"
            " write e.g. 100,50,640x480"
        )
    return found


def frame_range(text: str, option: str = "") -> tuple[int, int | None]:
    """Read a range of frames, as in ``10:200``: the first, from 0, and the first that is left out.

    Nothing before the colon means the first frame, nothing after it the last; see ``region``.

    Returns
    -------
    (int, int or None)
        None for the stack's end.
    """
    match = re.fullmatch(r"([0-9]{0,9}):([0-9]{0,9})", "".join(text.split()))
    start, stop = (int(one) if one else None for one in match.groups()) if match else (None, 0)
    if stop is not None and stop <= (start or 0):
        raise InputError(
            f"{option} {text}: the first frame, from 0, and a later one that is left out are needed;"
            " write e.g. 10:200, or 10: for all from 10 on"
        )
    return start or 0, stop
