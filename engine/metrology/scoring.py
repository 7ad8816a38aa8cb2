"""Comparison of results with the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from mirrorskin.engine.base.inputs import Maps, as_result
from mirrorskin.io import InputError, Result, Truth
from mirrorskin.io.base.arguments import check_kind, checked
from mirrorskin.io.base.findings import findings_of
from mirrorskin.io.model.maps import SlipStatus
from mirrorskin.io.model.result import map_shape
from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_JUMP = np.radians(10.0)  # minimum angle between normals of neighbours at an edge


@dataclass(frozen=True, slots=True)
class AngleScore:
    """Angular errors of normals, or of azimuths, where the sheet was in contact in every frame.

    Attributes
    ----------
    answered : int
        Number of pixels with an answer and a known truth; for angles, only those in contact in the truth and
        in the result. Level pixels have no azimuth.
    touched : int
        Pixels in contact.
    coverage : float
        Share of the touched pixels that are answered.
    rms, median, p99, largest : float
        Statistics of the angle between answer and truth, degrees, or of the absolute height error, mm; NaN
        without answers.
    chi_square : float
        Mean of (error / sigma)^2: 1 if the standard deviations are correct; NaN without them.
    """

    answered: int
    touched: int
    coverage: float
    rms: float
    median: float
    p99: float
    largest: float
    chi_square: float

    def table(self) -> dict[str, str]:
        """Return names and values to print."""
        return self._table("deg", "error", {})

    def _table(self, unit: str, error: str, after_rms: dict[str, str]) -> dict[str, str]:
        chi_square = {} if math.isnan(self.chi_square) else {"mean (error/sigma)^2": f"{self.chi_square:.3f}"}
        return {
            "answered": f"{self.answered} pixels",
            "coverage": f"{100 * self.coverage:.2f} % of the {self.touched} pixels in contact",
            "RMS error": f"{self.rms:.4f} {unit}",
            **after_rms,
            f"median {error}": f"{self.median:.4f} {unit}",
            f"99 % {error}": f"{self.p99:.4f} {unit}",
            f"largest {error}": f"{self.largest:.4f} {unit}",
            **chi_square,
        }


@dataclass(frozen=True, slots=True)
class HeightScore(AngleScore):
    """Errors of a height map; see `AngleScore`.

    The mean difference from the truth is subtracted from components with relative heights.

    Attributes
    ----------
    mean : float
        Mean height error, mm.
    relative : int
        Number of components with relative heights.
    """

    mean: float
    relative: int = 0

    def table(self) -> dict[str, str]:
        """Return names and values to print."""
        mean = {"mean error": f"{self.mean:+.4f} mm"}
        if self.relative:
            mean["offset"] = f"mean difference taken off; pieces without a known height: {self.relative}"
        return self._table("mm", "|error|", mean)


@dataclass(frozen=True, slots=True)
class ContactScore:
    """Errors of the contact in every frame.

    Attributes
    ----------
    recall, precision : float
        Share of the pixels in contact that were found, and share of the found pixels that are in contact.
    lost : int
        Pixels with an answer that lost contact in some frame.
    lost_flagged, wrongly_flagged : float
        Share of these, and share of the other pixels with an answer, that the result marks as out of contact.
    """

    recall: float
    precision: float
    lost: int
    lost_flagged: float
    wrongly_flagged: float

    def table(self) -> dict[str, str]:
        """Return names and values to print."""
        return {
            "recall": f"{100 * self.recall:.2f} %",
            "precision": f"{100 * self.precision:.2f} %",
            "lost and flagged": f"{100 * self.lost_flagged:.2f} % of {self.lost} pixels",
            "kept but flagged": f"{100 * self.wrongly_flagged:.2f} %",
        }


@dataclass(frozen=True, slots=True)
class EdgeScore:
    """Errors of edges: borders of contact, and jumps of the normal by more than 10 degrees.

    Attributes
    ----------
    true, found : int
        Pixels on both sides of true edges, and of found ones.
    recall, precision : float
        Share of the true pixels with a found one within a pixel, and of the found pixels with a true one.
    """

    true: int
    found: int
    recall: float
    precision: float

    def table(self) -> dict[str, str]:
        """Return names and values to print."""
        return {
            "recall": f"{100 * self.recall:.2f} % of {self.true} pixels",
            "precision": f"{100 * self.precision:.2f} % of {self.found} pixels",
        }


@dataclass(frozen=True, slots=True)
class SlipScore:
    """Errors of displacement and slip in a slide or a twist.

    Attributes
    ----------
    answered, touched : int
        Pixels in contact with the status slipped or sticks, and all pixels in contact.
    coverage : float
        Share of these that are answered.
    recall, precision : float
        Share of the slipped pixels that were found, and share of the found pixels that slipped; pixels
        next to a border of contact or slip are ignored.
    stick_radius, true_stick_radius : float
        At the end, relative to the contact's radius: square root of the share of the answered pixels that
        stick.
    unit : str
        Unit of onsets.
    onset_rms, onset_chi_square : float
        Root mean square error of the onset, and mean of (error / sigma)^2, where result and truth slipped.
    displacement_rms, displacement_chi_square : float
        The same for the displacement in the last frame, mm; chi square is along each axis.
    """

    answered: int
    touched: int
    coverage: float
    recall: float
    precision: float
    stick_radius: float
    true_stick_radius: float
    unit: str
    onset_rms: float
    onset_chi_square: float
    displacement_rms: float
    displacement_chi_square: float

    def table(self) -> dict[str, str]:
        """Return names and values to print."""
        return {
            "answered": f"{self.answered} pixels",
            "coverage": f"{100 * self.coverage:.2f} % of the {self.touched} pixels in contact",
            "recall": f"{100 * self.recall:.2f} %",
            "precision": f"{100 * self.precision:.2f} %",
            "stick radius": self._stick_radius(),
            "RMS error of the onset": f"{self.onset_rms:.4g} {self.unit}",
            "onset's mean (error/sigma)^2": f"{self.onset_chi_square:.3f}",
            "RMS error of the displacement": f"{self.displacement_rms:.4g} mm",
            "displacement's mean (error/sigma)^2": f"{self.displacement_chi_square:.3f}",
        }

    def _stick_radius(self) -> str:
        radius, true = self.stick_radius, self.true_stick_radius
        error = f" ({100 * (radius / true - 1):+.1f} %)" if true else ""
        return f"{100 * radius:.2f} % of the contact's, in truth {100 * true:.2f} %{error}"


@dataclass(frozen=True, slots=True)
class Score:
    """A result's errors; None for missing maps.

    Attributes
    ----------
    height : HeightScore or None
        Measured heights.
    filled : HeightScore or None
        Filled heights.
    normal : AngleScore or None
    azimuth : AngleScore or None
        Azimuths of a result without normals.
    contact : ContactScore or None
    edges : EdgeScore or None
        None for registered frames, whose contact refers to points of the object, not to pixels.
    slip : SlipScore or None
        Slip of a slide or a twist that starts with the first frame.
    slip_left_out : str or None
        Reason why the result's slip is not scored.
    notes : tuple of str
        Warnings and notes of the result.
    """

    height: HeightScore | None = None
    filled: HeightScore | None = None
    normal: AngleScore | None = None
    azimuth: AngleScore | None = None
    contact: ContactScore | None = None
    edges: EdgeScore | None = None
    slip: SlipScore | None = None
    slip_left_out: str | None = None
    notes: tuple[str, ...] = ()

    def parts(self) -> dict[str, Any]:
        """Return the available scores, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        del values["slip_left_out"], values["notes"]
        return {name: value for name, value in values.items() if value is not None}

    def table(self) -> dict[str, str]:
        """Return names and values to print."""
        return {
            f"{name} {what}": text
            for name, part in self.parts().items()
            for what, text in part.table().items()
        }


