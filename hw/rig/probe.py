"""Finds the zero of the travel: the body is lowered step by step until the picture shows contact."""

from __future__ import annotations

import math

import numpy as np

from mirrorskin.hw.errors import HardwareError
from mirrorskin.hw.rig.delay import block_means
from mirrorskin.hw.rig.plans import VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.io.types import Floats

_FRAMES, _PLACES = 4, 4  # at a place, and places before, that a place is compared with
_SIGMAS = 8.0  # of a block's mean, by which it changes on contact
_LEAST = 1e-4  # of the greatest block mean, that a standard deviation is taken for at least


def find_contact(rig: Rig, start: float, step: float) -> float:
    """Lower the body until the picture changes, lift it, and return the travel at first contact, mm.

    Contact lies at most half a step from there. It is told where the mean of one of 16 x 16 blocks differs
    from that of the four places before by more than eight standard deviations, so that slow drift does not
    matter. The first four places must be without contact.

    Parameters
    ----------
    rig : Rig
        The body goes no deeper than its limits allow.
    start : float
        Travel of the first place, mm.
    step : float
        From place to place, mm.

    Raises
    ------
    HardwareError
        There was no contact, or it came before the fifth place.

    Examples
    --------
    >>> with open_rig(load_rig("rig.toml")) as rig:  # doctest: +SKIP
    ...     find_contact(rig, start=-1.0, step=0.05)
    0.025
    """
    limits = rig.stage.limits
    deepest = min(limits.press, limits.travel[1])
    before: list[Floats] = []
    with StepScan(rig, VerticalPlan(start, deepest, step=step), frames=_FRAMES) as scan:
        room = np.empty((_FRAMES, *scan.shape[1:]), scan.dtype)
        while (block := scan.read(room)) is not None and block.travel is not None:
            seen = [block_means(block.frames)]
            while sum(map(len, seen)) < _FRAMES and (more := scan.read(room)) is not None:
                seen.append(block_means(more.frames))
            here = np.concatenate(seen)
            if len(before) == _PLACES and _differ(np.concatenate(before), here):
                return float(block.travel[0]) - step / 2
            before = [*before[1 - _PLACES :], here]
    raise HardwareError(
        f"{rig.name}: the picture showed no contact between travels of {start:g} and {deepest:g} mm: "
        "see where the object is, and the light, and begin higher"
    )


def _differ(before: Floats, here: Floats) -> bool:
    """Whether any of the block means, (n, k), of one place differ from those of others."""
    noise = max(float(np.median(before.std(axis=0, ddof=1))), _LEAST * float(np.abs(before).max()))
    sigma = noise * math.sqrt(1 / len(before) + 1 / len(here))
    return bool(np.abs(here.mean(axis=0) - before.mean(axis=0)).max() > _SIGMAS * sigma)
