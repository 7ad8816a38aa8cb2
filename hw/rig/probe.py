"""Finds the zero of the travel: the body is lowered step by step until the picture shows contact."""

from __future__ import annotations

import math

import numpy as np

from mirrorskin.hw.base.errors import HardwareError
from mirrorskin.hw.base.stage import Limits
from mirrorskin.hw.rig.delay import block_means
from mirrorskin.hw.rig.plans import VerticalPlan
from mirrorskin.hw.rig.rig import Rig
from mirrorskin.hw.rig.scan import StepScan
from mirrorskin.io.base.types import Floats, InputError

_FRAMES, _PLACES = 4, 4  # frames at a position, and number of preceding positions to compare with
_SIGMAS = 8.0  # change of a block's mean on contact, in standard deviations
_SIGMA_MIN = 1e-4  # minimum standard deviation, as a share of the greatest block mean


def find_contact(rig: Rig, start: float, step: float) -> float:
    """Lower the body until the picture changes, lift it, and return the travel at first contact, mm.

    The result is accurate to half a step. Contact is detected where the mean of one of 16 x 16 blocks differs
    from its mean at the four preceding positions by more than eight standard deviations, so slow drift has no
    effect. The first four positions must be without contact.

    Parameters
    ----------
    rig : Rig
        The body goes no deeper than its limits allow.
    start : float
        First travel, mm.
    step : float
        Distance between positions, mm.

    Raises
    ------
    InputError
        There are fewer than five positions.
    HardwareError
        There was no contact, or it occurred before the fifth position.

    Examples
    --------
    >>> with open_rig(load_rig("rig.toml")) as rig:  # doctest: +SKIP
    ...     find_contact(rig, start=-1.0, step=0.05)
    0.025
    """
    plan = contact_plan(rig.stage.limits, start, step)
    before: list[Floats] = []
    with StepScan(rig, plan, frames=_FRAMES) as scan:
        buffer = np.empty((_FRAMES, *scan.shape[1:]), scan.dtype)
        while (block := scan.read(buffer)) is not None and block.travel is not None:
            means = [block_means(block.frames)]
            while sum(map(len, means)) < _FRAMES and (more := scan.read(buffer)) is not None:
                means.append(block_means(more.frames))
            here = np.concatenate(means)
            if len(before) == _PLACES and _differ(np.concatenate(before), here):
                return float(block.travel[0]) - step / 2
            before = [*before[1 - _PLACES :], here]
    raise HardwareError(
        f"{rig.name}: the picture showed no contact between travels of {start:g} and {plan.stop:g} "
        "mm: check the position of the object and the light, and start higher"
    )


def contact_plan(limits: Limits, start: float, step: float) -> VerticalPlan:
    """Return the plan of `find_contact`, down to the limits; InputError if it has too few positions."""
    plan = VerticalPlan(start, min(limits.press, limits.travel[1]), step=step)
    if len(plan.distances) <= _PLACES:
        raise InputError(
            f"{len(plan.distances)} positions between travels of {start:g} and {plan.stop:g} mm are too few"
            f" to detect contact: give a smaller step, or start higher, for at least {_PLACES + 1}"
        )
    return plan


def _differ(before: Floats, here: Floats) -> bool:
    """Return whether any of the block means, (n, k), differ from those of other positions."""
    noise = max(float(np.median(before.std(axis=0, ddof=1))), _SIGMA_MIN * float(np.abs(before).max()))
    sigma = noise * math.sqrt(1 / len(before) + 1 / len(here))
    return bool(np.abs(here.mean(axis=0) - before.mean(axis=0)).max() > _SIGMAS * sigma)
