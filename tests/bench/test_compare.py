"""Comparison of two runs: changes beyond the scatter of rounds, and runs that cannot be compared."""

import re

import pytest
from bench_runs import case, row, target
from bench_runs import run as made

from mirrorskin.bench.suite.compare import HEAD, as_rows, as_text, compare
from mirrorskin.cli.commands.bench.records import Machine
from mirrorskin.io import InputError


def one(seconds, run=None, **changes):
    """Return a run of one work that takes this many seconds."""
    return made(case("press", row("mirrorskin", seconds, moved=1000, **changes)), **(run or {}))


def difference(before, after):
    (work,) = compare(before, after).cases["press"]
    return work


@pytest.mark.parametrize(
    ("seconds", "verdict"),
    [(0.85, "faster"), (0.95, "as before"), (1.0, "as before"), (1.05, "as before"), (1.15, "slower")],
)
def test_only_what_differs_by_more_than_its_spread_is_faster_or_slower(seconds, verdict):
    work = difference(one(1.0), one(seconds))
    assert work.verdict == verdict
    assert work.ratio == pytest.approx(seconds)
    # Quartiles lie 5 % on either side.
    assert work.lower == pytest.approx(seconds * 0.95 / 1.05)
    assert work.upper == pytest.approx(seconds * 1.05 / 0.95)


def test_a_wide_spread_hides_a_difference_and_a_narrow_one_shows_it():
    assert difference(one(1.0, spread=0.3), one(1.3)).verdict == "as before"
    assert difference(one(1.0, spread=0.001), one(1.01, spread=0.001)).verdict == "slower"


def test_two_turns_have_no_spread():
    assert difference(one(1.0, rounds=2), one(5.0)).verdict == "unknown"
    assert difference(one(1.0), one(5.0, rounds=1)).verdict == "unknown"


def test_limits_of_nearly_as_many_bytes_are_compared_for_as_much_work():
    before = made(case("press", row("read limit", 1.0, moved=1000)))
    after = made(case("press", row("read limit", 1.02, moved=1020)))
    assert difference(before, after).ratio == pytest.approx(1)


@pytest.mark.parametrize("changes", [{"moved": 1100}, {"moved": 0}, {"moved": 1000, "frames": 3}])
def test_other_work_under_the_same_name_is_not_compared(changes):
    other = row("mirrorskin", 1.0, **changes)
    same = row("NumPy", 2.0, moved=1000)
    comparison = compare(
        made(case("press", row("mirrorskin", 1.0, moved=1000), same)), made(case("press", other, same))
    )
    assert [work.name for work in comparison.cases["press"]] == ["NumPy"]
    assert comparison.apart == ("press: not the same work in both, or only in one: mirrorskin",)


def test_works_and_limits_are_counted_apart():
    def of(limit, mine, theirs):
        return made(
            case(
                "press",
                row("read limit", limit, moved=10),
                row("mirrorskin", mine, moved=10),
                row("NumPy", theirs, moved=10),
            )
        )

    comparison = compare(of(1, 1, 1), of(2, 4, 1))
    assert comparison.summary == (
        "works: 1 slower, 1 as before; B takes 2.00 times as long as A (geometric mean)",
        "limits of the machine: 1 slower; B takes 2.00 times as long as A (geometric mean)",
    )


def test_cases_and_works_of_only_one_run_are_named():
    shared = row("mirrorskin", 1.0)
    before = made(case("gone", shared), case("press", shared, row("Numba", 1.0)))
    after = made(case("press", shared, row("PyTorch", 1.0)), case("new", shared))
    comparison = compare(before, after)
    assert list(comparison.cases) == ["press"]
    assert comparison.apart == (
        "only in A: gone",
        "only in B: new",
        "press: not the same work in both, or only in one: Numba, PyTorch",
    )


def test_runs_with_nothing_in_common_are_refused():
    others = made(case("other", row("mirrorskin", 1.0)))
    with pytest.raises(InputError, match="no work in common"):
        compare(one(1.0), others)
    with pytest.raises(InputError, match="no work in common"):
        compare(one(1.0), made(case("press", row("mirrorskin", 1.0, moved=9))))
    with pytest.raises(InputError, match="no work in common"):
        compare(made(), made())


GPU = Machine("Other GPU", "Some platform", "1.0", "gpu")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device": GPU}, "other machine or device: Some platform: Some GPU .* / Some platform: Other GPU"),
        ({"processor": "Other"}, "other machine or device: .*; Some processor / .*; Other"),
        ({"threads": 4}, "other machine or device: .* 2 threads.* 4 threads"),
        ({"system": "Linux arm64"}, "other system: Linux x86_64 / Linux arm64"),
        ({"versions": {"numpy": "3.0"}}, "other numpy: 2.4.6 / 3.0"),
        ({"versions": {"torch": "2.13"}}, "other torch: none / 2.13"),
        ({"quick": True}, "B: made with --quick; the times mean nothing"),
    ],
)
def test_other_differences_are_warnings(changes, message):
    comparison = compare(one(1.0), one(1.0, run=changes))
    assert len(comparison.warnings) == 1
    assert re.fullmatch(f"{message}.*", comparison.warnings[0])


def test_another_commit_and_what_one_run_did_not_record_are_no_reason_for_a_warning():
    versions = {"mirrorskin": "0.2.0", "Python": "3.11.7", "scipy": "1.17"}
    assert compare(one(1.0), one(1.0, run={"commit": "fedcba", "versions": versions})).warnings == ()


def test_targets_that_only_one_run_met_are_reported():
    def of(first, second):
        return made(case("file", targets=(target("whole path", first), target("memory", second))))

    comparison = compare(of(True, False), of(False, True))
    assert comparison.targets == (
        "file, whole path: missed now: 1.3 times before, 1.3 times now (at most 1.25 times)",
        "file, memory: met now: 1.3 times before, 1.3 times now (at most 1.25 times)",
    )
    assert compare(of(True, False), of(True, False)).targets == ()


def test_a_comparison_is_a_table():
    limit = row("read limit", 1.0, moved=1000)
    before, after = (made(case("press", limit, row("mirrorskin", t, moved=1000))) for t in (2.0, 4.0))
    comparison = compare(before, after)
    _, cells = as_rows(comparison.cases["press"])
    assert dict(zip(HEAD, cells, strict=True)) == {
        "work": "mirrorskin",
        "A, ms": "2000",
        "B, ms": "4000",
        "B / A": "2.00",
        "quartiles": "1.81-2.21",
        "verdict": "slower",
        "A, of limit": "50 %",
        "B, of limit": "25 %",
    }
    text = as_text(before, after)
    assert "mirrorskin   2000   4000   2.00  1.81-2.21   slower         50 %         25 %" in text