@checked(truth=check_kind(Truth))
def score(result: Maps, truth: Truth) -> Score:
    """Compare the maps of a result with the truth.

    Parameters
    ----------
    result : Result, mapping, xarray.Dataset, path or array_like, (H, W)
        Maps with at least one of ``height``, ``normals``, ``azimuth``, ``contact``, ``edges``, ``slip_onset``
        and ``displacement``; if there are maps for each turn, all turns are compared.
    truth : Truth
        True maps of the same size.

    Returns
    -------
    Score

    Raises
    ------
    InputError
        There is nothing to compare, the sizes differ, or the result was undistorted.

    Examples
    --------
    >>> import numpy as np
    >>> from mirrorskin import io
    >>> flat = np.zeros((1, 2), np.float32)
    >>> truth = io.Truth(flat, flat, flat, np.ones((1, 2), np.uint8))
    >>> score(io.Result(height=flat + 0.25), truth).height.rms
    0.25
    """
    result = as_result(result, "result")
    if result.fitted.undistorted:
        remedy = "score one that was made without a scale in its calibration"
        raise InputError(f"the result is undistorted, the truth is that of the camera's pixels: {remedy}")
    size = map_shape(result)[-2:]
    if result.maps() and size != truth.height.shape:
        raise InputError(f"the result is {size} pixels, the truth {truth.height.shape}: not of one stack")
    touched = truth.contact.astype(bool)
    azimuth = result.azimuth if result.normals is None else None
    # Maps of registered frames belong to the object's points, but the truth to the picture's pixels.
    contact, edges = (None, None) if result.fitted.registered else (result.contact, result.edges)
    height, filled = _score_heights(result, truth.height, touched)
    left_out = _why_slip_is_left_out(result, truth)
    result_score = Score(
        height=height,
        filled=filled,
        normal=None if result.normals is None else _score_normals(result, truth, touched),
        azimuth=None if azimuth is None else _score_angles(_turned(azimuth, truth.azimuth), None, touched),
        contact=None if contact is None else _score_contact(result, touched),
        edges=None if edges is None else _score_edges(edges, _edges_of(truth)),
        slip=None if left_out or result.slip_onset is None else _score_slip(result, truth, touched),
        slip_left_out=left_out,
        notes=tuple(finding.text for finding in findings_of("result", result.process)),
    )
    if not result_score.parts() and left_out is not None:
        raise InputError(f"slip, all that the result has, cannot be scored: {left_out}")
    if not result_score.parts():
        raise InputError("the result has no heights, normals, azimuths, contact, edges or slip to score")
    return result_score


