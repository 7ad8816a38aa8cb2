"""Is the standard deviation of the sample's fused surface true?

``python tests/support/sample_fusion.py [SEEDS]`` makes 'sample press' and 'sample turn' with other seeds.
"""

from __future__ import annotations

import sys

import numpy as np

from mirrorskin.cli import sample
from mirrorskin.engine.fusion import fuse_recordings


def error_of(seed: int) -> tuple[float, float, float, float]:
    """Return RMS error and bias, µm, chi^2, and the share of errors beyond three standard deviations."""
    sample._SEED = seed
    press, turn = sample._pressed(), sample._twin(10.0, sample._turn(1.5), pattern="linear")
    fused = fuse_recordings(press, turn)
    error = np.where(fused.filled > 0, np.nan, fused.height - press.truth.height)
    ratio = error / fused.height_sigma
    ratio = ratio[np.isfinite(ratio)]
    return (
        1e3 * float(np.sqrt(np.nanmean(error**2))),
        1e3 * float(np.nanmean(error)),
        float(np.mean(ratio**2)),
        float(np.mean(np.abs(ratio) > 3)),
    )


def main() -> None:
    """Print the errors for each seed, and their mean."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    rows = np.array([error_of(11 + number) for number in range(count)])
    for rms, bias, chi2, beyond in (*rows, rows.mean(axis=0)):
        print(f"RMS {rms:.2f} µm  bias {bias:+.2f} µm  chi2 {chi2:.2f}  beyond {100 * beyond:.2f} %")


if __name__ == "__main__":
    main()
