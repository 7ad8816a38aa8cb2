"""The contrast around each pixel, and its peak over the frames: ``focus.cl`` in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[Any]


def focus_scan(frames: Array, first: int, radius: int, reach: int, above: int, every: int, best: Array,
               peak: Array, recent: Array, detail: Array, last: Array) -> None:  # fmt: skip
    """Process a block of frames; the maps are the state, updated in place.

    Parameters
    ----------
    frames : (n, H, W), uint8, uint16 or float32
    first : number of the block's first frame in the stack
    radius : half-width of the window, pixels; windows are truncated at the border
    reach : number of frames kept on each side of the peak
    above : rows of the picture above the first one of the frames
    every : rows of the picture from one to the next whose own samples are kept, the first being row 0
    best : (H, W), frame with the largest contrast: the sum of squared deviations of the samples of a window
        from their mean
    peak : (2 reach + 1, H, W), contrast in the frames around the best; NaN for a missing frame
    recent : (reach, H, W), contrast in the last frames: frame t in plane t % reach
    detail : (2 reach + 1, H, W), sample of the pixel minus the mean of its window in the frames around the
        best, once all have been there
    last : (2 reach + 1, H, W), the same in the last frames: frame t in plane t % (2 reach + 1)
    """
    kept = (above + np.arange(frames.shape[1])) % every == 0
    for t, frame in enumerate(frames.astype(np.float64), first):
        size, border = (2 * radius + 1, 2 * radius + 1), radius
        inside = sliding_window_view(np.pad(np.ones(frame.shape), border), size)
        samples = sliding_window_view(np.pad(frame, border), size)
        mean = samples.sum((2, 3)) / inside.sum((2, 3))
        sharp = np.sum(inside * (samples - mean[..., None, None]) ** 2, (2, 3))

        better = (sharp > peak[reach]) | np.isnan(peak[reach]) | (t == 0)
        since = t - best
        for k in range(1, reach + 1):
            peak[reach + k][since == k] = sharp[since == k]
            peak[reach - k][better] = recent[(t - k) % reach][better] if k <= t else np.nan
            peak[reach + k][better] = np.nan
        peak[reach][better] = sharp[better]
        best[better] = t
        recent[t % reach] = sharp
        last[t % len(last), kept] = (frame - mean)[kept]
        order = (t + 1 + np.arange(len(last))) % len(last)
        whole = (best == t - reach) & kept[:, np.newaxis]
        detail[:, whole] = last[order][:, whole]


def focus_fit(radius: int, reach: int, above: int, every: int, variance: float, least_contrast: float,
              least_curvature: float, places: Array, travel: Array, unit: float, best: Array, peak: Array,
              detail: Array, height: Array, spread: Array, gain: Array, misfit: Array, sharpness: Array,
              shifted: Array, shifted_noise: Array, texture: Array, texture_noise: Array, left: Array,
              status: Array) -> None:  # fmt: skip
    """Fit a parabola to the logarithms of the contrast around the peak, by orthogonal polynomials.

    See Forsythe, J. SIAM 5, 1957.

    Parameters
    ----------
    radius, reach, above, every, best, peak, detail : as of `focus_scan`
    variance : variance of a sample, counts^2
    least_contrast : minimum contrast of a peak in excess of that of noise, standard errors
    least_curvature : minimum curvature of a peak, standard errors
    places : (T, 2 reach + 1), travel of the frames around each frame, relative to it, in ``unit``
    travel : (T,), mm
    unit : unit of ``places``, mm
    height : (H, W), mm; ``height`` and ``spread`` are NaN where there is no peak
    spread : (H, W), variance of the height, mm^2, for noise of variance 1
    gain : (H, W), variance of the height, mm^2, if all logarithms had the variance 1
    misfit : (H, W), estimated variance of the logarithms in excess of noise; NaN for less than four points.
        The residual sum of squares has a chi-square distribution with n degrees of freedom, whose median is
        (1 - 2 / 9n)^3 n (Wilson and Hilferty 1931)
    sharpness : (H, W), standard deviation of the window's samples in the sharpest frame, without the noise
    texture, shifted : (H, W), squares of the coefficients of the pixel's own samples, see `_own_curve`: what
        it varies by, and this times the height by which its own peak differs, mm
    shifted_noise, texture_noise : (H, W), variances of these coefficients because of noise
    left : (H, W), variance of noise by the residuals; these five are 0 where a sample or the peak is missing
    status : (H, W), codes of FocusStatus
    """
    sizes = [
        np.minimum(place + radius, length - 1.0) - np.maximum(place - radius, 0) + 1
        for length, place in ((length, np.arange(length)) for length in best.shape)
    ]
    freedom = np.multiply.outer(*sizes) - 1
    signal, place = peak - freedom * variance, np.moveaxis(places[best], -1, 0).astype(np.float64)
    top = signal[reach]
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(signal > 0, signal**2 / (2 * freedom * variance + 4 * signal), 0)
        value = np.log(np.where(signal > 0, signal / top, 1))
        total = weight.sum(axis=0)
        mean = (weight * place).sum(axis=0) / total
        first = place - mean
        norm = (weight * first**2).sum(axis=0)
        skew = (weight * first**3).sum(axis=0) / norm
        second = first**2 - skew * first - norm / total
        bent = (weight * second**2).sum(axis=0)
        level, along = (weight * value).sum(axis=0) / total, (weight * value * first).sum(axis=0) / norm
        across = (weight * value * second).sum(axis=0) / bent
        scale, points = unit / (2 * across), (weight > 0).sum(axis=0)
        vertex = mean + skew / 2 - along / (2 * across)
        has_peak = (points > 2) & (top > least_contrast * variance * np.sqrt(2 * freedom))
        has_peak &= np.where(across < 0, across**2 * bent, 0) > least_curvature**2 * variance
        residual = (weight * (value - level - along * first - across * second) ** 2).sum(axis=0)
        free = total - (weight**2 * (1 / total + first**2 / norm + second**2 / bent)).sum(axis=0)
        degrees = points - 3.0
        excess = (residual / (1 - 2 / (9 * degrees)) ** 3 - degrees * variance) / free
        misfit[:] = np.where(has_peak & (points > 3) & (free > 0), excess, np.nan)
        neighbours = place[reach - 1 : reach + 2]
        has_peak &= (neighbours.min(axis=0) < vertex) & (vertex < neighbours.max(axis=0))
        status[:] = np.where(has_peak, 1, 2)
        status[(best == 0) | (best == len(travel) - 1)] = 3
        status[~np.isfinite(top)] = 0
        has_peak = status == 1
        height[:] = np.where(has_peak, -(travel[best] + unit * vertex), np.nan)
        spread[:] = np.where(has_peak, (1 / norm + (along / across) ** 2 / bent) * scale**2, np.nan)
        moves = (weight**2 * (first / norm - along / across * second / bent) ** 2).sum(axis=0)
        gain[:] = moves * scale**2
        sharpness[:] = np.sqrt(np.where(top < 0, 0, top) / np.maximum(freedom, 1))
        whole = has_peak & (best >= reach) & (best < len(travel) - reach)
        whole &= ((above + np.arange(len(best))) % every == 0)[:, np.newaxis]
        own = _own_curve(detail - detail[reach], place - vertex, across)
        for values, target in zip(own, (shifted, shifted_noise, texture, texture_noise, left), strict=True):
            scale = unit**2 if target is shifted or target is shifted_noise else 1.0
            target[:] = np.where(whole & np.isfinite(own[0] + own[2]), scale * values, 0)


def _own_curve(detail: Array, place: Array, across: Array) -> tuple[Array, ...]:
    """Return what a pixel's own samples show of its peak, by the curve of its window.

    By a least-squares fit, they are constant + b e + m (-2 q t e), where q t^2 is the logarithm of the
    amplitude e(t) of the window, half of that of its contrast. A peak that is d away from the window's has
    m = b d.

    Parameters
    ----------
    detail : (2 reach + 1, H, W)
    place : (2 reach + 1, H, W), t
    across : (H, W), 2 q

    Returns
    -------
    m^2, the variance of m because of noise, b^2, that of b, and the variance of noise by the residuals
    """
    shape = np.exp(np.clip(across * place**2 / 2, -4, 0))
    columns = np.stack([shape, -across * place * shape])
    columns = columns - columns.mean(axis=1, keepdims=True)
    samples = detail - detail.mean(axis=0)
    (a, b), (_, c) = np.einsum("ikyx,jkyx->ijyx", columns, columns)
    along, moving = np.einsum("ikyx,kyx->iyx", columns, samples)
    determinant = a * c - b * b
    texture, shifted = (c * along - b * moving) / determinant, (a * moving - b * along) / determinant
    residual = np.sum((samples - texture * columns[0] - shifted * columns[1]) ** 2, axis=0)
    noise = residual / (len(detail) - 3) if len(detail) > 3 else 0 * residual
    return shifted**2, noise * a / determinant, texture**2, noise * c / determinant, noise
