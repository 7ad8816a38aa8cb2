"""``mirrorskin measure``: values with units and uncertainties, as text and as JSON."""

import csv
import json
from itertools import pairwise

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
    ended = run("measure", ball, "--all")
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
    lines = run("measure", ball, "--all").out.splitlines()
    headings = [after for before, after in pairwise(lines) if not before]
    assert headings[:4] == ["heights", "areas and volumes", "form", "texture: height"]
    assert any(line.startswith("  Sdq ") and line.endswith("root mean square gradient") for line in lines)


def spread_of(text, name):
    (line,) = (line for line in text.splitlines() if line.startswith(f"  {name}  "))
    return float(line.partition("±")[2].split()[0])


def test_expanded_uncertainties_are_twice_as_large(ball):
    plain, expanded = (run("measure", ball, "--all", *more).out for more in ([], ["--expanded"]))
    assert spread_of(expanded, "Sz") == pytest.approx(2 * spread_of(plain, "Sz"), rel=0.05)
    assert "± is the expanded uncertainty (k = 2)" in expanded


def test_a_budget_is_a_table_and_an_entry_for_programs(ball):
    out = run("measure", ball, "--all", "--budget", "--l-filter=1mm").out
    head = next(line for line in out.splitlines() if "combined" in line)
    assert "noise, random" in head
    assert "filter edges" in head
    assert set(told(ball, "--budget")["budget"]["Sq"]) == {"noise, random", "noise, systematic", "form"}


def test_the_length_of_the_noise_is_an_option(ball):
    assert any("correlated over 0.3 mm" in note for note in told(ball, "--noise-length=300um")["notes"])


@pytest.fixture
def rough(tmp_path):
    """A wavy plane of 30 x 40 pixels of 0.1 mm with dust, in a file."""
    x, y = places((30, 40), SIZE)
    height = 0.002 * np.sin(9 * x) + 0.001 * np.cos(7 * y) + 0.01 * x
    height[3:5, 30:33] += 0.3
    path = tmp_path / "rough.h5"
    io.save_result(result_of(height, SIZE, sigma=1e-5), path)
    return path


def test_the_ten_that_matter_come_after_the_remarks(rough):
    lines = run("measure", rough).out.splitlines()
    first = next(number for number, line in enumerate(lines) if not line)
    assert any("standard uncertainty" in line for line in lines[:first])
    assert len([line for line in lines if line.startswith("  ")]) <= 10
    assert lines[-1].endswith("more quantities: --all")
    assert "--all" not in run("measure", rough, "--all").out.splitlines()[-1]


def test_a_smooth_ball_has_no_texture(ball):
    out = run("measure", ball).out
    assert "cannot be distinguished from a smooth one" in out
    assert not any(line.startswith("  Sq") for line in out.splitlines())


