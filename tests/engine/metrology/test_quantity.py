"""Formatting of values with their uncertainty."""

import dataclasses

import pytest

from mirrorskin.engine.metrology import Quantity

NAN = float("nan")


@pytest.mark.parametrize(
    ("value", "sigma", "unit", "read"),
    [
        (5.00213, 0.00083, "mm", "5.00213 ± 0.00083 mm"),
        (5.00213, 0.0123, "mm", "5.002 ± 0.012 mm"),
        (1.0, 0.0996, "mm", "1.00 ± 0.10 mm"),
        (1234.5, 120.0, "mm2", "1230 ± 120 mm2"),
        (1234.5, 12.0, "mm2", "1234 ± 12 mm2"),
        (-0.00001, 0.1, "mm", "0.00 ± 0.10 mm"),
        (0.2, 30.0, "deg", "0 ± 30 deg"),
        (3.0, 0.25, "", "3.00 ± 0.25"),
        (29.71734, NAN, "mm3", "29.717 mm3"),
        (4.0, 0.0, "mm", "4 mm"),
        (5.0, 1e-16, "mm", "5 mm"),
        (2.5, float("inf"), "mm", "2.5 mm"),
        (NAN, 0.1, "mm", "unknown mm"),
    ],
)
def test_a_value_has_two_digits_of_its_uncertainty(value, sigma, unit, read):
    assert str(Quantity(value, sigma, unit)) == read


def test_a_quantity_does_not_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Quantity(1.0, 0.1, "mm").value = 2.0
