"""Numbers in files that say their unit."""

from __future__ import annotations

import functools
import re
from typing import Any

from mirrorskin.io.types import InputError

# pint would compute what it is given; it is given names alone.
_NAMES = re.compile(r"([^\W\d]+|1)/[^\W\d]+|[^\W\d]+|°")


def factor(given: str, wanted: str, where: str) -> float:
    """Return the number that turns a value in one unit into another.

    Parameters
    ----------
    given, wanted : str
        Units, as in ``um`` or ``1/deg``.
    where : str
        What holds the value, for messages.

    Raises
    ------
    InputError
        The unit is unknown or of another kind.
    """
    if given == wanted:
        return 1.0
    import pint  # a third of a second, and files in our own units do not need it

    try:
        if not _NAMES.fullmatch(given):
            raise ValueError(given)
        one = _registry()(given)
        # A pixel of a style sheet, px, is a length, but nobody here means that one.
        if "css_pixel" in str(one.units):
            raise ValueError(given)
        return float(one.to(wanted).magnitude)
    except (pint.PintError, AttributeError, ValueError, TypeError) as error:
        raise InputError(
            f"{where} is in {given!r}, which cannot be turned into {wanted}: correct its attribute units"
        ) from error


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()
