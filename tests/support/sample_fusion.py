"""Is the standard deviation of the sample's fused surface true?

``python tests/support/sample_fusion.py [SEEDS]`` makes 'sample press' and 'sample turn' with other seeds, and
fuses the recordings, and their results.
"""

from __future__ import annotations

import sys
import warnings
from functools import cache

import numpy as np

from mirrorskin import engine, io
from mirrorskin.cli.commands import sample
from mirrorskin.cli.commands.simulate import make_twin, preset
from mirrorskin.twin import Twin


@cache
def sources_of(seed: int) -> tuple[Twin, Twin]:
    """Return the press and the turn of the sample, with another seed."""
    press, turn = (make_twin(*preset(f"{line} --seed {seed}")) for line in (sample.PRESS, sample.TURN))
    return press, turn


def of_recordings(seed: int) -> io.Result:
    """Return the surface of both recordings."""
    return engine.fuse(*sources_of(seed))


def of_results(seed: int) -> io.Result:
    """Return the surface of the results of both recordings, each on its own."""
    return engine.fuse(*(engine.reconstruct(source) for source in sources_of(seed)))


def of_registered_results(seed: int) -> io.Result:
    """Return the surface of both results, where the turn is registered with the heights of the press."""
    press, turn = sources_of(seed)
    pressed = engine.reconstruct(press)
    return engine.fuse(pressed, engine.reconstruct(turn, heights=pressed))


INPUTS = {"recordings": of_recordings, "results": of_results, "registered results": of_registered_results}


def error_of(surface: io.Result, truth: io.Truth) -> tuple[float, float, float, float]:
    """Return RMS error and bias, µm, chi^2, and the share of errors beyond three standard deviations."""
    error = surface.measured() - truth.height
    ratio = error / surface.height_sigma
    ratio = ratio[np.isfinite(ratio)]
    return (
        1e3 * float(np.sqrt(np.nanmean(error**2))),
        1e3 * float(np.nanmean(error)),
        float(np.mean(ratio**2)),
        float(np.mean(np.abs(ratio) > 3)),
    )


def main() -> None:
    """Print the errors for each seed, and their mean."""
    warnings.simplefilter("ignore", io.MirrorskinWarning)
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    for name, fused in INPUTS.items():
        rows = np.array([error_of(fused(seed), sources_of(seed)[0].truth) for seed in range(11, 11 + count)])
        print(f"{name}, {count} seeds and their mean:")
        for rms, bias, chi2, beyond in (*rows, rows.mean(axis=0)):
            print(f"RMS {rms:.2f} µm  bias {bias:+.2f} µm  chi2 {chi2:.2f}  beyond {100 * beyond:.2f} %")


if __name__ == "__main__":
    main()
