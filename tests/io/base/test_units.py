"""The table of units has the factors of pint, and contains what pint writes."""

import math
import re
from pathlib import Path

import pint
import pytest

from mirrorskin.io.base.units import BASE, conversion_factor, in_base, ratio, units_of

ROOT = Path(__file__).parents[3]
PINT = pint.UnitRegistry()
BASES = {**BASE, "pressure": "MPa"}
KNOWN = [(kind, symbol) for kind in BASE for symbol in units_of(kind)]
GRAVITY = PINT.Quantity(1, "standard_gravity")
OTHER_NAMES = {  # of units that pint spells otherwise, or not at all
    r"(mil|mils)": "thou",
    r"(u|µ|μ)in": "microinch",
    r"(.*)(Angstrom)s?": "angstrom",
    r"(\w*)gramme(s?)": r"\1gram\2",
    r"revs?": "turn",
    r"(\w*)Torr": r"\1torr",
    r"kp": "kilogram_force",
    r"kpsi": "ksi",
    r"hbar": "hectobar",
    r"(\w*)s([-_]force)": r"\1\2",
    r"N/([cm]?m)(\^|\*\*|²)?2?": r"N/\1**2",
}
MARKS = {("length", '"'): "inch", ("length", "\u2033"): "inch"} | {
    ("angle", mark): name
    for marks, name in (("'\u2032", "arcminute"), ('"\u2033', "arcsecond"))
    for mark in marks
}


def of_pint(kind, symbol):
    """Return a unit in the table as a quantity of pint; masses are their weights."""
    name = MARKS.get((kind, symbol), symbol)
    for pattern, other in OTHER_NAMES.items():
        if re.fullmatch(pattern, name):
            name = re.sub(pattern, other, name)
            break
    quantity = PINT.Quantity(1, name.replace("-", "_"))
    return quantity * GRAVITY if kind == "force" and quantity.check("[mass]") else quantity


@pytest.mark.parametrize("kind", BASE)
def test_factors_are_those_of_pint(kind):
    for symbol, unit in units_of(kind).items():
        expected = of_pint(kind, symbol).to(BASES[kind]).magnitude
        assert unit.factor == pytest.approx(expected, rel=1e-9), symbol


@pytest.mark.parametrize("kind", BASE)
def test_what_pint_prints_is_in_the_table(kind):
    for symbol, unit in units_of(kind).items():
        printed = f"{of_pint(kind, symbol).units:~}"
        if "*" not in printed.replace("**", ""):  # a weight in pint is a product
            assert in_base(printed, kind) == pytest.approx(unit.factor, rel=1e-9), printed


def test_a_symbol_has_one_meaning_of_a_kind_and_seldom_two():
    kinds = {}
    for kind, symbol in KNOWN:
        kinds.setdefault(symbol, []).append(kind)
    assert {symbol for symbol, several in kinds.items() if len(several) > 1} == {'"', "\u2033"}


@pytest.mark.parametrize(
    ("kind", "symbol", "factor"),
    [
        ("length", "nm", 1e-6),
        ("length", "um", 1e-3),
        ("length", "micrometres", 1e-3),
        ("length", "centimeter", 10.0),
        ("length", "inches", 25.4),
        ("length", "thou", 0.0254),
        ("angle", "degrees", math.pi / 180),
        ("angle", "milliradians", 1e-3),
        ("time", "seconds", 1.0),
        ("time", "msec", 1e-3),
        ("memory", "MiB", 2.0**20),
        ("force", "mN", 1e-3),
        ("force", "MN", 1e6),
        ("pressure", "kPa", 1e-3),
        ("pressure", "N / mm ** 2", 1.0),
    ],
)
def test_factors_have_no_errors_of_rounding(kind, symbol, factor):
    assert in_base(symbol, kind) == factor


@pytest.mark.parametrize(
    ("unit", "other", "factor"),
    [
        ("mm", "um", 1000.0),
        ("kHz", "Hz", 1000.0),
        ("frames/s", "Hz", 1.0),
        ("counts/deg", "counts/rad", 180 / math.pi),
        ("N/mm^2", "N / cm ** 2", 100.0),
        ("um/mN", "mm/N", 1.0),
    ],
)
def test_ratios_of_units_and_of_their_quotients(unit, other, factor):
    assert ratio(unit, other) == pytest.approx(factor, rel=1e-12)


def test_files_are_converted_by_the_same_rules():
    assert conversion_factor("1/deg", "1/rad", "phase") == ratio("1/deg", "1/rad")
    assert conversion_factor("inches", "mm", "travel") == 25.4


@pytest.mark.parametrize("symbol", ["mn", "MM", "KPA", "Deg", "mmm", "kin", "m m", "2*mm", "mm ", "degC", ""])
def test_what_is_in_no_table_is_refused_with_units_that_are_known(symbol):
    with pytest.raises(ValueError, match=r"is not a known unit \(um, mm, cm, m, in, mil, \.\.\.\)"):
        in_base(symbol, "length")


def test_a_page_lists_units_that_are_known():
    page = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    table = page[page.index("## Units") :].split("\n\n")[2]
    rows = [row.strip("| ").split(" | ") for row in table.splitlines()[2:]]
    assert {row[0].partition(",")[0] for row in rows} == {*BASE}
    for title, *cells in rows:
        kind = title.partition(",")[0]
        for symbol in re.findall(r"`([^`]+)`", " ".join(cells)):
            assert symbol in units_of(kind), symbol


def test_the_program_needs_no_pint():
    modules = [
        path
        for name in ("cli", "engine", "hw", "io", "kernels", "view")
        for path in (ROOT / name).rglob("*.py")
    ]
    assert not [
        path
        for path in modules
        if re.search(r"^\s*(import|from) pint", path.read_text("utf-8"), re.MULTILINE)
    ]
