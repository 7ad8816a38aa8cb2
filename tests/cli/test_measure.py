"""``mirrorskin measure``: values with units and uncertainties, as text and as JSON."""

import json

import numpy as np
import pytest
from commands import refused, run
from height_maps import cap, places, result_of

from mirrorskin import io

SHAPE, SIZE = (61, 71), (0.1, 0.1)


@pytest.fixture
def ball(tmp_path):
    """A result of a ball of 10 mm, in a file."""
    path = tmp_path / "ball.h5"
    io.save_result(result_of(cap(SHAPE, SIZE, 5.0, 2.5), SIZE, sigma=0.001), path)
    return path


def told(*words):
    """Return what a call prints as JSON."""
    ended = run("measure", *words, "--json")
    assert (ended.code, ended.said) == (0, "")
    return json.loads(ended.out)


def test_numbers_are_printed_with_uncertainty_and_unit(ball):
    ended = run("measure", ball)
    assert (ended.code, ended.said) == (0, "")
    rows = [line.strip().split("  ", 1) for line in ended.out.splitlines() if line.startswith("  ")]
    lines = {name: text.strip() for name, text in rows}
    radius, plus, sigma, unit = lines["sphere radius"].split()
    assert (float(radius), plus, unit) == (pytest.approx(5, abs=0.002), "±", "mm")
    assert 0 < float(sigma) < 0.03
    assert lines["measured area"].endswith("mm2")
    assert lines["volume above rim"].endswith("mm3")
    assert lines["Sq"].endswith("µm         root mean square height") or " µm " in lines["Sq"]
    assert "± is the standard uncertainty (k = 1)" in ended.out


def test_programs_get_value_sigma_and_unit(ball):
    measures = told(ball)
    assert set(measures) == {"quantities", "notes"}
    assert set(measures["quantities"]["sphere radius"]) == {"value", "sigma", "unit"}
    assert measures["quantities"]["sphere radius"]["value"] == pytest.approx(5, abs=1e-3)
    assert measures["quantities"]["Sq"]["unit"] == "µm"


def test_options_choose_the_place_and_the_form(ball):
    part = told(ball, "--region", "20,20,10x15")["quantities"]
    assert part["measured area"]["value"] == pytest.approx(1.5)
    assert "plane tilt" in told(ball, "--form", "plane")["quantities"]
    rough, filtered = (
        told(ball, "--form=plane", *more)["quantities"]["Sq"] for more in ([], ["--l-filter=0.5mm"])
    )
    assert filtered["value"] < 0.1 * rough["value"]
    line = told(ball, "--section=-1mm,0mm:500um,0mm")["quantities"]
    assert line["section length"]["value"] == pytest.approx(1.5)


def test_a_step_is_measured_along_a_section(tmp_path):
    x, _ = places(SHAPE, SIZE)
    io.save_result(result_of(np.where(x > 0, 0.25, 0.0), SIZE), tmp_path / "step.h5")
    step = told(tmp_path / "step.h5", "--section=-3mm,1mm:3mm,1mm")["quantities"]["step height"]
    assert step["value"] == pytest.approx(0.25)
    assert step["unit"] == "mm"


def test_one_turn_of_several_is_measured(tmp_path):
    path = tmp_path / "turns.h5"
    height = cap(SHAPE, SIZE, 5.0, 2.5).astype(np.float32)
    turn = result_of(height, SIZE)
    io.save_result(turn.assign(height=np.stack([height, height - 1])), path)
    first, second = (told(path, "--turn", n)["quantities"]["highest point"]["value"] for n in (0, 1))
    assert first - second == pytest.approx(1)
    refused("choose one with --turn", "measure", path)
    refused("none of turn 2", "measure", path, "--turn", "2")


def test_what_cannot_be_measured_is_printed_in_a_line(ball, tmp_path):
    result = io.open_result(ball)
    io.save_result(result.assign(x=None, y=None), tmp_path / "unsized.h5")
    refused("reconstruct it again with --pixel-size", "measure", tmp_path / "unsized.h5")
    io.save_result(io.Result(azimuth=np.zeros(SHAPE, np.float32)), tmp_path / "wave.h5")
    refused("has no heights", "measure", tmp_path / "wave.h5")
    refused("--region", "measure", ball, "--region", "0,0,100x100")
    refused("a unit is needed", "measure", ball, "--l-filter", "0.8")
    refused("too long for this surface", "measure", ball, "--l-filter", "1m")
    refused("--section", "measure", ball, "--section", "0mm,0mm")
    refused("--form", "measure", ball, "--form", "cube")
    refused("no such file", "measure", tmp_path / "none.h5")


def test_quantities_are_listed_under_headings_with_their_meaning(ball):
    lines = run("measure", ball).out.splitlines()
    headings = [line for line in lines if line and not line.startswith(" ")]
    assert headings[:4] == ["heights", "areas and volumes", "form", "texture: height"]
    assert any(line.startswith("  Sdq ") and line.endswith("root mean square gradient") for line in lines)


def spread_of(text, name):
    (line,) = (line for line in text.splitlines() if line.startswith(f"  {name} "))
    return float(line.partition("±")[2].split()[0])


def test_expanded_uncertainties_are_twice_as_large(ball):
    plain, expanded = run("measure", ball).out, run("measure", ball, "--expanded").out
    assert spread_of(expanded, "Sz") == pytest.approx(2 * spread_of(plain, "Sz"), rel=0.05)
    assert "± is the expanded uncertainty (k = 2)" in expanded


def test_a_budget_is_a_table_and_an_entry_for_programs(ball):
    out = run("measure", ball, "--budget", "--l-filter=1mm").out
    head = next(line for line in out.splitlines() if "combined" in line)
    assert "noise, random" in head
    assert "filter edges" in head
    assert set(told(ball, "--budget")["budget"]["Sq"]) == {"noise, random", "noise, systematic", "form"}


def test_the_length_of_the_noise_is_an_option(ball):
    assert any("correlated over 0.3 mm" in note for note in told(ball, "--noise-length=300um")["notes"])
