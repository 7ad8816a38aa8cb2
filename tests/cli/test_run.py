"""An estimator of the user's own, from the command line."""

import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import run
from stacks import record, sphere

from mirrorskin import engine, io

ROOT = Path(__file__).parents[2]
MINE = """
import numpy as np
from mirrorskin.io import Header

class Light:
    def __init__(self, shape, dtype, level=100):
        self.shape, self.level = shape, level
    def reset(self):
        self.count = np.zeros(self.shape, np.int64)
    def push(self, frames):
        self.count += (frames > self.level).sum(axis=0)
    def result(self):
        return {"light": self.count}

class Broken:
    pass

some = 3
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("mine_of_a_test.py").write_text(MINE)
    Path("lost_of_a_test.py").write_text("import no_such_module_at_all\n")
    record(sphere(), Path("press.h5"))


@pytest.mark.parametrize("place", ["mine_of_a_test", "mine_of_a_test.py"])
def test_the_maps_are_written_and_told_in_a_line(place):
    ended = run("run", f"{place}:Light", "press.h5", "--set", "level=50", "--memory", "100B")
    source = sphere()
    frames = source.read(np.empty(source.shape, source.dtype)).frames
    light = (frames > 50).sum(axis=0)
    span = f"from {light.min():.3f} to {light.max():.3f}"
    assert (ended.code, ended.said) == (0, "")
    assert ended.out == f"press-Light.h5: light at 35 of 35 pixels, {span}\n"
    np.testing.assert_array_equal(io.open_result("press-Light.h5")["light"], light)


def test_files_of_one_name_are_two_modules():
    for folder, kind in (("a", "One"), ("b", "Two")):
        Path(folder).mkdir()
        Path(folder, "mine.py").write_text(MINE.replace("class Light", f"class {kind}"))
        assert run("run", f"{folder}/mine.py:{kind}", "press.h5", "--set", "level=50").code == 0


def test_region_frames_and_travel_are_those_of_reconstruct():
    example = ROOT / "examples" / "steepest_rise.py"
    chosen = ("--region", "1,1,4x3", "--frames", "1:7", "--travel-step", "0.2mm")
    ended = run("run", f"{example}:SteepestRise", "press.h5", *chosen, "-o", "out.h5", "--json")
    assert ended.code == 0, ended.said
    assert json.loads(ended.out)["process"]["source_frames"] == "1:7"
    own = runpy.run_path(str(example))["SteepestRise"]
    region = io.Region.read("1,1,4x3")
    with io.open_recording("press.h5", region=region, frames=(1, 7), travel=io.Steps(0.2)) as source:
        expected = engine.run(source, own)
    np.testing.assert_array_equal(io.open_result("out.h5").height, expected.height)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("Light", "Light: name a class as MODULE:CLASS or FILE.py:CLASS"),
        ("nowhere_of_a_test:Light", "there is no nowhere_of_a_test in "),
        ("nowhere_of_a_test.sub:Light", "there is no nowhere_of_a_test.sub in "),
        ("none_of_a_test.py:Light", "there is no none_of_a_test.py in "),
        ("mine_of_a_test:Dark", "there is no class Dark in mine_of_a_test; it has Light, Broken"),
        ("mine_of_a_test:some", "there is no class some in mine_of_a_test"),
        ("mine_of_a_test:Broken", "Broken(shape, dtype) cannot be made"),
    ],
)
def test_a_class_that_cannot_be_had_is_one_line(name, line):
    ended = run("run", name, "press.h5")
    assert ended.code == 2
    assert line in ended.said
    assert len(ended.said.splitlines()) == 1
    assert not list(Path().glob("press-*"))


@pytest.mark.parametrize(
    ("setting", "line"),
    [("level", "--set level: NAME=VALUE is needed"), ("depth=1", "unexpected keyword argument 'depth'")],
)
def test_a_parameter_that_is_none_is_one_line(setting, line):
    ended = run("run", "mine_of_a_test:Light", "press.h5", "--set", setting)
    assert ended.code == 2
    assert line in ended.said


def test_what_a_module_itself_lacks_is_not_hidden():
    with pytest.raises(ModuleNotFoundError, match="no_such_module_at_all"):
        run("run", "lost_of_a_test:Light", "press.h5")


def test_what_the_page_says_runs():
    page = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    own, code, declared, with_kernel = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    Path("light.py").write_text(own)
    Path("light_on_device.py").write_text(with_kernel)
    for line in "".join(re.findall(r"^```sh\n(.*?)^```", page, re.DOTALL | re.MULTILINE)).splitlines():
        words = line.partition(" #")[0].replace("device=gpu", "device=cpu").split()[1:]
        if not {"live", "--live"} & {*words}:  # tests/cli/test_live.py
            ended = run(*words)
            assert ended.code == 0, ended.said
    known = {}
    exec(own + code + declared, known)
    assert known["result"]["light"].any()
    assert known["Wear"].maps["wear"].quantity == "height"
