"""Each case runs at a tiny size, its works agree, and it returns what reports are made of."""

import json
import subprocess
import sys

import numpy as np
import pytest

from mirrorskin.bench import integration, suite
from mirrorskin.bench.harness import (
    FIRST,
    OURS,
    Case,
    DisagreementError,
    InaccurateError,
    Measured,
    Row,
    Target,
    Timing,
    agree,
    call_targets,
)
from mirrorskin.bench.run import as_data
from mirrorskin.bench.scenes import blob_mask, noisy_slopes, random_cuts
from mirrorskin.io import InputError
from mirrorskin.kernels.device import open_device

QUICK = (
    "equation4-uint8",
    "full-uint8",
    "correlate-uint8",
    "sliding",
    "normals-uint8",
    "call-edges",
    "integrate-mask",
    "integrate-live",
    "integrate-many",
    "integrate-robust",
    "twin",
    "sweep-onset",
    "sweep-changepoint-unknown",
    "file-press",
    "file-turns",
    "file-lab",
    "file-zarr",
    "file-s3",
    "batch-small",
    "live-vertical-vga",
    "scaling-frames",
    "accuracy-surfaces",
)


def check_case(name):
    device = open_device()
    (case,) = suite.run_suite(device, [name], quick=True)
    assert case.name == name
    (data,) = as_data(device, [case], quick=True)["cases"]
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    works = [row for row in case.rows if "limit" not in row.name]
    assert all(row.measured.wall.median > 0 for row in works)
    assert name.startswith("accuracy-") == bool(case.targets)


@pytest.mark.parametrize("name", QUICK)
def test_a_case_runs_at_a_tiny_size(name):
    check_case(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in suite.NAMES if name not in QUICK])
def test_every_other_case_runs_at_a_tiny_size(name):
    check_case(name)


def test_a_call_has_its_kernels_and_the_first_call_beside_it():
    (case,) = suite.run_suite(open_device(), ["call-edges"], quick=True)
    again, first = [row for row in case.rows if "limit" not in row.name]
    assert set(again.measured.kernels) == set(again.measured.moved) != set()
    assert (again.name, first.name) == (OURS, FIRST)


def test_a_call_aims_at_its_kernels_and_at_its_peers():
    def row(name, ms, kernel=None):
        timing = Timing(1e-3 * ms, 1e-3 * ms, 1e-3 * ms, 3)
        device = {} if kernel is None else {"kernel": Timing(1e-3 * kernel, 0.0, 0.0, 3)}
        return Row(name, Measured(timing, device, {}, {}, 1.0, 0.0), 100)

    ours = row(OURS, 16.1, 10), row(FIRST, 18.9, 10), row(f"{OURS}, solve", 5, 5)
    peers = row("NumPy", 150), row("Numba", 16.2), row("OpenCV, solve", 4)
    found = [(one.what, one.met) for one in call_targets([row("read limit", 1), *ours, *peers])]
    assert found == [(OURS, False), (FIRST, True), (OURS, False), (OURS, True), (f"{OURS}, solve", False)]


def test_importing_the_package_imports_no_case_peer_or_report():
    loaded = (
        "import sys, mirrorskin.bench; print([m for m in sys.modules if m.startswith('mirrorskin.bench.')])"
    )
    found = subprocess.run([sys.executable, "-c", loaded], check=True, capture_output=True, text=True)
    assert found.stdout.strip() == "[]"


def test_patterns_choose_cases_in_their_order():
    assert suite.choose(["full-*", "equation4-uint8"])[:2] == ("equation4-uint8", "full-uint8")
    with pytest.raises(InputError, match=r"case 'onset': no such case; the nearest are .*; --list names all"):
        suite.choose(["onset"])


def test_an_inaccurate_device_fails():
    cases = [Case("accuracy-press", "", [], {}, (), (Target("height", "at most 1", "3", False),))]
    with pytest.raises(InaccurateError, match="accuracy-press, height: 3, must be at most 1"):
        suite.check_accuracy(cases)
    suite.check_accuracy([Case("file-press", "", [], {}, (), cases[0].targets)])


def test_maps_that_differ_are_named_with_a_pixel():
    ours = {"height": np.array([[1.0, np.nan], [2.0, 3.0]])}
    agree("peer", {"height": ours["height"] + 0.1}, ours, {"height": 0.2})
    agree("peer", {"height": ours["height"].copy()}, ours)
    other = {"height": np.array([[1.0, np.nan], [2.0, 4.0]])}
    agree("peer", other, ours, spared=1)
    with pytest.raises(
        DisagreementError, match=r"peer differs from mirrorskin in the height of 1 of 4 .*\(1, 1\)"
    ):
        agree("peer", other, ours)
    with pytest.raises(DisagreementError, match="there is no height"):
        agree("peer", {}, ours)


def test_shares_are_of_the_limit_above_or_of_the_case():
    def row(name, seconds, limit=None):
        timing = Timing(seconds, seconds, seconds, 3)
        return Row(name, Measured(timing, {"kernel": timing}, {}, {}, 1.0, 0.0), 100, limit=limit)

    first, second = row("read limit, small", 1.0), row("read limit, large", 2.0)
    works = row("scan, small", 4.0, first), row("scan, large", 4.0, second), row("scan", 4.0)
    case = Case("sweep", "", [first, second, *works], {})
    assert [case.share(work) for work in works] == [0.25, 0.5, 0.25]
    assert case.kernel_share(works[1]) == 0.5


def test_a_direct_solution_solves_its_own_equations():
    shape = (40, 50)
    slopes, mask, edges = noisy_slopes(shape), blob_mask(shape), random_cuts(shape, 5)
    truth = integration.find_truth(slopes, mask, edges)
    left = truth.system.matrix @ truth.values - truth.system.source
    assert np.abs(left).max() < 1e-12
    assert truth.error(truth.values) < 1e-15
    assert truth.error(truth.map) < 1e-6