_SLIP_MAPS = ("displacement", "slip_onset", "status")


def _why_slip_is_left_out(result: Result, truth: Truth) -> str | None:
    """Return why a result's slip cannot be compared with the truth; None if it can, or without slip."""
    if result.slip_onset is None and result.displacement is None:
        return None
    missing = [name for name in _SLIP_MAPS if name not in result]
    distance = _distance(result)
    missing += ["slide_distance"] if distance is None else []
    if missing:
        return f"the result lacks {' and '.join(missing)}; reconstruct it again"
    if truth.slip_onset is None or truth.displacement is None:
        return "the truth has none; simulate a slide or a twist with --contact elastic"
    assert distance is not None
    count, whole = len(distance), len(truth.displacement)
    first, end = result.fitted.source_frames or (0, whole)
    if (first, end) != (0, count) or count > whole:
        return (
            f"the result is of {count} frames ({first}:{end}), the truth of {whole} from frame 0 on;"
            " reconstruct all from frame 0 to any other"
        )
    return None


def _distance(result: Result) -> Doubles | None:
    """Return the distance or angle of the body in each frame, mm or radians."""
    distance: Doubles | None = result.slide_distance if result.twist_angle is None else result.twist_angle
    return distance


def _score_slip(result: Result, truth: Truth, touched: Mask) -> SlipScore:
    """Score displacement and slip in the frames of the result, which are the first of the truth."""
    onset, moved, distance = result.slip_onset, result.displacement, _distance(result)
    assert onset is not None
    assert moved is not None
    assert distance is not None
    assert result.status is not None
    assert truth.displacement is not None
    assert truth.slip_onset is not None
    true_onset = np.where(truth.slip_onset <= distance[-1], truth.slip_onset, np.nan)
    answered = touched & np.isin(result.status, (SlipStatus.SLIPPED, SlipStatus.STICKS))
    slipped, true = result.status == SlipStatus.SLIPPED, np.isfinite(true_onset)
    inside = answered & ~_around(~touched) & ~(_around(true) & _around(~true & touched))
    both = answered & slipped & true
    error = onset.astype(np.float64) - true_onset
    last = moved if moved.ndim == 3 else moved[-1]
    off = last.astype(np.float64) - truth.displacement[len(distance) - 1]
    compared = touched & np.isfinite(off).all(axis=-1)
    sigma = result.displacement_sigma
    along = None if sigma is None else np.repeat(sigma[..., np.newaxis], 2, axis=-1)
    return SlipScore(
        answered=int(np.count_nonzero(answered)),
        touched=int(np.count_nonzero(touched)),
        coverage=_share(answered, touched),
        recall=_share(slipped, inside & true),
        precision=_share(true, inside & slipped),
        stick_radius=math.sqrt(_share(~slipped, answered)),
        true_stick_radius=math.sqrt(_share(~true, answered)),
        unit=result.declaration("slip_onset").unit,
        onset_rms=_spread(np.abs(error[both]))["rms"],
        onset_chi_square=_chi_square(error, result.slip_onset_sigma, both),
        displacement_rms=_spread(np.abs(off[compared]))["rms"],
        displacement_chi_square=_chi_square(off, along, np.repeat(compared[..., np.newaxis], 2, axis=-1)),
    )