def test_many_results_are_a_table_with_limits_and_a_chart(ball, rough, tmp_path):
    lot = tmp_path / "lot"
    lot.mkdir()
    for number in range(20):
        height = cap(SHAPE, SIZE, 5 + 0.01 * number, 2.5)
        io.save_result(result_of(height, SIZE, sigma=0.001), lot / f"ball{number:02}.h5")
    table, chart = tmp_path / "lot.csv", tmp_path / "lot.png"
    limits = ["--limits", "sphere radius=4.95mm:5.1mm", "--limits=sphere centre x=-1mm:1mm"]
    ended = run("measure", lot / "*.h5", "-o", table, "--chart", chart, *limits)
    assert ended.code == 1
    assert "of 20 outside of the limits" in ended.said
    assert chart.read_bytes().startswith(b"\x89PNG")
    lines = [line for line in table.read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert len(rows) == 20
    assert float(rows[3]["sphere radius [mm]"]) == pytest.approx(5.03, abs=1e-4)
    assert 0 < float(rows[3]["u(sphere radius) [mm]"]) < 0.05
    assert (rows[0]["limits"], rows[19]["limits"]) == ("inside", "outside")
    assert "Sq [µm]" in rows[0]
    limits_file = tmp_path / "limits.toml"
    limits_file.write_text('"sphere radius" = "4mm:6mm"\n')
    assert run("measure", lot / "*.h5", "--limits", limits_file).code == 0
    printed = json.loads(run("measure", ball, rough, "--json").out)["files"]
    assert [entry["file"] for entry in printed] == [str(ball), str(rough)]
    assert printed[1]["quantities"]["Sq"]["unit"] == "µm"


def test_a_result_that_cannot_be_measured_is_a_row(ball, tmp_path):
    io.save_result(io.Result(azimuth=np.zeros(SHAPE, np.float32)), tmp_path / "wave.h5")
    ended = run("measure", ball, tmp_path / "wave.h5", "-o", tmp_path / "t.csv")
    assert ended.code == 1
    assert "1 of 2 could not be measured" in ended.said
    assert "has no heights" in (tmp_path / "t.csv").read_text()


def test_limits_of_results_that_cannot_be_measured_are_kept(tmp_path):
    io.save_result(io.Result(azimuth=np.zeros(SHAPE, np.float32)), tmp_path / "wave.h5")
    ended = run("measure", tmp_path / "wave.h5", "--limits", "Sq=:2um", "-o", tmp_path / "t.csv")
    assert "1 of 1 could not be measured" in ended.said
    assert "limits of Sq: at most 2 um" in (tmp_path / "t.csv").read_text()


def test_all_quantities_of_many_results_are_columns(ball, rough):
    columns = [run("measure", ball, rough, *more).out.splitlines()[0] for more in ([], ["--all"])]
    assert "measured area" not in columns[0]
    assert "measured area" in columns[1]


def test_the_budgets_of_many_results_are_in_json(ball, rough):
    refused("add --json", "measure", ball, rough, "--budget")
    files = json.loads(run("measure", ball, rough, "--budget", "--json").out)["files"]
    assert all("sphere radius" in entry["budget"] or "Sq" in entry["budget"] for entry in files)


def test_masks_and_references_are_options(rough, tmp_path):
    plain, masked = (told(rough, *more)["quantities"] for more in ([], ["--mask=defects"]))
    assert plain["Sz"]["value"] > 200 > 20 > masked["Sz"]["value"]
    assert told(rough, "--mask=above:0.1mm")["quantities"]["Sz"]["value"] < 20
    polygon = told(rough, "--mask=polygon:0.9mm,0.9mm:1.4mm,0.9mm:1.4mm,1.4mm:0.9mm,1.4mm")
    assert polygon["quantities"]["Sz"]["value"] < 20
    inside = told(rough, "--mask=only:-1mm,-1mm:1mm,-1mm:1mm,1mm:-1mm,1mm")["quantities"]
    assert inside["measured area"]["value"] == pytest.approx(4)
    keep = np.ones((30, 40), np.uint8)
    keep[2:6, 29:34] = 0
    np.save(tmp_path / "keep.npy", keep)
    assert told(rough, "--mask", tmp_path / "keep.npy")["quantities"]["Sz"]["value"] < 20
    same = told(rough, "--reference", rough, "--form=none")["quantities"]
    assert same["height range"]["value"] == 0
    assert same["median height"]["sigma"] == pytest.approx(np.sqrt(2) * 1e-5, rel=1e-5)
    assert told(rough, "--form=polynomial2")["quantities"]["polynomial residual RMS"]["value"] > 1


def test_wrong_limits_masks_and_files_are_refused_in_a_line(ball, rough, tmp_path):
    refused("neither a file nor polygon", "measure", ball, "--mask", "dust")
    refused("at least three corners", "measure", ball, "--mask", "polygon:0mm,0mm:1mm,0mm")
    refused("a mask of 61 x 71 pixels", "measure", ball, "--mask", picture_of_zeros(tmp_path))
    refused("NAME=LOW:HIGH is needed", "measure", ball, "--limits", "Sq")
    refused("in one unit are needed", "measure", ball, "--limits", "Sq=1um:2mm")
    refused("limits of Sq are in mm2: give µm", "measure", ball, "--limits", "Sq=:1mm2")
    refused("no result has it", "measure", ball, "--limits", "Sx=:1mm")
    refused("ends in .csv", "measure", ball, "-o", "t.xlsx")
    refused("ends in .png", "measure", ball, "--chart", "t.txt")
    refused("no file matches", "measure", tmp_path / "*.nothing")
    refused("take one of the same picture", "measure", ball, "--reference", rough)


def picture_of_zeros(folder):
    np.save(folder / "small.npy", np.zeros((3, 4)))
    return folder / "small.npy"


def test_an_averaged_section_has_a_groove(tmp_path):
    x, _ = places(SHAPE, SIZE)
    noise = 0.001 * np.random.default_rng(4).standard_normal(SHAPE)
    io.save_result(result_of(noise - 0.02 * (abs(x) < 0.55), SIZE, sigma=0.001), tmp_path / "slot.h5")
    line = "--section=-3mm,0mm:3mm,0mm"
    one, wide = (told(tmp_path / "slot.h5", line, *w)["quantities"] for w in ([], ["--section-width=2mm"]))
    assert wide["groove depth"]["value"] == pytest.approx(0.02, abs=4 * wide["groove depth"]["sigma"])
    assert wide["groove depth"]["sigma"] < 0.5 * one["groove depth"]["sigma"]
    assert wide["groove width"]["value"] == pytest.approx(1.1)
