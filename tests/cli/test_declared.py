"""Options of commands that are derived from the engine's declarations."""

import json
import math
from pathlib import Path
from typing import Literal

import pytest
from commands import run

from mirrorskin.cli import declared
from mirrorskin.cli.declared import Term, term_of, terms_of
from mirrorskin.engine import option
from mirrorskin.engine.base.options import Configured
from mirrorskin.io import InputError

COPY = Path(declared.__file__).with_suffix(".json")


def test_the_copy_of_the_declarations_is_up_to_date():
    remedy = "run python -m mirrorskin.cli.declared"
    assert json.loads(COPY.read_text()) == json.loads(json.dumps(declared.declarations())), remedy


class Onsets(Configured):
    threshold: float = option(default=0.5, unit="share", within=(0, 1), help="level")
    noise: float = option(default=None, unit="counts", help="noise", shown_default="the first frames")
    length: float = option(default=0.1, unit="mm", help="some length")
    method: Literal["threshold", "change-point"] = option(default="threshold", help="how onsets are found")
    hidden: object = option(default=None, help="only in Python")


class Turns(Configured):
    noise: float = option(default=None, unit="counts", help="noise", shown_default="the first turn")
    tilt: float | Literal["estimate"] = option(default=math.radians(2.5), unit="rad", help="half-angle")
    method: Literal["exact", "paper"] = option(default="exact", help="how normals are found")
    robust: bool = option(default=False, help="keep breaks")


TERMS = {term.name: term for term in terms_of({"vertical": Onsets, "axial": Turns})}


def test_options_of_one_name_become_one_that_names_the_motions_where_they_differ():
    assert list(TERMS) == ["threshold", "noise", "length", "method", "tilt", "robust"]
    noise, method = TERMS["noise"], TERMS["method"]
    assert noise.help == "press, rotation: noise"
    assert noise.shown_default == "press: the first frames; rotation: the first turn"
    assert method.help == "press: how onsets are found; rotation: how normals are found"
    assert method.choices == ("threshold", "change-point", "exact", "paper")
    assert method.shown_default == "press: threshold; rotation: exact"
    assert (noise.motions, TERMS["tilt"].motions) == (("vertical", "axial"), ("axial",))


def test_options_of_one_name_but_different_units_are_refused():
    class Other(Configured):
        noise: float = option(default=None, unit="mm", help="noise")

    with pytest.raises(TypeError, match="noise is declared with different kinds or units"):
        terms_of({"vertical": Onsets, "axial": Other})


def test_defaults_and_placeholders_are_written_as_on_the_command_line():
    shown = {name: (term.metavar, term.shown_default) for name, term in TERMS.items()}
    assert shown["threshold"] == ("SHARE", "0.5")
    assert shown["length"] == ("LENGTH", "0.1mm")
    assert shown["tilt"] == ("ANGLE|estimate", "2.5deg")
    assert shown["robust"][1] == "no-robust"


@pytest.mark.parametrize(
    ("unit", "text", "value"),
    [
        ("mm", "100um", 0.1),
        ("rad", "180deg", math.pi),
        ("MPa", "100kPa", 0.1),
        ("N", "1.5N", 1.5),
        ("s", "10ms", 0.01),
        ("counts/rad", "1/rad", 1.0),
        ("counts", "2.5", 2.5),
        ("", "1e3", 1000.0),
    ],
)
def test_values_are_read_in_the_unit_of_the_declaration(unit, text, value):
    class One(Configured):
        x: float = option(default=None, unit=unit, help="some value")

    assert term_of(One.options["x"]).read(text, "--x") == pytest.approx(value)


@pytest.mark.parametrize(
    ("term", "text", "message"),
    [
        (Term("x", "integer", ""), "2.5", "--x 2.5: a whole number is needed; write e.g. 2"),
        (Term("x", "integer", "", least=2), "1", "--x 1: a number of at least 2 is needed"),
        (Term("x", "numbers", "", "rad"), "1deg,2", "--x 2: a unit is needed; write e.g. 2.5deg"),
        (
            Term("x", "number", "", "mm", words=("auto",)),
            "a",
            "--x a: a number and a unit are needed; write e.g. 0.1mm, or auto",
        ),
    ],
)
def test_a_text_that_cannot_be_read_is_refused_with_an_example(term, text, message):
    with pytest.raises(InputError) as refused:
        term.read(text, "--x")
    assert str(refused.value) == message


def test_help_of_reconstruct_names_the_motions_of_an_option():
    text = " ".join(run("reconstruct --help").out.split())
    assert "--hold FRAMES Press: consecutive" in text
    assert "--tilt ANGLE|estimate Rotation: half-angle" in text
    assert "--contact RES.h5 Slide, twist: where" in text
    assert "--travel-step LENGTH Press: travel" in text
    assert "--pixel-size LENGTH[,LENGTH] Size of a pixel" in text