def _score_heights(
    result: Result, truth: NDArray[np.float32], touched: Mask
) -> tuple[HeightScore | None, HeightScore | None]:
    """Score measured heights, and filled ones, if there are any."""
    if result.height is None:
        return None, None
    error = result.height.astype(np.float64) - truth
    shift, relative = _mean_differences(result, error)
    error = error - shift
    filled = np.zeros(error.shape, bool) if result.filled is None else result.filled.astype(bool)
    measured = _score_errors(np.where(filled, np.nan, error), result.height_sigma, touched, relative)
    return measured, _score_errors(np.where(filled, error, np.nan), None, touched) if filled.any() else None


def _mean_differences(result: Result, error: Doubles) -> tuple[Doubles | float, int]:
    """Return the mean error of each pixel's component, if that is relative, and the number of these."""
    unknown, component = result.offset_unknown, result.component
    if unknown is None or component is None or not unknown.any():
        return 0.0, 0
    compared = np.isfinite(error) & (component >= 0)
    count = np.bincount(component[compared], minlength=unknown.size)
    total = np.bincount(component[compared], error[compared], unknown.size)
    mean = np.where(unknown, total / np.maximum(count, 1), 0.0)
    # The last element is for pixels without a component.
    return np.append(mean, 0.0)[component], int(np.count_nonzero(count[unknown.astype(bool)]))


def _score_errors(
    error: Doubles, sigma: NDArray[np.float32] | None, touched: Mask, relative: int = 0
) -> HeightScore:
    touched = np.broadcast_to(touched, error.shape)
    answered = np.isfinite(error)
    return HeightScore(
        answered=int(np.count_nonzero(answered)),
        touched=int(np.count_nonzero(touched)),
        coverage=_share(answered, touched),
        mean=float(np.mean(error[answered])) if answered.any() else np.nan,
        chi_square=_chi_square(error, sigma, answered),
        relative=relative,
        **_spread(np.abs(error[answered])),
    )


def _score_normals(result: Result, truth: Truth, touched: Mask) -> AngleScore:
    assert result.normals is not None
    error = angle_between(result.normals.astype(np.float64), true_normals(truth))
    if result.contact is not None:  # normals of pixels that lose contact are not claimed
        error = np.where(result.contact == 0, np.nan, error)
    return _score_angles(error, result.normals_sigma, touched)


