"""Whether a path's maps are those that the same frames give in memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.same import DisagreementError


def check_equal(
    name: str, expected: Mapping[str, NDArray[Any]], found: Mapping[str, NDArray[Any]], whose: str
) -> None:
    """Raise DisagreementError unless all maps are there and have the same values, or are NaN in both.

    Parameters
    ----------
    name : str
        Of the work that is checked.
    expected, found : mapping of str to ndarray, (H, W) or (H, W, 3)
        What must be found, and what was.
    whose : str
        Whose maps are expected.
    """
    for word, right in expected.items():
        if word not in found:
            raise DisagreementError(f"{name}: there is no {word}; nothing was timed")
        mine = found[word]
        differs = ~((mine == right) | (np.isnan(mine) & np.isnan(right)))
        if differs.any():
            place = tuple(int(number) for number in np.argwhere(differs)[0])
            raise DisagreementError(
                f"{name} differs from {whose} in the {word} of {np.count_nonzero(differs)} of {differs.size} "
                f"values, first at {place}: {mine[place]}, not {right[place]}; nothing was timed"
            )
