"""Errors of the sample's fused surface, compared with its standard deviation.

``python evaluation/sample_fusion.py [SEEDS]`` makes 'sample press' and 'sample turn' with other seeds, and
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
from mirrorskin.evaluation.base.tables import Table
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


INPUTS = {"recordings": of_recordings, "registered results": of_registered_results, "results": of_results}


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


def measure(seeds: int = 20) -> Table:
    """Return the mean errors over seeds, and the range of chi^2."""
    warnings.simplefilter("ignore", io.MirrorskinWarning)
    rows = []
    for name, fused in INPUTS.items():
        errors = np.array(
            [error_of(fused(seed), sources_of(seed)[0].truth) for seed in range(11, 11 + seeds)]
        )
        rms, bias, chi2, beyond = errors.mean(axis=0)
        low, high = errors[:, 2].min(), errors[:, 2].max()
        cells = f"{rms:.2f}", f"{bias:+.2f}", f"{chi2:.2f} ({low:.2f}-{high:.2f})", f"{100 * beyond:.2f}"
        rows.append((name, *cells))
    head = ("`engine.fuse` of", "RMS, µm", "bias, µm", "$\\chi^2$ (of each seed)", "beyond 3 sigma, %")
    return Table(f"The sample's fused surface, {seeds} seeds", head, rows)


if __name__ == "__main__":
    print(measure(*map(int, sys.argv[1:])))