def _score_angles(error: Doubles, sigma: NDArray[np.float32] | None, touched: Mask) -> AngleScore:
    """Score angles between answers and truth, radians."""
    touched = np.broadcast_to(touched, error.shape)
    answered = np.isfinite(error) & touched
    return AngleScore(
        answered=int(np.count_nonzero(answered)),
        touched=int(np.count_nonzero(touched)),
        coverage=_share(answered, touched),
        chi_square=_chi_square(error, sigma, answered),
        **_spread(np.degrees(error[answered])),
    )


def _score_contact(result: Result, touched: Mask) -> ContactScore:
    assert result.contact is not None
    contact = result.contact.astype(bool)
    touched = np.broadcast_to(touched, contact.shape)
    answer = result.zenith if result.normals is None else result.normals[..., 2]
    answered = np.isfinite(answer) if answer is not None else np.ones_like(contact)
    lost = answered & ~touched
    return ContactScore(
        recall=_share(contact, touched),
        precision=_share(touched, contact),
        lost=int(np.count_nonzero(lost)),
        lost_flagged=_share(~contact, lost),
        wrongly_flagged=_share(~contact, answered & touched),
    )


def _score_edges(edges: NDArray[np.uint8], truth: Mask) -> EdgeScore:
    detected = edges.astype(bool)
    true = np.broadcast_to(truth, detected.shape)
    return EdgeScore(
        true=int(np.count_nonzero(true)),
        found=int(np.count_nonzero(detected)),
        recall=_share(_around(detected), true),
        precision=_share(_around(true), detected),
    )


def _turned(azimuth: NDArray[np.float32], truth: NDArray[np.float32]) -> Doubles:
    """Return the smaller angles between directions, radians."""
    error = azimuth.astype(np.float64) - truth
    return np.abs(np.arctan2(np.sin(error), np.cos(error)))


def _edges_of(truth: Truth) -> Mask:
    """Return the pixels on both sides of edges."""
    normals, touched = true_normals(truth), truth.contact.astype(bool)
    edges = np.zeros_like(touched)
    for a, b in (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]):
        jump = touched[a] & touched[b] & (angle_between(normals[a], normals[b]) > _JUMP)
        border = jump | (touched[a] != touched[b])
        edges[a] |= border
        edges[b] |= border
    return edges


def _around(marked: Mask) -> Mask:
    """Return a mask that includes the eight neighbours of its pixels."""
    border = [(0, 0)] * (marked.ndim - 2) + [(1, 1), (1, 1)]
    squares = sliding_window_view(np.pad(marked, border), (3, 3), axis=(-2, -1))
    return np.asarray(squares.any(axis=(-2, -1)))


def _share(part: Mask, whole: Mask) -> float:
    return float(np.mean(part[whole])) if whole.any() else np.nan


def _spread(size: Doubles) -> dict[str, float]:
    """Return statistics of errors from their magnitudes."""
    if not size.size:
        return dict.fromkeys(("rms", "median", "p99", "largest"), np.nan)
    return {
        "rms": float(np.sqrt(np.mean(size**2))),
        "median": float(np.median(size)),
        "p99": float(np.percentile(size, 99)),
        "largest": float(np.max(size)),
    }


def _chi_square(error: Doubles, sigma: NDArray[np.float32] | None, answered: Mask) -> float:
    if sigma is None:
        return np.nan
    usable = answered & (sigma > 0)
    return float(np.mean((error[usable] / sigma[usable].astype(np.float64)) ** 2)) if usable.any() else np.nan


def true_normals(truth: Truth) -> NDArray[np.float64]:
    """Return the true normals, (H, W, 3) float64; NaN without an object."""
    zenith = truth.zenith.astype(np.float64)
    azimuth = np.where(zenith == 0, 0.0, truth.azimuth.astype(np.float64))  # undefined if level
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def angle_between(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float64]:
    """Return the angles between vectors, (..., 3), radians."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(first * second, axis=-1)))
