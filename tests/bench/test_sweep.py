"""Sweeps: each kernel file is swept, checked against its reference first, and beside its own limit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mirrorskin.bench.harness import Measured, Timing
from mirrorskin.bench.results import Row
from mirrorskin.bench.same import DisagreementError
from mirrorskin.bench.sweep import CASES, FAMILIES, sweep
from mirrorskin.bench.sweep.scene import make_mask
from mirrorskin.bench.sweep.sweep import Family, Job, Sweep, agree, count_frames, run_sweep
from mirrorskin.kernels import device as device_layer
from mirrorskin.kernels.device import open_device

KERNELS = {path.stem for path in Path(device_layer.__file__).parent.glob("*.cl")} - {"limits"}
PIXELS = 37 * 61


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_every_work_does_what_its_reference_says(device, family):
    types = family.types if device.layout.tile > 1 else family.types[-1:]
    for kind in types:
        for job in family.make(device, (11, 37), kind, 16).values():
            job.check()


@pytest.mark.parametrize("name", ["sweep-onset", "sweep-rectangle"])
def test_a_case_has_a_limit_above_each_group(name):
    case = CASES[name](open_device(), True)
    family = next(one for one in FAMILIES if one.name == name)
    limits = [row for row in case.rows if row.name.startswith(f"{family.limit} limit, ")]
    assert len(limits) == len(family.types)
    assert case.rows[-1].name == "multiply-add limit"
    assert all(case.share(row) == case.kernel_share(row) == 1 for row in limits)
    ours = [row for row in case.rows if "limit" not in row.name and "kernel" in row.measured.device]
    assert len(ours) == len(family.types)
    for row in ours:
        assert row.bytes >= 8 * PIXELS
        assert row.operations > 0
        assert row.name.partition(", ")[2].startswith("37 x 61")
    assert family.counted in case.notes[0]


def test_each_kernel_file_has_a_case():
    swept = {family.title.partition(".cl")[0] for family in FAMILIES}
    assert swept == KERNELS
    assert list(CASES) == [family.name for family in FAMILIES]


def test_sizes_go_from_vga_to_20_megapixels_with_turns_of_like_size():
    pixels = [rows * columns for rows, columns in sweep.SIZES.values()]
    assert (min(pixels), max(pixels)) == (640 * 480, 5472 * 3648)
    for shape in sweep.SIZES.values():
        for kind in ("uint8", "uint16", "float32"):
            count = count_frames(shape, kind)
            assert count % 8 == 0
            assert count == 8 or count * shape[0] * shape[1] * np.dtype(kind).itemsize <= 96e6


def test_a_large_mask_is_as_full_as_a_small_one():
    for shape in ((480, 640), (1080, 1921)):
        mask = make_mask(shape)
        assert (mask.shape, mask.dtype) == (shape, np.uint8)
        assert mask.mean() == pytest.approx(0.65, abs=0.02)


def test_a_kernel_that_differs_is_named_and_nothing_is_timed(monkeypatch):
    timed = []

    def check():
        agree("expose, counts", np.array([[1.0, 2.0]]), np.array([[1.0, 2.5]]), 0.1)

    monkeypatch.setattr(sweep, "take_turns", lambda *given: timed.append(given))
    job = Job(lambda: None, 8, check)
    family = Family("odd", "odd", lambda *given: {"odd": job}, ("float32",), "read", 1, "")
    with pytest.raises(DisagreementError, match=r"expose, counts: 1 of 2 .* at \(0, 1\): 2.0, not 2.5"):
        run_sweep(family, open_device(), True)
    assert not timed


@pytest.mark.parametrize(("found", "spared"), [([1.0, np.nan, 3.05], 0), ([1.0, np.nan, 9.0], 1)])
def test_maps_agree_within_the_tolerance_and_but_for_what_is_spared(found, spared):
    agree("any", np.array(found), np.array([1.0, np.nan, 3.0]), 0.1, spared)
    with pytest.raises(DisagreementError):
        agree("any", np.array([1.0, 2.0, np.nan]), np.array([1.0, np.nan, 3.0]), 0.1, spared)


def row_of(name, seconds, size):
    timing = Timing(seconds, seconds, seconds, 1)
    return Row(name, Measured(timing, {"kernel": timing}, {}, 0.0, 0.0), size)


def test_a_share_is_that_of_the_limit_above():
    groups = [row_of("read limit, A", 1.0, 100), row_of("x, A", 1.0, 50)]
    groups += [row_of("read limit, B", 1.0, 1000), row_of("x, B", 2.0, 500)]
    case = Sweep("case", "title", [*groups, replace(groups[0], name="multiply-add limit", bytes=0)], {})
    assert [case.share(row) for row in groups] == [1, 0.5, 1, 0.25]
    assert [case.kernel_share(row) for row in groups] == [1, 0.5, 1, 0.25]
