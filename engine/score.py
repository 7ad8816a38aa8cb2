"""How far a result is from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mirrorskin.io import InputError, Result, Truth


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of a height map.

    Attributes
    ----------
    answered : int
        Pixels with a height whose truth is known.
    touched : int
        Pixels where sheet and object touched.
    coverage : float
        Share of the touched pixels that were answered.
    rms, mean, median, p99, largest : float
        Of the height error (mean) and its magnitude (the others), mm; NaN without answers.
    chi_square : float
        Mean of (error / sigma)^2: 1 where the standard deviations are honest; NaN without them.
    """

    answered: int
    touched: int
    coverage: float
    rms: float
    mean: float
    median: float
    p99: float
    largest: float
    chi_square: float

    def table(self) -> dict[str, str]:
        """Return names and values to print."""
        return {
            "answered": f"{self.answered} pixels",
            "coverage": f"{100 * self.coverage:.2f} % of the {self.touched} pixels in contact",
            "RMS error": f"{self.rms:.4f} mm",
            "mean error": f"{self.mean:+.4f} mm",
            "median |error|": f"{self.median:.4f} mm",
            "99 % |error|": f"{self.p99:.4f} mm",
            "largest |error|": f"{self.largest:.4f} mm",
            "mean (error/sigma)^2": f"{self.chi_square:.3f}",
        }


def score(result: Result, truth: Truth) -> Score:
    """Compare the heights of a result with the truth.

    Parameters
    ----------
    result : Result
        With ``height``, (H, W).
    truth : Truth
        Of the same size.

    Returns
    -------
    Score

    Raises
    ------
    InputError
        There are no heights, or the sizes differ.
    """
    if result.height is None:
        raise InputError("the result has no heights to score")
    if result.height.shape != truth.height.shape:
        raise InputError(
            f"the result is {result.height.shape} pixels, the truth {truth.height.shape}: not of one stack"
        )
    error = result.height.astype(np.float64) - truth.height
    touched = truth.contact.astype(bool)
    answered = np.isfinite(error)
    errors = error[answered]
    size = np.abs(errors) if errors.size else np.array([np.nan])
    chi_square = np.nan
    if result.height_sigma is not None and errors.size:
        sigma = result.height_sigma[answered].astype(np.float64)
        usable = sigma > 0
        chi_square = float(np.mean((errors[usable] / sigma[usable]) ** 2)) if usable.any() else np.nan
    return Score(
        answered=int(errors.size),
        touched=int(np.count_nonzero(touched)),
        coverage=float(np.mean(answered[touched])) if touched.any() else np.nan,
        rms=float(np.sqrt(np.mean(size**2))),
        mean=float(np.mean(errors)) if errors.size else np.nan,
        median=float(np.median(size)),
        p99=float(np.percentile(size, 99)),
        largest=float(np.max(size)),
        chi_square=chi_square,
    )
