"""The whole path as a lab would write it today, beside ours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from mirrorskin import io
from mirrorskin.bench.harness import Work, take_turns
from mirrorskin.bench.limits import Limits
from mirrorskin.bench.memory import check_memory
from mirrorskin.bench.paths import files
from mirrorskin.bench.paths.equal import check_equal
from mirrorskin.bench.paths.labs import find_labs
from mirrorskin.bench.paths.press import make_press
from mirrorskin.bench.paths.targets import as_fast_as
from mirrorskin.bench.paths.whole import PATH, ROUNDS, to_result
from mirrorskin.bench.results import Case, Row, Target
from mirrorskin.bench.same import DisagreementError
from mirrorskin.bench.stacks import references
from mirrorskin.io.types import Floats
from mirrorskin.kernels.device import Device

PLAIN = f"{PATH}, equation 4"

_BOUNDS = {"h5py and NumPy argmax": 10.0, "h5py and Numba": 2.0}
_ROUNDING = 1e-6  # mm
_MAPS = 64  # bytes a pixel for all maps


@dataclass(frozen=True, slots=True)
class LabCase(files.FileCase):
    """A press in a file, contiguous, and heights by equation 4 of it."""

    @property
    def title(self) -> str:
        """What is measured, in one line."""
        size = " x ".join(map(str, self.shape))
        return (
            "heights by equation 4 with hold 2, and saved; our first row is the full default, which tells "
            f"sub-frame heights and sigma besides; {size} uint8, contiguous"
        )


def run_lab(case: LabCase, device: Device, quick: bool) -> Case:
    """Time what a lab would write beside the full default and equation 4; heights must be the same first.

    Raises
    ------
    mirrorskin.io.InputError
        There is not enough memory, or room for files.
    DisagreementError
        Equation 4 gave other heights, or the full default one outside of the step before.
    """
    check_memory(case.name, 4 * case.bytes + _MAPS * math.prod(case.shape[1:]))
    labs, absent = find_labs()
    with files.new_folder(case.name, case.bytes + 10 * _MAPS * math.prod(case.shape[1:])) as folder:
        press, path = make_press(case.shape), folder / "press.h5"
        files.record(press, path)
        limits = Limits(device, press.block.frames)
        with io.open_recording(path) as recording:
            dataset = recording.dataset
        ours: dict[str, Work] = {
            PATH: partial(to_result, path, folder / "result.h5", device),
            PLAIN: partial(to_result, path, folder / "plain.h5", device, subframe=False),
        }
        known = path, dataset, *references(case.shape[1:], press.dtype), folder / "heights.npy"
        theirs: dict[str, Work] = {
            f"{name}, file to result": partial(lab, *known) for name, lab in labs.items()
        }

        def check(results: dict[str, Any]) -> None:
            _check(results, list(theirs), press.block.travel)

        works = {**limits.works(), **ours, **theirs}
        measured = take_turns(works, 1 if quick else ROUNDS, device.profile, check)
    rows = {name: Row(name, measured[name], case.bytes, case.shape[0]) for name in (*ours, *theirs)}
    targets = () if quick else _judge(rows)
    return Case(case.name, case.title, [*limits.rows(measured), *rows.values()], absent, (), targets)


def _check(results: dict[str, Any], theirs: list[str], travel: Floats | None) -> None:
    """Require the same heights of all, and of the full default that they lie in the same step."""
    assert travel is not None
    full, plain = results[PATH].height, results[PLAIN].height
    for name in theirs:
        check_equal(name, {"height": plain}, {"height": results[name]}, PLAIN)
    above, step = full - plain, travel[1] - travel[0]
    inside = (above > -_ROUNDING) & (above < step + _ROUNDING) | np.isnan(full) & np.isnan(plain)
    if not inside.all():
        raise DisagreementError(
            f"{PATH}: {np.count_nonzero(~inside)} heights lie outside of the step of equation 4; "
            "nothing was timed"
        )


def _judge(rows: dict[str, Row]) -> tuple[Target, ...]:
    known = {f"{name}, file to result": bound for name, bound in _BOUNDS.items()}
    return tuple(
        as_fast_as(PATH, bound, rows[PATH], rows[name]) for name, bound in known.items() if name in rows
    )
