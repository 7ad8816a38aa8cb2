"""Standard deviations stay true when a camera fails, or the result has a warning; see docs/faults.md.

``python evaluation/faults/matrix.py --freeze`` stores cells that became right, and the page.
"""

import functools

import pytest

from mirrorskin.evaluation.faults.matrix import (
    ESTIMATORS,
    FUNCTIONS,
    PAGE,
    open_cells,
    row,
    row_of_arrays,
    with_tables,
)

SLOW = pytest.mark.slow
row_of = functools.cache(row)


@SLOW
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_standard_deviation_is_true_or_there_is_a_warning(estimator):
    wrong = {fault: str(cell) for fault, cell in row_of(estimator).items() if not cell.honest}
    assert {fault: cell for fault, cell in wrong.items() if fault not in open_cells()[estimator]} == {}


@SLOW
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_list_of_wrong_standard_deviations_shrinks(estimator):
    right = [fault for fault, cell in row_of(estimator).items() if cell.clearly_honest]
    assert set(right) & set(open_cells()[estimator]) == set(), "store them: matrix.py --freeze"


@SLOW
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_nothing_is_warned_of_without_a_fault(estimator):
    assert not row_of(estimator)["none"].warned


@SLOW
@pytest.mark.parametrize("estimator", FUNCTIONS)
def test_a_function_on_arrays_is_as_honest_as_a_recording(estimator):
    wrong = {fault: str(cell) for fault, cell in row_of_arrays(estimator).items() if not cell.honest}
    assert {fault: cell for fault, cell in wrong.items() if row_of(estimator)[fault].honest} == {}


def test_the_page_shows_the_stored_cells():
    page = PAGE.read_text(encoding="utf-8")
    assert with_tables(page) == page, "write it: python evaluation/faults/matrix.py --freeze"
