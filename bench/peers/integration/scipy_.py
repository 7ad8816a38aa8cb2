"""SciPy: cosine transforms on all cores, in place behind the first."""

from __future__ import annotations

from scipy.fft import dctn, idctn

from mirrorskin.bench.peers import THREADS
from mirrorskin.bench.peers.integration.rectangle import Floats, Peer


def solve(source: Floats, divisors: Floats) -> Floats:
    """See `Peer`."""
    spectrum = dctn(source, workers=THREADS)
    spectrum *= divisors
    heights: Floats = idctn(spectrum, overwrite_x=True, workers=THREADS)
    return heights


PEER = Peer("SciPy", solve)
