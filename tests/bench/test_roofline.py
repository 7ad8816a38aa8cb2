"""The roofline holds what a run measured, and becomes a picture."""

import cv2
import pytest
from bench_runs import case, row, run

from mirrorskin.bench.roofline import draw_rooflines, roofline_of

GIGA = 10**9


def limits(read=10.0, triad=8.0, peak=40.0, size=GIGA):
    """Return the limits of a machine, in GB/s and G multiply-adds/s."""
    return [
        row("read limit, VGA", 1.0, moved=size, kernel=size / GIGA / read),
        row("triad limit, VGA", 1.0, moved=size, kernel=size / GIGA / triad),
        row("copy limit, VGA", 1.0, moved=size, kernel=size / GIGA / 99),
        row("multiply-add limit, VGA", 1.0, operations=GIGA, kernel=1 / peak),
    ]


def kernel(name, rate, intensity=2, **changes):
    """Return a kernel that does so many G operations/s, so many with each byte."""
    return row(name, 9.0, moved=GIGA, operations=intensity * GIGA, kernel=intensity / rate, **changes)


def roofline(*rows, above=None):
    return roofline_of(run(case("sweep-any", *(limits() if above is None else above), *rows))["cases"])


def test_kernels_stand_where_their_own_time_puts_them():
    found = roofline(kernel("scan, VGA", 15.0))
    (scan,) = found.kernels
    assert (scan.name, scan.case) == ("scan", "sweep-any")
    assert scan.best.intensity == 2
    assert scan.best.rate == pytest.approx(15 * GIGA)


def test_the_ceilings_are_those_of_the_run():
    found = roofline(kernel("scan", 15.0))
    assert found.bandwidths == pytest.approx({"read": 10 * GIGA, "triad": 8 * GIGA})
    assert found.peak == pytest.approx(40 * GIGA)
    assert found.allowed(2.0) == pytest.approx(20 * GIGA)
    assert found.allowed(4.0) == pytest.approx(40 * GIGA)
    assert found.allowed(400.0) == pytest.approx(40 * GIGA)


def test_a_small_limit_lies_in_a_cache_and_is_no_ceiling():
    small = limits(read=500.0, triad=400.0, size=GIGA // 10)
    found = roofline(kernel("scan", 15.0), above=[*small, *limits()])
    assert found.bandwidths == pytest.approx({"read": 10 * GIGA, "triad": 8 * GIGA})


def test_a_kernel_stands_where_its_pictures_are_too_large_for_a_cache():
    small = row("scan, VGA", 1.0, moved=GIGA // 10, operations=GIGA, kernel=0.01)
    (scan,) = roofline(kernel("scan, 20 Mpx", 15.0), small).kernels
    assert len(scan.points) == 2
    assert scan.best.rate == pytest.approx(15 * GIGA)


def test_the_share_is_of_the_limit_that_binds():
    # Of memory, a kernel with 2 operations a byte may do 20 G operations/s; of arithmetic, any may do 40.
    memory, arithmetic = kernel("scan", 15.0), kernel("normals", 30.0, intensity=100)
    found = roofline(memory, arithmetic)
    assert [found.share(one.best) for one in found.kernels] == pytest.approx([15 / 20, 30 / 40])
    turns = [one | {"kernel_share": share} for one, share in ((memory, 0.9), (arithmetic, 0.01))]
    found = roofline(*turns)
    assert [found.share(one.best) for one in found.kernels] == pytest.approx([0.9, 30 / 40])


def test_sizes_and_types_are_one_kernel_and_kernels_are_in_the_order_of_their_intensity():
    found = roofline(
        kernel("late, VGA", 30.0, 50),
        kernel("scan, VGA", 9.0),
        kernel("scan, 1080p", 11.0),
        kernel("slow", 1.0, 1),
    )
    assert [one.name for one in found.kernels] == ["slow", "scan", "late"]
    assert len(found.kernels[1].points) == 2
    assert found.kernels[1].best.rate == pytest.approx(11 * GIGA)


@pytest.mark.parametrize(
    "rows",
    [
        [row("NumPy", 1.0, moved=8, operations=8)],
        [row("onset_scan", 1.0, moved=8, kernel=1.0)],
        [row("count", 1.0, operations=8, kernel=1.0)],
        [row("idle", 1.0, moved=8, operations=8, kernel=0.0)],
        [],
    ],
    ids=["no kernel", "no operations", "no bytes", "no time", "nothing"],
)
def test_without_a_kernel_s_bytes_operations_and_time_there_is_none(rows):
    assert roofline(*rows) is None


def test_without_a_limit_of_memory_there_is_none():
    assert roofline(kernel("scan", 15.0), above=limits()[2:]) is None


@pytest.mark.parametrize(("machines", "kernels", "above"), [(1, 1, limits()[:3]), (2, 24, limits())])
def test_a_picture_is_written_for_few_kernels_and_for_many(tmp_path, machines, kernels, above):
    found = roofline(*(kernel(f"kernel_{n}", 0.5 + n, n + 1) for n in range(kernels)), above=above)
    draw_rooflines({f"machine {n}": found for n in range(machines)}, tmp_path / "roof.png")
    picture = cv2.imread(str(tmp_path / "roof.png"))
    assert picture.std() > 10
    assert picture.shape[0] / picture.shape[1] == pytest.approx(machines * 7 / 13, rel=0.01)
