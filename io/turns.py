"""One turn of a result that has maps of each."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.types import InputError, Result


def of_turn(result: Result, turn: int | None) -> Result:
    """Return the maps of one turn, or those of a result that has no turns.

    Parameters
    ----------
    result : Result
    turn : int or None
        Number of the turn, from 0; None of a result whose maps are of all turns together.

    Returns
    -------
    Result
        With maps (H, W); its components are numbered from 0, and its process tells the turn.

    Raises
    ------
    InputError
        The result has turns and none is chosen, or it does not have that one.
    """
    maps = result.maps()
    size = next((values.shape[: values.ndim - (name == "normals")] for name, values in maps.items()), (0, 0))
    if len(size) == 2:
        if turn is not None:
            raise InputError("the maps of this result are not of single turns: leave --turn out")
        return result
    if turn is None or not 0 <= turn < size[0]:
        wrong = "" if turn is None else f", and none of turn {turn}"
        count, most = ("1 turn", "") if size[0] == 1 else (f"{size[0]} turns", f" to {size[0] - 1}")
        raise InputError(f"this result has maps of {count}{wrong}: choose one with --turn 0{most}")
    chosen: dict[str, Any] = {name: values[turn] for name, values in maps.items()}
    if result.component is not None:
        chosen |= _renumbered(result.component[turn], result.offset_unknown)
    return replace(result, **chosen, process={**result.process, "turn": turn})


def _renumbered(
    component: NDArray[np.int32], offset_unknown: NDArray[np.uint8] | None
) -> dict[str, NDArray[Any]]:
    """Give the components that one turn has numbers from 0 on."""
    own = np.unique(component[component >= 0])
    numbered = np.where(component >= 0, np.searchsorted(own, component), -1).astype(np.int32)
    if offset_unknown is None:
        return {"component": numbered}
    return {"component": numbered, "offset_unknown": offset_unknown[own]}
