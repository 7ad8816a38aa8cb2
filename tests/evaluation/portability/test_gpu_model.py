"""Times that are predicted for a GPU agree with a run that was measured, and with the work that they need."""

import pytest

from mirrorskin.evaluation.portability import gpu_model, gpu_work
from mirrorskin.evaluation.portability.gpu_model import FITTED, Launch
from mirrorskin.evaluation.portability.gpu_work import Sample, Work

MANY = 1 << 20
COUNTS = """Instructions executed for kernel 'add':
          1,024 - load global (4,096 bytes)
          2,048 - load private (8,192 bytes)
            512 - store global (2,048 bytes)
            256 - fadd
             10 - fdiv
              1 - call _Z4sqrtf()
            300 - call helper()
"""


@pytest.mark.parametrize("part", [0, 1], ids=("kernels", "calls"))
def test_the_half_that_was_not_fitted_is_predicted_within_a_factor_of_2(part):
    rows = gpu_model.load()[part]
    assert list(gpu_model.unexplained(rows)) == []


def test_only_what_is_outside_is_named_so():
    outside = {row.name for rows in gpu_model.load() for row in rows if not gpu_model.is_within(row.factor())}
    assert outside == gpu_model.OUTSIDE.keys()


def test_constants_are_those_of_the_fit():
    assert tuple(gpu_model.fit()) == pytest.approx(tuple(FITTED), rel=0.02)


@pytest.mark.parametrize(
    ("launch", "seconds"),
    [
        (Launch(MANY, 0, Work(read=2e9, written=1e9)), 3e9 / gpu_model.MEMORY),
        (Launch(MANY, 0, Work(read=2e6, operations=1e12)), 1e12 / FITTED.arithmetic),
        (Launch(64, 64 * 16384, Work()), 16384 * FITTED.share),
    ],
    ids=["as long as the memory takes", "as long as its operations take", "as long as one work-item reads"],
)
def test_a_launch_takes_as_long_as_what_limits_it(launch, seconds):
    assert launch.seconds() == pytest.approx(FITTED.start + seconds)


def test_oclgrinds_counts_are_summed():
    assert gpu_work.summed(COUNTS.splitlines()) == Work(read=4096, written=2048, operations=256 + 100 + 20)


def test_work_is_linear_in_items_and_declared_bytes():
    def sample(items, moved):
        return Sample("scan", items, moved, Work(moved + 50 * items, 30 * items, 7 * moved))

    table = gpu_work.fit([sample(1024, 1024), sample(1024, 16384), sample(4096, 4096)])
    assert gpu_work.work_of(table, "scan", 10000, 70000) == pytest.approx((570000, 300000, 490000), rel=1e-3)


def test_work_of_one_kind_of_launch_is_scaled_by_what_it_declares():
    table = gpu_work.fit([Sample("sum", 128, 4000, Work(4000, 40, 2000))] * 2)
    assert gpu_work.work_of(table, "sum", 128, 8000) == pytest.approx((8000, 80, 4000))
