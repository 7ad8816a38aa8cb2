"""Maps declared by an operation: refusals when its class is defined, and when it returns them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from mirrorskin import engine, io

SHAPE = (4, 6)
FLAT = np.zeros(SHAPE, np.float32)
FRAMES = np.zeros((2, *SHAPE), np.uint8)


def operation(maps, **returned):
    """Return a class with these maps whose result is what is given."""
    methods = {"push": lambda self, frames: None, "result": lambda self: returned}
    return type("Own", (engine.Operation,), {**maps, **methods})


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ({"x": io.Map(unit="mm")}, "a map cannot be called 'x': use letters, digits and _, but not"),
        ({"process": io.Map()}, "a map cannot be called 'process'"),
        ({"reset": io.Map()}, "a map cannot be called 'reset', which operations use. Choose another name"),
        (
            {"height": io.Map("h", "µm")},
            "the map height has the unit µm. Declare mm, as the built-in map has",
        ),
        ({"height": io.Map("h", "mm", axes="none")}, "the map height has the axes none. Declare pixels"),
        (
            {"height_sigma": io.Map("h", "µm")},
            "the map height_sigma has the unit µm, but height has the unit mm",
        ),
        (
            {"rise": io.Map(unit="mm"), "rise_sigma": io.Map(unit="µm")},
            "the map rise_sigma has the unit µm, but rise has the unit mm. Declare mm",
        ),
        (
            {"kind": io.Map(codes={1: "a", 2: "b"}, undefined=0)},
            "the map kind is undefined at 0, which is not in its codes (1, 2)",
        ),
        (
            {name: io.Map(unit="mm", quantity="height") for name in "ab"},
            "both a and b have the quantity height. Leave it out of one",
        ),
        (
            {"height": io.Map(unit="mm"), "rise": io.Map(unit="mm", quantity="height")},
            "both height and rise have the quantity height. Leave one of them out",
        ),
    ],
)
def test_a_class_whose_maps_cannot_be_returned_is_refused(maps, message):
    with pytest.raises(io.InputError, match=f"^Own: {re.escape(message)}") as caught:
        operation(maps)
    assert "\n" not in str(caught.value)


def test_a_standard_deviation_in_the_unit_of_its_map_is_accepted():
    maps = {"rise": io.Map(unit="mm", quantity="height"), "rise_sigma": io.Map("error of the rise", "mm")}
    found = engine.run(FRAMES, operation(maps, rise=FLAT, rise_sigma=FLAT))
    assert found.declaration("rise_sigma").caption == "error of the rise"


def test_two_maps_of_heights_are_refused():
    kind = operation({"rise": io.Map(unit="mm", quantity="height")}, rise=FLAT, height=FLAT)
    message = "both height and rise have the quantity height. Leave one of them out"
    with pytest.raises(io.InputError, match=rf"^Own\.result\(\): {message}$"):
        engine.run(FRAMES, kind)


CODES = {0: "flat", 1: "rise", 3: "edge"}


@pytest.mark.parametrize(
    ("codes", "dtype", "value"),
    [
        (CODES, "uint8", 7),
        (CODES, "uint8", 2),
        (CODES, "int16", -1),
        ({0: "flat", 200: "edge"}, "uint8", 100),
        ({0: "flat", 1_000_000: "edge"}, "int32", 5),
    ],
)
def test_a_code_that_is_not_in_the_legend_is_refused(codes, dtype, value):
    values = np.full(SHAPE, max(codes))
    values[0, 0], values[2, 3] = 0, value
    legend = ", ".join(f"{code} {text}" for code, text in codes.items())
    kind = operation({"kind": io.Map(codes=codes, dtype=dtype)}, kind=values)
    message = f"Own.result(): map kind has the value {value}, which is not in its codes ({legend})"
    with pytest.raises(io.InputError, match=f"^{re.escape(message)}. Add it to codes$"):
        engine.run(FRAMES, kind)


@pytest.mark.parametrize("codes", [CODES, {0: "flat", 200: "edge"}])
def test_codes_of_the_legend_are_accepted(codes):
    values = np.resize([*codes], SHAPE)
    found = engine.run(FRAMES, operation({"kind": io.Map(codes=codes)}, kind=values))
    np.testing.assert_array_equal(found["kind"], values)
