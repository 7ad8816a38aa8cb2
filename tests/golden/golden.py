"""Frozen answers: definition of a case, storage of its answers, and their comparison."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

ANSWERS = Path(__file__).with_name("answers.npz")

Answer = Mapping[str, Any]
Arrays = Mapping[str, NDArray[Any]]
Limits = tuple[float, float]  # of a difference: relative to the value, and absolute
UNIT = float(np.finfo(np.float32).eps)  # 1.2e-7, the distance between float32 numbers at 1


class Tolerance(NamedTuple):
    """The largest difference between floats: a part relative to their size, and one in the unit of the array.

    The size is the value plus, in a map (an array of two or more dimensions), the root mean square of the
    map, because values near 0 are differences of larger ones. ``of`` names the map if it is another one.
    """

    relative: float
    absolute: float = 0.0
    of: str = ""


# Processors round differently: sums have another order, functions other last bits. How much a map differs
# follows from its conditioning, or from where its solver stops. Each tolerance is at least 5 times the
# largest difference between code for AVX-512, AVX2 and AVX, which the comment ends with.
KERNEL = Tolerance(10 * UNIT)  # sums over frames in float32: 1 unit
WAVE = Tolerance(20 * UNIT, of="mean")  # parts of a wave are sums of samples as large as the mean: 3 units
# The error of the azimuth is that of the wave over its amplitude, a tenth of the mean (tilt over zenith);
# registered samples have four times the error of others.
NORMAL = Tolerance(4 * 10 * 10 * UNIT)  # 60 units
AZIMUTH = Tolerance(0.0, 2e-4)  # radians, NORMAL over the sine of zeniths from 0.2: 2e-5
RESIDUAL_SIGMA = Tolerance(80 * 10 * UNIT)  # from residuals, which are an eightieth of the mean: 24 units
FITTED = Tolerance(100 * UNIT, 1e-7)  # double precision, of maps in single precision: 5 units
HEIGHT = Tolerance(100 * UNIT)  # between frames, from differences of samples: 1 unit
SOLVED = Tolerance(10 * 1e-5)  # heights: solvers stop where the relative residual is 1e-5: 2e-6
SIGMA = Tolerance(5e-3)  # of solved heights, from the misfit that the solver leaves: 4e-4
VOLATILE = (
    *("date", "path", "hash", "sha256", "fingerprint", "modified", "batch_parameters", "start", "seconds"),
    *("version", "device", "driver", "program", "bytes", "integration_residual", "integration_iterations"),
)
"""Words in the names of what differs from run to run, or from machine to machine."""


@dataclass(frozen=True, slots=True)
class Case:
    """A call whose answers are frozen, and by how much its floats may differ; integers and texts may not.

    Where nothing touches, normals are those of noise, and the last bits of a processor's vectors decide them:
    only those in contact are compared. What rests on such normals is ``fragile``: of that only what is usual
    is compared, not each pixel.
    """

    make: Callable[[], Answer]
    tolerance: Tolerance
    maps: Mapping[str, Tolerance]
    fragile: bool = False

    def within(self, array: str, frozen: Arrays) -> Limits:
        """Return the limits of one of its arrays, by the last word of its name."""
        part, dot, name = array.rpartition(".")
        relative, absolute, of = Tolerance(*self.maps.get(name, self.tolerance))
        values = frozen[f"{part}{dot}{of}" if of else array]
        if values.dtype.kind == "f" and values.ndim > 1:
            finite = values[np.isfinite(values)].astype(float)
            absolute += relative * float(np.linalg.norm(finite)) / max(finite.size, 1) ** 0.5
        return relative, absolute


CASES: dict[str, Case] = {}


def case(
    tolerance: Tolerance = KERNEL, fragile: bool = False, **maps: Tolerance
) -> Callable[[Callable[[], Answer]], Callable[[], Answer]]:
    """Keep a function as the case of its name; it works in an empty folder that all cases share."""

    def keep(make: Callable[[], Answer]) -> Callable[[], Answer]:
        assert make.__name__ not in CASES
        CASES[make.__name__] = Case(make, tolerance, maps, fragile)
        return make

    return keep


def as_array(result: Any) -> NDArray[Any]:
    """Return an answer as an array; what is neither array nor number becomes JSON."""
    if isinstance(result, dict | list | str):
        return np.array(json.dumps(without_volatile(result), sort_keys=True))
    return np.asarray(result)


def without_volatile(result: Any) -> Any:
    """Return JSON without what differs from run to run."""
    if isinstance(result, dict):
        kept = {k: v for k, v in result.items() if not any(word in k.lower() for word in VOLATILE)}
        return {name: without_volatile(value) for name, value in kept.items()}
    if isinstance(result, str):
        return result.replace("-0.0000 ", "+0.0000 ")  # the sign of nothing
    return [without_volatile(item) for item in result] if isinstance(result, list) else result


def answers(name: str) -> dict[str, NDArray[Any]]:
    """Run a case, and return its arrays."""
    return {key: as_array(value) for key, value in CASES[name].make().items() if value is not None}


def load() -> dict[str, dict[str, NDArray[Any]]]:
    """Return the frozen answers of all cases."""
    kept: dict[str, dict[str, NDArray[Any]]] = {}
    if ANSWERS.exists():
        with np.load(ANSWERS) as file:
            for key in file.files:
                name, array = key.split("/")
                kept.setdefault(name, {})[array] = file[key]
    return kept


def save(kept: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
    """Freeze the answers of all cases."""
    arrays = {f"{name}/{key}": kept[name][key] for name in sorted(kept) for key in sorted(kept[name])}
    np.savez_compressed(ANSWERS, **arrays)


def differences(name: str, result: Arrays, frozen: Arrays) -> dict[str, str]:
    """Return what differs beyond the tolerance, in words, by array."""
    wrong = dict.fromkeys(frozen.keys() - result.keys(), "is missing")
    wrong |= dict.fromkeys(result.keys() - frozen.keys(), "is new")
    for key in sorted(result.keys() & frozen.keys()):
        answer, other, within = result[key], frozen[key], CASES[name].within(key, frozen)
        if CASES[name].fragile:
            same, words = _compare_usual(answer, other)
        else:
            contact = frozen.get(".".join([*key.split(".")[:-1], "contact"]))
            alike = other.dtype.kind == "f" and answer.shape == other.shape
            if contact is not None and alike and other.shape[: contact.ndim] == contact.shape:
                answer, other = answer[contact > 0], other[contact > 0]
            same, words = compare(answer, other, within)
        if not same:
            wrong[key] = words
    return wrong


def _compare_usual(result: NDArray[Any], frozen: NDArray[Any]) -> tuple[bool, str]:
    """Tell whether two arrays of one kind are usually alike, and texts tell of the same."""
    if (result.dtype, result.ndim) != (frozen.dtype, frozen.ndim) and frozen.dtype.kind != "U":
        return False, f"{frozen.dtype} {frozen.shape} became {result.dtype} {result.shape}"
    if frozen.dtype.kind == "U":
        text, other = (
            sorted(place for place, _ in _leaves(json.loads(str(text)))) for text in (result, frozen)
        )
        return text == other, "tells of other things" if text != other else "tells of the same"
    if result.shape != frozen.shape:
        return True, f"{frozen.shape} became {result.shape}"
    text, other = result.astype(float), frozen.astype(float)
    finite = np.isfinite(text) & np.isfinite(other)
    if not finite.any():
        return True, "nothing is known in both"
    error, size = np.median(np.abs(text - other)[finite]), np.median(np.abs(other[finite]))
    return bool(error <= 0.05 * size), f"differ by {error:.2g} in the median, of {size:.2g}"


def compare(result: NDArray[Any], frozen: NDArray[Any], within: Limits) -> tuple[bool, str]:
    """Tell whether two arrays are the same within a tolerance, and how they differ."""
    if (result.dtype.kind, result.shape) != (frozen.dtype.kind, frozen.shape):
        return False, f"{frozen.dtype} {frozen.shape} became {result.dtype} {result.shape}"
    if frozen.dtype.kind == "U":
        return _compare_texts(str(result), str(frozen), within)
    if result.dtype != frozen.dtype:
        return False, f"{frozen.dtype} became {result.dtype}"
    if frozen.dtype.kind != "f":
        count = int(np.count_nonzero(result != frozen))
        return count == 0, f"{count} of {frozen.size} differ" if count else "equal"
    return _compare_floats(result.astype(float), frozen.astype(float), within)


def _compare_floats(result: NDArray[Any], frozen: NDArray[Any], within: Limits) -> tuple[bool, str]:
    finite = np.isfinite(frozen)
    elsewhere = np.where(finite, 0.0, frozen)
    odd = int(
        np.count_nonzero((finite != np.isfinite(result)) | _differ(np.where(finite, 0.0, result), elsewhere))
    )
    if odd:
        return False, f"{odd} of {frozen.size} are no numbers in one of them only"
    error = np.abs(result[finite] - frozen[finite])
    if not error.any():
        return True, "equal"
    size = np.abs(frozen[finite])
    same = bool(np.all(error <= within[1] + within[0] * size))
    significant = size > np.finfo(np.float32).tiny
    relative = np.max(error[significant] / size[significant], initial=0.0)
    return same, f"{np.count_nonzero(error)} differ by up to {error.max():.2g}, relative {relative:.2g}"


def _differ(first: NDArray[Any], other: NDArray[Any]) -> NDArray[np.bool_]:
    return ~((first == other) | (np.isnan(first) & np.isnan(other)))


def _compare_texts(result: str, frozen: str, within: Limits) -> tuple[bool, str]:
    if result == frozen:
        return True, "equal"
    answer = dict(_leaves(json.loads(result)))
    other = dict(_leaves(json.loads(frozen)))
    wrong = [
        place for place in sorted(answer.keys() | other.keys()) if not _alike(place, answer, other, within)
    ]
    text = "; ".join(f"{place}: {other.get(place)!r} became {answer.get(place)!r}" for place in wrong[:5])
    return not wrong, text or "equal but for rounding"


def _alike(place: str, answer: dict[str, Any], other: dict[str, Any], within: Limits) -> bool:
    if place not in answer or place not in other:
        return False
    left, right = _number(answer[place]), _number(other[place])
    if isinstance(left, float) and isinstance(right, float):
        return abs(left - right) <= within[1] + within[0] * abs(right) or (left != left and right != right)
    return bool(left == right and type(left) is type(right))


def _number(value: Any) -> Any:
    """Return the number that a text is, if it is one."""
    try:
        return float(value) if isinstance(value, str) and "." in value else value
    except ValueError:
        return value


def _leaves(result: Any, place: str = "") -> list[tuple[str, Any]]:
    """Return every value of some JSON, and where it stands."""
    if not isinstance(result, dict | list):
        return [(place, result)]
    parts = result.items() if isinstance(result, dict) else enumerate(result)
    return [leaf for name, part in parts for leaf in _leaves(part, f"{place}.{name}" if place else str(name))]
