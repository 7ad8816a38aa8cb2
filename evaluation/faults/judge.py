"""How true a standard deviation is: errors over standard deviations, and what a result says about them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mirrorskin.evaluation.faults.camera import Floats
from mirrorskin.io import MirrorskinWarning, Result
from mirrorskin.io.base.findings import warnings_in

LIMITS = 2.0, 0.02  # of an honest cell: chi^2, and the share of errors beyond three standard deviations
CAUTIOUS = 0.3  # chi^2 of a standard deviation that is too large without a reason
REASON = "not identifiable"  # in the note that states it


@dataclass(frozen=True)
class Answer:
    """Errors of an estimator and their standard deviations; NaN where there is no answer.

    ``warnings`` and ``notes`` are the texts of the findings.
    """

    error: Floats
    sigma: Floats
    warnings: str = ""
    notes: str = ""


@dataclass(frozen=True)
class Cell:
    """How an estimator fared with a fault.

    Attributes
    ----------
    error : float
        RMS error over that without a fault, or the RMS error.
    chi2 : float
        Mean of the square errors over the variances; 1 is right.
    beyond : float
        Share of the errors beyond three standard deviations.
    kept : float
        Share of the pixels that have an answer.
    warned : bool
        Whether the result has a warning.
    """

    error: float
    chi2: float
    beyond: float
    kept: float
    warned: bool

    def __str__(self) -> str:
        notes = ("  warned" if self.warned else "") + ("" if self.honest else "  <--")
        return (
            f"error {self.error:6.2f}  chi2 {self.chi2:8.2f}  beyond {100 * self.beyond:6.2f} %"
            f"  kept {100 * self.kept:5.1f} %{notes}"
        )

    @property
    def honest(self) -> bool:
        """Whether the standard deviation is true, or something is said about it."""
        return self.warned or self.kept == 0 or (self.chi2 <= LIMITS[0] and self.beyond <= LIMITS[1])

    @property
    def clearly_honest(self) -> bool:
        """Whether a cell is so far from the limits that rounding on another device does not change it."""
        return self.honest and (
            self.warned or (self.chi2 <= 0.8 * LIMITS[0] and self.beyond <= LIMITS[1] / 2)
        )

    @property
    def clearly_wrong(self) -> bool:
        """Whether a cell is so far beyond the limits that rounding on another device does not change it."""
        return not self.honest and (self.chi2 > 1.25 * LIMITS[0] or self.beyond > 1.5 * LIMITS[1])


def judge(answer: Answer, usual: float = 1.0) -> Cell:
    """Return the cell of an answer; ``usual`` is the RMS error without a fault."""
    error, sigma = inside(answer.error), inside(answer.sigma)
    usable = np.isfinite(error) & np.isfinite(sigma)
    warned = bool(answer.warnings)
    if not usable.any():
        return Cell(math.nan, math.nan, 0.0, 0.0, warned)
    ratio = np.abs(error[usable]) / sigma[usable]
    return Cell(
        error=rms(error[usable]) / usual,
        chi2=float(np.mean(ratio**2)),
        beyond=float(np.mean(ratio > 3)),
        kept=float(np.mean(usable)),
        warned=warned,
    )


def rms(values: Floats) -> float:
    """Return the root mean square of the numbers among values."""
    return float(np.sqrt(np.nanmean(np.square(values))))


def inside(values: Floats) -> Floats:
    """Return what is not near the border of a picture, which has no light from outside of it."""
    values = np.asarray(values, np.float64)
    return values[3:-3, 3:-3] if values.ndim == 2 else values


Watched = tuple[Result, str, str]


def watched(compute: Callable[[], Result]) -> Watched:
    """Return a result, the texts of its warnings, and those of its notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MirrorskinWarning)
        result = compute()
    issued = [str(warning.message) for warning in caught if issubclass(warning.category, MirrorskinWarning)]
    told = "; ".join(warnings_in(result.process) or issued)
    notes = "; ".join(str(text) for name, text in result.process.items() if f"_{name}".endswith("_notes"))
    return result, told, notes
