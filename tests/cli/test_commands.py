"""The commands, run as a user runs them."""

import json
import subprocess
import sys

import numpy as np
import pytest

from mirrorskin import io

SMALL = ["--size", "70x60", "--pixel-size", "0.15mm"]


def mirrorskin(*words, cwd=None):
    run = subprocess.run(
        [sys.executable, "-m", "mirrorskin.cli.main", *map(str, words)],
        capture_output=True,
        text=True,
        cwd=cwd,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a small sphere, pressed and reconstructed."""
    place = tmp_path_factory.mktemp("sphere")
    mirrorskin("simulate", "vertical", *SMALL, "-o", "sphere.h5", cwd=place)
    mirrorskin("reconstruct", "sphere.h5", cwd=place)
    return place


def test_help_imports_nothing_heavy():
    code = (
        "import sys; sys.argv = ['mirrorskin', '--help']\n"
        "from mirrorskin.cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'h5py', 'pyopencl', 'matplotlib', 'cv2', 'pint', 'rich'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    for command in ("reconstruct", "simulate", "score", "import", "demo", "devices", "info", "bench"):
        assert f"\n  {command} " in run.stdout


def test_a_sphere_is_pressed_reconstructed_and_scored(folder):
    score = json.loads(mirrorskin("score", "sphere-result.h5", "--truth", "sphere.h5", "--json", cwd=folder))
    assert score["answered"] > 1000
    assert score["median"] < 0.05
    assert "RMS error" in mirrorskin("score", "sphere-result.h5", "--truth", "sphere.h5", cwd=folder)


def test_a_result_tells_how_it_came_about(folder):
    result = io.open_result(folder / "sphere-result.h5")
    assert result.process["threshold"] == 0.5
    assert result.process["hold"] == 2
    assert result.process["subframe"] is True
    assert len(str(result.process["source_sha256"])) == 64
    assert result.x is not None
    assert result.x[1] - result.x[0] == pytest.approx(0.15)


def test_options_reach_the_engine(folder):
    words = ["--threshold", "0.3", "--hold", "1", "--no-subframe", "--memory", "100kB", "--device", "0"]
    told = json.loads(mirrorskin("reconstruct", "sphere.h5", "-o", "o.h5", *words, "--json", cwd=folder))
    process = told["process"]
    assert (process["threshold"], process["hold"], process["subframe"]) == (0.3, 1, False)
    assert told["summary"]["answered"] > 1000
    assert {record["name"] for record in told["profile"]} >= {"onset_scan", "onset_heights"}
    result = io.open_result(folder / "o.h5")
    heights = result.height[np.isfinite(result.height)]
    assert set(np.unique(heights)) <= set((-0.1 * np.arange(1, 31)).astype(np.float32))


def test_a_memory_limit_changes_nothing(folder):
    mirrorskin("reconstruct", "sphere.h5", "-o", "small.h5", "--memory", "20kB", cwd=folder)
    small, large = (io.open_result(folder / name) for name in ("small.h5", "sphere-result.h5"))
    np.testing.assert_array_equal(small.height, large.height)


def test_info_tells_what_a_file_holds(folder):
    assert "30 of 70 x 60, uint8" in mirrorskin("info", "sphere.h5", cwd=folder)
    assert json.loads(mirrorskin("info", "sphere-result.h5", "--json", cwd=folder))["kind"] == "result"


def test_devices_lists_what_there_is():
    listed = json.loads(mirrorskin("devices", "--json"))
    assert listed["devices"][listed["default"]]["name"] in mirrorskin("devices")


def test_the_demo_draws_its_figures(tmp_path):
    table = mirrorskin("demo", "-o", tmp_path / "demo")
    assert "sub-frame" in table
    made = {path.name for path in (tmp_path / "demo").iterdir()}
    things = ("sphere", "coin")
    assert made == {f"{thing}{ending}" for thing in things for ending in (".h5", ".png", "-result.h5")}


def test_the_benchmark_agrees_with_its_peers_before_it_times():
    cases = json.loads(mirrorskin("bench", "--quick", "--json"))["cases"]
    for rows in cases.values():
        assert {row["name"] for row in rows} >= {"read limit", "copy limit", "onset scan", "NumPy"}
        assert all(row["timing"]["median"] > 0 for row in rows)
