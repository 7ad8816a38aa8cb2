"""Noisy ramps with a known half-way crossing, and the errors of its estimates.

``python tests/support/ramps.py`` prints, for each noise, the error of the best fixed threshold and of the
change-point.
"""

from __future__ import annotations

import numpy as np

FRAMES = 64
WIDTHS = (0, 0.5, 1, 1.5, 2, 2.5, 3, 4, 5.5, 8, 11, 16)  # frames from dark to light
NOISES = (1, 2, 3, 5, 8, 12, 16, 20)
THRESHOLDS = np.arange(4, 17) / 20
HOLDS = (1, 2, 3)  # longer ones were never the best, not even for one width of a ramp


def ramps(noise, pixels, seed, dark=20, bright=220, widths=WIDTHS):
    """Return uint8 frames, (T, widths, pixels), and the frame at which each is half-way, (widths, pixels)."""
    generator = np.random.default_rng([seed, int(10 * noise)])
    middle = generator.uniform(FRAMES / 2 - 12, FRAMES / 2 + 12, (len(widths), pixels))
    lasts = np.maximum(widths, 1e-9)[:, np.newaxis]
    number = np.arange(FRAMES)[:, np.newaxis, np.newaxis]
    share = np.clip((number - middle) / lasts + 0.5, 0, 1)
    counts = dark + (bright - dark) * share + generator.normal(0, noise, (FRAMES, *middle.shape))
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8), middle


def errors(height, status, middle):
    """Return the errors in frames, for travel of 1 a frame; no answer is off by half the stack."""
    return np.where(status == 1, -np.nan_to_num(height) - middle, FRAMES / 2)


def rms(values, axis=None):
    return np.sqrt(np.mean(values**2, axis=axis))


def compare(noise, pixels=1000, seed=1, dark=20, bright=220, device=None):
    """Return the errors, (widths, pixels), of the best threshold, its bias removed, and of the change-point.

    The best threshold is the one whose error over all pixels is the least, of all thresholds and holds; the
    best for each width alone, which nobody could choose beforehand, comes third, as RMS errors, (widths,).
    """
    from bare import find_change_point, find_onset

    frames, middle = ramps(noise, pixels, seed, dark, bright)
    known = {"dark": dark, "bright": bright, "noise": float(np.hypot(noise, 1 / np.sqrt(12)))}
    travel = np.arange(float(FRAMES))
    thresholds = []
    for threshold in THRESHOLDS:
        for hold in HOLDS:
            found = find_onset(frames, travel, threshold=float(threshold), hold=hold, device=device, **known)
            thresholds.append(errors(found.height, found.status, middle))
    best = min((error - error.mean() for error in thresholds), key=rms)
    each = np.min([rms(error - error.mean(axis=1, keepdims=True), axis=1) for error in thresholds], axis=0)
    found = find_change_point(frames, travel, device=device, **known)
    return best, errors(found.height, found.status, middle), each


def main():
    print("errors in frames: RMS (median of the magnitude); ramps of", *WIDTHS, "frames")
    print(
        "noise  best threshold   change-point     RMS as a share of the best threshold's for each width alone"
    )
    for noise in NOISES:
        best, change, each = compare(noise, pixels=4000)
        cells = [f"{rms(error):.4f} ({np.median(np.abs(error)):.4f})" for error in (best, change)]
        shares = " ".join(f"{mine:.2f}" for mine in rms(change, axis=1) / each)
        print(f"{noise:5}  {cells[0]}  {cells[1]}  {shares}")


if __name__ == "__main__":
    main()
