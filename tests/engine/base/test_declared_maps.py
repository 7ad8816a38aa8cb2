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
        ({"start": io.Map()}, "a map cannot be called 'start', which operations use. Choose another name"),
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
    result = engine.run(FRAMES, operation(maps, rise=FLAT, rise_sigma=FLAT))
    assert result.declaration("rise_sigma").caption == "error of the rise"


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
    result = engine.run(FRAMES, operation({"kind": io.Map(codes=codes)}, kind=values))
    np.testing.assert_array_equal(result["kind"], values)


WEAR = {"wear": io.Map("depth of the wear", "mm"), "force": io.Map("force", "N", axes="none")}


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ({"waer": FLAT, "force": 1.0}, "returns waer, which is not declared: did you mean wear?"),
        ({"Wear": FLAT, "force": 1.0}, "returns Wear, which is not declared: did you mean wear?"),
        ({"wear": FLAT, "forec": 1.0}, "returns forec, which is not declared: did you mean force?"),
        (
            {"wear": FLAT, "force": 1.0, "waer_sigma": FLAT},
            "returns waer_sigma, which is not declared: did you mean wear_sigma?",
        ),
        (
            {"depth": FLAT, "force": 1.0},
            "does not return wear, which its class declares. Return each declared map, or list those that may"
            " be missing in optional_maps",
        ),
        ({}, "does not return wear and force, which its class declares. Return each"),
    ],
)
def test_a_declared_map_that_is_not_returned_is_refused_with_its_name(returned, message):
    with pytest.raises(io.InputError, match=rf"^Own\.result\(\) {re.escape(message)}") as caught:
        engine.run(FRAMES, operation(WEAR, **returned))
    assert "\n" not in str(caught.value)


def test_a_misspelt_map_in_what_a_subclass_adds_to_its_base_is_refused():
    class Own(engine.Onset):
        wear = WEAR["wear"]

        def result(self):
            return super().result().assign(waer=np.zeros(self.shape))

    with pytest.raises(io.InputError, match=r"^Own\.result\(\) returns waer.*: did you mean wear\?$"):
        engine.run(FRAMES, Own, travel=[0.0, 1.0])


def test_a_map_that_a_subclass_declares_and_nothing_returns_is_refused():
    subclass = type("Own", (engine.Onset,), {"wear": WEAR["wear"]})
    with pytest.raises(io.InputError, match=r"^Own\.result\(\) does not return wear"):
        engine.run(FRAMES, subclass, travel=[0.0, 1.0])


def test_a_map_of_a_base_that_looks_like_another_one_is_refused():
    class Own(engine.Onset):
        def result(self):
            return {"heigth": np.zeros(self.shape)}

    with pytest.raises(io.InputError, match="returns heigth, which is not declared: did you mean height"):
        engine.run(FRAMES, Own, travel=[0.0, 1.0])


def test_a_result_that_replaces_that_of_a_base_may_have_other_maps():
    class Own(engine.Onset):
        def result(self):
            return {"height": np.ones(self.shape), "certainty": np.ones(self.shape)}

    assert list(engine.run(FRAMES, Own, travel=[0.0, 1.0])) == ["height", "certainty"]


def test_a_map_that_may_be_missing_can_be_left_out():
    subclass = type("Own", (operation(WEAR, wear=FLAT),), {"optional_maps": ("force",)})
    assert list(engine.run(FRAMES, subclass)) == ["wear"]


def test_maps_that_are_not_declared_may_be_returned_in_addition():
    result = engine.run(FRAMES, operation(WEAR, wear=FLAT, force=1.0, area=FLAT, area_sigma=FLAT))
    assert set(result) == {"wear", "force", "area", "area_sigma"}


def test_an_optional_map_that_is_not_declared_is_refused_where_the_class_is_defined():
    with pytest.raises(
        io.InputError, match=r"optional_maps: Own has no map forec: did you mean force\?"
    ) as caught:
        operation({**WEAR, "optional_maps": ("forec",)})
    assert "\n" not in str(caught.value)
