"""No call may do more on a GPU than in the table; ``gpu_counts.py --freeze`` updates the table."""

import warnings

import pytest

from mirrorskin.evaluation.portability import gpu_counts
from mirrorskin.io import MirrorskinWarning
from mirrorskin.kernels.device import open_device

KNOWN = gpu_counts.load()


@pytest.fixture(scope="module")
def counts():
    device = open_device()
    as_it_is = device.info, device.layout
    with warnings.catch_warnings(action="ignore", category=MirrorskinWarning):  # its press is not its turn
        try:
            return dict(gpu_counts.count_all())
        finally:
            device.info, device.layout = as_it_is  # other tests use this device, too


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOWN)
def test_a_call_has_a_gpu_do_no_more_than_before(counts, name):
    assert list(gpu_counts.complaints(name, counts[name], KNOWN[name])) == []


@pytest.mark.slow
def test_every_call_is_in_the_table(counts):
    assert counts.keys() == KNOWN.keys()


def test_what_rises_is_printed_in_a_line():
    row = KNOWN["integrate"]
    more = {**row, "launches": row["launches"] + 1, "waits": row["waits"] - 1}
    assert list(gpu_counts.complaints("integrate", more, row)) == [
        f"integrate: launches {row['launches'] + 1}, and the table has {row['launches']}"
    ]
