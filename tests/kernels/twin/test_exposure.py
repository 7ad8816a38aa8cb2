"""Exposure: the generator and its noise, compared with closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy import stats

from mirrorskin.kernels.twin import exposure


def moments(signal: float, read: float, grain: float) -> list[float]:
    """Integrate the noise's first three moments over the normal number; exact for a polynomial."""
    nodes, weights = hermegauss(12)
    values = exposure.noise(np.full(nodes.shape, signal), nodes, read, grain)
    return [float(weights @ values**power / weights.sum()) for power in (1, 2, 3)]


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ([0] * 4, (0, 0), [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([0xFFFFFFFF] * 4, (0xFFFFFFFF,) * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            (0xA4093822, 0x299F31D0),
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_random_words_are_those_that_the_generators_authors_published(
    counter: list[int], key: tuple[int, int], words: list[int]
) -> None:
    drawn = exposure.philox(np.array(counter, np.uint32)[:, None], key)
    assert drawn[:, 0].tolist() == words


def test_numbers_are_normal() -> None:
    numbers = exposure.normals(2**18, 7, 11)
    assert stats.kstest(numbers, "norm").pvalue > 0.01
    for limit in (2, 3, 4):
        beyond = int((np.abs(numbers) > limit).sum())
        assert stats.binomtest(beyond, numbers.size, 2 * stats.norm.sf(limit)).pvalue > 0.01
    assert (np.abs(numbers) > 4).any()


def test_numbers_do_not_depend_on_each_other() -> None:
    shape = (512, 512)

    def field(frame: int, seed: int) -> NDArray[np.float64]:
        return exposure.normals(shape[0] * shape[1] // 4, frame, seed).reshape(shape)

    base = field(0, 0)
    pairs = {
        "beside": (base[:, 1:], base[:, :-1]),
        "two beside": (base[:, 2:], base[:, :-2]),
        "below": (base[1:], base[:-1]),
        "a quarter": (base[128:256], base[:128]),
        "two quarters": (base[256:], base[:256]),
        "three quarters": (base[384:], base[:128]),
        "frame": (field(1, 0), base),
        "frame far on": (field(2**32, 0), base),
        "seed": (field(0, 1), base),
        "seed far on": (field(0, 2**32), base),
        "frame for seed": (field(0, 1), field(1, 0)),
    }
    for name, (first, right) in pairs.items():
        for power in (1, 2):  # squares: two numbers from one radius must not be large together
            correlation = np.corrcoef(first.ravel() ** power, right.ravel() ** power)[0, 1]
            assert abs(correlation) < 4 / np.sqrt(first.size), name


@pytest.mark.parametrize("read", [0.0, 0.7, 5.0])
@pytest.mark.parametrize("grain", [0.01, 0.1, 1.0, 5.0])
@pytest.mark.parametrize("electrons", [0.001, 0.05, 0.3, 1.0, 40.0, 1e4])
def test_noise_has_the_mean_and_the_variance_of_read_and_shot_noise(
    electrons: float, grain: float, read: float
) -> None:
    mean, variance, _ = moments(electrons * grain, read, grain)
    expected = read**2 + electrons * grain**2
    assert mean == pytest.approx(0, abs=1e-9 * np.sqrt(expected))
    assert variance == pytest.approx(expected, rel=1e-9)


def test_counted_electrons_are_distributed_almost_as_poissons() -> None:
    normal = stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000)
    for electrons in (5, 20, 100):
        counted = np.arange(4 * electrons)
        expected = stats.poisson(electrons).cdf(counted)
        bent = np.rint(electrons + exposure.noise(np.full(normal.shape, float(electrons)), normal, 0.0, 1.0))
        plain = np.rint(electrons + np.sqrt(electrons) * normal)
        error, without = (
            np.abs(np.searchsorted(np.sort(drawn), counted, side="right") / len(drawn) - expected).max()
            for drawn in (bent, plain)
        )
        assert error < 0.02 / np.sqrt(electrons)
        assert error < without / 4


@pytest.mark.parametrize(("dtype", "bits"), [("uint8", 8), ("uint16", 10), ("uint16", 12), ("uint16", 16)])
def test_counts_end_where_the_bits_do(dtype: str, bits: int) -> None:
    top = 2.0**bits - 1
    offset = np.array([-1e9, -257, -1, -0.4, 0.5, 1.5, 2.5, 8, top - 1, top - 0.4, top + 1, 1e9, 2, 2, 2, 2])
    counts = np.zeros(offset.shape, dtype)
    exposure.expose(0 * offset, offset, 0 * offset, 0, 0, 0.0, 0.0, top, counts)
    assert counts.tolist() == [0, 0, 0, 0, 0, 2, 2, 8, top - 1, *[top] * 3, *[2] * 4]
