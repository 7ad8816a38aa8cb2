"""Exposure: the generator and its noise against closed forms, and the kernel against its reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from launches import launch
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy import stats

from mirrorskin.kernels import exposure
from mirrorskin.kernels.device import Device

C_TYPES = {"uint8": "uchar", "uint16": "ushort", "float32": "float"}
QUARTERS = [1, 7, 1025]
LAST = 2**64 - 1


def expose(device: Device, maps: list[NDArray[np.float32]], dtype: str, **how: float) -> NDArray[Any]:
    """Run the kernel; maps are light, offset and span."""
    given = {"frame": 0, "seed": 0, "read": 0.0, "grain": 0.0, "top": 255.0} | how
    arrays = [device.array(name, part.shape, np.float32) for name, part in zip("los", maps, strict=True)]
    counts = device.array("counts", maps[0].shape, dtype)
    for array, part in zip(arrays, maps, strict=True):
        array.host[:] = part
        array.upload()
    counts.upload()
    quarter = len(maps[0]) // 4
    modes = {"WHOLE": int(dtype != "float32"), "SHOT": int(given["grain"] > 0)}
    kernel = device.kernel("exposure", "expose", FRAME=C_TYPES[dtype], **modes)
    launch(kernel, -(-quarter // device.layout.tile), *arrays, quarter, *given.values(), counts)
    return counts.download().copy()


def device_normals(device: Device, quarter: int, **keys: int) -> NDArray[np.float32]:
    """Read the normal numbers themselves: noise of one count, without any light."""
    nothing = np.zeros(4 * quarter, np.float32)
    return expose(device, [nothing, nothing, nothing], "float32", read=1.0, **keys)


def random_maps(quarter: int, scale: float) -> list[NDArray[np.float32]]:
    """Light from none to full, and pixels that all differ."""
    rng = np.random.default_rng(quarter)
    light = rng.uniform(0, 1, 4 * quarter).round(1)
    levels = rng.uniform(0, 20, 4 * quarter) * scale, rng.uniform(0, 230, 4 * quarter) * scale
    return [part.astype(np.float32) for part in (light, *levels)]


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
    found = exposure.philox(np.array(counter, np.uint32)[:, None], key)
    assert found[:, 0].tolist() == words


def test_numbers_are_normal() -> None:
    found = exposure.normals(2**18, 7, 11)
    assert stats.kstest(found, "norm").pvalue > 0.01
    for limit in (2, 3, 4):
        beyond = int((np.abs(found) > limit).sum())
        assert stats.binomtest(beyond, found.size, 2 * stats.norm.sf(limit)).pvalue > 0.01
    assert (np.abs(found) > 4).any()


def test_numbers_do_not_depend_on_each_other() -> None:
    shape = (512, 512)

    def field(frame: int, seed: int) -> NDArray[np.float64]:
        return exposure.normals(shape[0] * shape[1] // 4, frame, seed).reshape(shape)

    one = field(0, 0)
    pairs = {
        "beside": (one[:, 1:], one[:, :-1]),
        "two beside": (one[:, 2:], one[:, :-2]),
        "below": (one[1:], one[:-1]),
        "a quarter": (one[128:256], one[:128]),
        "two quarters": (one[256:], one[:256]),
        "three quarters": (one[384:], one[:128]),
        "frame": (field(1, 0), one),
        "frame far on": (field(2**32, 0), one),
        "seed": (field(0, 1), one),
        "seed far on": (field(0, 2**32), one),
        "frame for seed": (field(0, 1), field(1, 0)),
    }
    for name, (left, right) in pairs.items():
        for power in (1, 2):  # squares: two numbers from one radius must not be large together
            correlation = np.corrcoef(left.ravel() ** power, right.ravel() ** power)[0, 1]
            assert abs(correlation) < 4 / np.sqrt(left.size), name


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


@pytest.mark.parametrize(("frame", "seed"), [(0, 0), (2**32 + 5, 2**40 + 3), (LAST, LAST)])
@pytest.mark.parametrize("quarter", QUARTERS)
def test_the_devices_numbers_are_the_references(device: Device, quarter: int, frame: int, seed: int) -> None:
    found = device_normals(device, quarter, frame=frame, seed=seed)
    np.testing.assert_allclose(found, exposure.normals(quarter, frame, seed), rtol=0, atol=3e-6)


@pytest.mark.parametrize(
    ("dtype", "bits", "read", "grain", "quarter"),
    [
        ("uint8", 8, 1.5, 0.0, 7),
        ("uint8", 8, 0.0, 1.0, 4099),
        ("uint16", 10, 1.5, 0.02, 1),
        ("uint16", 16, 1.5, 0.02, 4099),
        ("float32", 8, 1.5, 1.0, 4099),
    ],
)
def test_the_devices_counts_are_the_references_but_for_ties(
    device: Device, quarter: int, dtype: str, bits: int, read: float, grain: float
) -> None:
    scale, top = 2.0 ** (bits - 8), 2.0**bits - 1
    maps = random_maps(quarter, scale)
    how = {"frame": 5, "seed": 9, "read": read * scale, "grain": grain * scale, "top": top}
    expected = np.empty(4 * quarter, dtype)
    exposure.expose(*maps, **how, counts=expected)
    found = expose(device, maps, dtype, **how)

    difference = np.abs(found.astype(np.float64) - expected)
    if dtype == "float32":
        assert difference.max() < 2e-6 * top
    else:
        # A float32 errs by some 1e-7 of its value; counts that fall so near to a half may go either way.
        assert difference.max() <= 1
        assert difference.sum() <= 3 + 5e-8 * top * len(found)
        assert np.unique(found).size > 1


@pytest.mark.parametrize(("dtype", "bits"), [("uint8", 8), ("uint16", 10), ("uint16", 12), ("uint16", 16)])
def test_counts_end_where_the_bits_do(device: Device, dtype: str, bits: int) -> None:
    top = 2.0**bits - 1
    offset = np.array(
        [-1e9, -70000, -257, -1, -0.4, 0.5, 1.5, 2.5, 8, top - 1, top - 0.4, top, top + 1], np.float32
    )
    offset = np.append(offset, [top + 257, top + 70000, 1e9]).astype(np.float32)
    light = np.zeros(len(offset), np.float32)
    found = expose(device, [light, offset, light], dtype, top=top)
    assert found.tolist() == [0, 0, 0, 0, 0, 0, 2, 2, 8, top - 1, *[top] * 6]
