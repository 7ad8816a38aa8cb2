"""Tables, statements and examples of docs/formats.md, calibration.md, options.md and sensor.md are right."""

from __future__ import annotations

import re
import runpy
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
from stacks import ball

from mirrorskin import engine, io
from mirrorskin.evaluation.sensor import report as sensor_report
from mirrorskin.twin import Axial, Twin

DOCS = Path(__file__).parents[1] / "docs"
TRAVEL = np.round(np.arange(0.0, 1.3, 0.1), 10)


def examples(page):
    """Return the examples in Python of a page."""
    return re.findall(
        r"^```python\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def named(page):
    """Return all that a page names as code, without the folders before it."""
    return {name.rsplit("/", 1)[-1] for name in re.findall(r"`([^`\n]+)`", (DOCS / page).read_text("utf-8"))}


def datasets(path):
    """Return the names of a file's datasets, but for what a process tells."""
    names = []
    with h5py.File(path) as file:
        file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
    return {name.rsplit("/", 1)[-1] for name in names if "/process/" not in name}


def turn(phases=8):
    return Twin(
        object="sphere",
        shape=(21, 24),
        pixel_size=0.3,
        movement=Axial(2 * np.pi / phases * np.arange(phases), 0.05, 1.2),
        pattern="linear",
    )


def test_a_recording_of_another_program_needs_no_more_than_the_page_lists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = ball((200, 240), 0.03, TRAVEL)
    frames = source.read(np.empty(source.shape, source.dtype)).frames
    exec(examples("formats.md")[0], {"frames": frames, "travel": TRAVEL})
    with io.open_recording("press.h5") as recording:
        assert recording.motion == "vertical"
        assert recording.header.pixel_size == (0.03, 0.03)
        np.testing.assert_array_equal(recording.travel, TRAVEL)
        assert np.isfinite(engine.reconstruct(recording).height).any()


def test_a_result_is_read_without_the_program(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    result = engine.reconstruct(ball((40, 44), 0.15, TRAVEL))
    io.save_result(result, "res.h5")
    names = {}
    (example,) = (block for block in examples("formats.md") if "known" in block and "h5py" in block)
    exec(example, names)
    np.testing.assert_array_equal(names["height"], result.height)
    np.testing.assert_array_equal(names["y"], result.y)
    np.testing.assert_array_equal(names["measured"], np.isfinite(result.height) & (result.filled == 0))
    assert 0 < names["measured"].sum() < names["known"].sum()
    assert f"{np.nanmax(result.height)!s} mm" in capsys.readouterr().out


@pytest.mark.parametrize("per_turn", [False, True])
def test_all_that_is_in_a_result_is_described(tmp_path, per_turn):
    io.save_result(engine.reconstruct(turn(), per_turn=per_turn), tmp_path / "turn.h5")
    names = datasets(tmp_path / "turn.h5")
    assert {"height", "normals", "contact", "offset_unknown", "x"} < names
    assert names <= named("formats.md")


@pytest.mark.parametrize("script", ["map_tables", "option_tables"])
def test_the_tables_of_maps_parameters_operations_and_options_are_those_of_the_declarations(
    script, monkeypatch
):
    monkeypatch.syspath_prepend(DOCS / "site")
    script_names = runpy.run_path(str(DOCS / f"site/{script}.py"))
    for page, text in script_names["pages"]().items():
        assert (DOCS / page).read_text(encoding="utf-8") == text, f"python docs/site/{script}.py writes them"


def test_references_are_measured_from_arrays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = (block for block in examples("calibration.md") if "references" in block)
    exec(code, {})
    references = io.open_calibration("cal.h5").references
    np.testing.assert_allclose(references.dark, 16, atol=4 * 1.5 / np.sqrt(32) + 0.2)
    np.testing.assert_allclose(references.bright, 210, atol=4 * 1.5 / np.sqrt(32) + 0.2)


def test_all_that_is_in_a_recording_is_described(tmp_path):
    source = turn()
    with io.Recorder(source, tmp_path / "turn.h5", truth=source.truth) as recorder:
        recorder.drain(lambda count: None)
    names = datasets(tmp_path / "turn.h5")
    assert {"data", "phase", "pivot", "zenith_gain"} < names
    assert names <= named("formats.md")


@pytest.mark.parametrize("name", ["dimensions", "gap", "distance", "skin"])
def test_a_table_of_the_sensor_is_what_the_report_prints(name):
    page = (DOCS / "sensor.md").read_text(encoding="utf-8").splitlines()
    printed = [line for line in str(sensor_report.TABLES[name]()).splitlines() if line.startswith("|")]
    start = page.index(printed[0])
    assert page[start : start + len(printed)] == printed


def test_the_citation_names_the_version_and_the_address_of_the_package():
    root = DOCS.parent
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    citation = (root / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {settings['project']['version']}\n" in citation
    home = settings["tool"]["mirrorskin"]["home"]
    assert f'\nrepository-code: "{home}"\n' in citation
    # A move of the repository changes these two files only.
    pages = [*root.glob("*.md"), *root.glob("*.py"), *root.glob("*.yml"), *DOCS.rglob("*.md")]
    assert [path.name for path in pages if home in path.read_text(encoding="utf-8")] == []
