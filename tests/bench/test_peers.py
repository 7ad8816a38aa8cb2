"""Ratios of processor times to peers, and the check that they have not grown."""

from __future__ import annotations

import pytest

from mirrorskin.bench.suite.peers import ratios, regressions
from mirrorskin.cli.commands.bench.records import Case, Row, Timing
from mirrorskin.cli.commands.bench.timing import Work, take_turns
from mirrorskin.kernels.profile import Profile


def case(ours, theirs):
    wall = Timing.of([1.0])
    rows = [
        Row(name=name, wall=wall, processor=time) for name, time in (("mirrorskin", ours), ("Numba", theirs))
    ]
    return Case("peers-fringes", "fringes", rows)


def test_a_ratio_is_that_of_processor_times():
    assert ratios(case(0.3, 0.2)) == {"Numba": pytest.approx(1.5)}


def test_a_function_that_does_its_work_twice_is_found():
    before, after = ({"peers-fringes": case(time, 0.2)} for time in (0.3, 0.6))
    (line,) = regressions(before, after, 1.9)
    assert line.startswith("peers-fringes: 3.00 times the processor time of Numba")


def test_a_slower_machine_is_no_regression():
    assert regressions({"peers-fringes": case(0.3, 0.2)}, {"peers-fringes": case(3.0, 2.0)}, 1.9) == []


def test_a_new_peer_is_no_regression():
    assert regressions({}, {"peers-fringes": case(0.3, 0.2)}, 1.9) == []


def test_processor_time_is_that_of_the_call():
    row = take_turns({"sum": Work(lambda: sum(range(100_000)))}, 3, Profile())["sum"]
    assert 0 < row.processor < 60
