"""Operations, built-in and a user's own, from the command line."""

import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import done, refused, run
from stacks import MadeUp, assert_same, record, sphere

from mirrorskin import engine, io
from mirrorskin.engine.base.reconstruction import load_operation

ROOT = Path(__file__).parents[2]
MINE = """
from typing import Literal

import numpy as np
from mirrorskin import engine
from mirrorskin.io import Map

class Light(engine.Operation):
    '''Frames in which a pixel is light.'''

    level: float = engine.option(default=100.0, unit="counts", help="counts above which a pixel is light")
    light = Map("frames in which a pixel is light")

    def start(self, shape, dtype):
        self.number = np.zeros(shape, np.int64)
    def push(self, frames):
        self.number += (frames > self.level).sum(axis=0)
    def result(self):
        return {"light": self.number}

class Deep(Light):
    travel_offset: float = engine.option(default=0.0, unit="mm", help="added to each travel")
    tilt: float | Literal["estimate"] | None = engine.option(
        default=None, unit="rad", help="tilt", shown_default="no"
    )
    weights: list[float] = engine.option(default=None, unit="share", within=(0, 1), help="some shares")
    twice: bool = engine.option(default=False, help="count each frame twice")

    @property
    def passes(self):
        return 2 if self.twice else 1

class Frames(Light):
    frames: int = engine.option(default=1, help="frames")

class Own(Light):
    json: float = engine.option(default=1.0, unit="mm", help="a length")

class Step(Light):
    travel_step: float = engine.option(default=0.0, unit="mm", help="a length")

class Broken:
    pass

some = 3
"""


@pytest.fixture(autouse=True)
def folder(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("mine_of_a_test.py").write_text(MINE)
    Path("lost_of_a_test.py").write_text("import no_such_module_at_all\n")
    record(sphere(), Path("press.h5"))


@pytest.mark.parametrize("place", ["mine_of_a_test", "mine_of_a_test.py"])
def test_the_maps_are_written_and_printed_in_a_line(place):
    ended = run("run", f"{place}:Light", "press.h5", "--level", "50", "--memory", "100B")
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
        Path(folder, "mine.py").write_text(MINE.replace("Light", kind))
        assert run("run", f"{folder}/mine.py:{kind}", "press.h5", "--level", "50").code == 0


@pytest.mark.parametrize("text", ["5mm", "5counts", "1e1 µm"])
def test_counts_are_written_without_a_unit(text):
    refused(
        f"--level {text}: a number of counts is needed, without a unit",
        "run mine_of_a_test:Light press.h5 --level",
        text,
    )


def test_region_frames_and_travel_are_those_of_reconstruct():
    example = ROOT / "examples" / "steepest_rise.py"
    chosen = ("--region", "1,1,4x3", "--frames", "1:7", "--travel-step", "0.2mm")
    ended = done("run", f"{example}:SteepestRise", "press.h5", *chosen, "-o", "out.h5", "--json")
    assert json.loads(ended.out)["process"]["source_frames"] == "1:7"
    operation = runpy.run_path(str(example))["SteepestRise"]
    region = io.Region.read("1,1,4x3")
    with io.open_recording("press.h5", region=region, frames=(1, 7), travel=io.Steps(0.2)) as source:
        expected = engine.run(source, operation)
    np.testing.assert_array_equal(io.open_result("out.h5").height, expected.height)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("Light", "Light: name a class as MODULE:CLASS or FILE.py:CLASS"),
        ("nowhere_of_a_test:Light", "there is no nowhere_of_a_test in "),
        ("nowhere_of_a_test.sub:Light", "there is no nowhere_of_a_test.sub in "),
        ("none_of_a_test.py:Light", "there is no none_of_a_test.py in "),
        (
            "mine_of_a_test:Dark",
            "mine_of_a_test has no class Dark: it has Light, Deep, Frames, Own, Step, Broken",
        ),
        ("mine_of_a_test:some", "mine_of_a_test has no class some: it has"),
        (
            "mine_of_a_test:Broken",
            "Broken is not an operation: derive the class from mirrorskin.engine.Operation",
        ),
        ("mine_of_a_test:Own", "has an option json, and so has 'mirrorskin run' for something else"),
        ("mine_of_a_test:Step", "has an option travel_step, and so has 'mirrorskin run' for something else"),
        (
            "mirrorskin.engine:Onst",
            "mirrorskin.engine:Onst: mirrorskin.engine has no class Onst: did you mean Onset?",
        ),
        (
            "mine_of_a_test:Frames",
            "has an option frames, and so has 'mirrorskin run' for something else. Rename that of the class",
        ),
    ],
)
def test_a_class_that_cannot_be_had_is_one_line(name, line):
    refused(line, "run", name, "press.h5")
    assert not list(Path().glob("press-*"))


DEEP = ("run", "mine_of_a_test:Deep", "press.h5")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--level"], "Option '--level' requires an argument"),
        (
            ["--depth", "1"],
            "mine_of_a_test:Deep has no option --depth: it has --travel-offset, --tilt, --weights,"
            " --twice, --level",
        ),
        (["--levl", "1"], "mine_of_a_test:Deep has no option --levl: did you mean --level?"),
        (["--level", "high"], "--level high: a number is needed; write e.g. 0.25"),
        (["--level", "nan"], "level nan: a number in counts is needed"),
        (["--travel-offset", "0.1"], "--travel-offset 0.1: a unit is needed; write e.g. 0.1mm"),
        (["--travel-offset", "2deg"], "--travel-offset 2deg: degrees are not a length"),
        (["--tilt", "guess"], "--tilt guess: a number and a unit are needed"),
        (["--weights", "0.1,2"], "weights 2.0: a share from 0 to 1 is needed"),
        (["--device", "abacus"], "abacus"),
    ],
)
def test_an_option_that_cannot_be_used_is_one_line(words, line):
    refused(line, *DEEP, *words)
    assert not list(Path().glob("press-*"))


def test_declared_options_arrive_in_their_unit_and_in_the_process():
    words = ["--travel-offset", "100um", "--tilt", "2.5deg", "--weights", "0.25,0.5", "--weights", "1"]
    ended = done(*DEEP, *words, "--twice", "--json")
    process = json.loads(ended.out)["process"]
    assert process["operation"] == "Deep"
    assert (process["travel_offset"], process["level"]) == (pytest.approx(0.1), 100.0)
    assert (process["tilt"], process["weights"]) == (pytest.approx(np.radians(2.5)), "[0.25, 0.5, 1.0]")
    assert process["twice"] is True
    assert (
        json.loads(run(*DEEP, "--tilt", "estimate", "--json", "--overwrite").out)["process"]["tilt"]
        == "estimate"
    )


@pytest.mark.parametrize("words", ["--help", "press.h5 --help"])
def test_help_shows_the_options_of_the_class(words):
    ended = run(f"run mine_of_a_test.py:Deep {words}")
    assert (ended.code, ended.said) == (0, "")
    text = " ".join(ended.out.split())
    assert "--travel-offset LENGTH Added to each travel. [default: 0mm]" in text
    assert "--tilt ANGLE|estimate Tilt. [default: no]" in text
    assert "--weights SHARE[,...] Some shares." in text
    assert "--twice / --no-twice Count each frame twice. [default: no-twice]" in text
    assert "--level COUNTS Counts above which a pixel is light. [default: 100]" in text


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Return a small recording of each motion."""
    folder = tmp_path_factory.mktemp("recordings")
    small = ("--size", "32x24", "--pixel-size", "0.2mm")
    words = {
        "press": ["vertical", "--frames", "8", "--travel-step", "0.2mm"],
        "turn": ["axial", "--pattern", "linear"],
        "slide": ["horizontal", "--frames", "6", "--texture", "dots", "--texture-size", "0.5mm"],
    }
    for name, words_of in words.items():
        done("simulate", *words_of, *small, "-o", folder / f"{name}.h5")
    return folder


BUILT_IN = {
    "Onset": ("press", {"threshold": 0.4}),
    "ChangePoint": ("press", {"hold": 1}),
    "press:Strokes": ("press", {"subframe": False}),
    "Press": ("press", {"threshold": 0.4}),
    "Correlate": ("turn", {"harmonic": 1}),
    "Normals": ("turn", {"method": "paper"}),
    "rotation.rotation:Rotation": ("turn", {"robust": True}),
    "slip:SlipOnset": ("slide", {"window_size": 10}),
    "Slide": ("slide", {"per_frame": True}),
}


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_operations_and_methods_run_as_in_python(name, recordings):
    motion, options = BUILT_IN[name]
    place, _, kind = name.rpartition(":")
    module = f"mirrorskin.engine.{place}" if place else "mirrorskin.engine"
    words = [
        f"{'--no-' if value is False else '--'}{name.replace('_', '-')}" for name, value in options.items()
    ]
    words += [str(value) for value in options.values() if not isinstance(value, bool)]
    path = recordings / f"{motion}.h5"
    done("run", f"{module}:{kind}", path, *words, "-o", "out.h5", "--overwrite")
    operation = load_operation(f"{module}:{kind}")(**options)
    with io.open_recording(path) as source:
        expected = (
            operation.run(source) if isinstance(operation, engine.Method) else engine.run(source, operation)
        )
    result = io.open_result("out.h5")
    for option, value in options.items():
        assert result.process.get(option, value) == value
    assert_same(result.assign(process={}), expected.assign(process={}))


def test_what_a_module_itself_lacks_is_not_hidden():
    with pytest.raises(ModuleNotFoundError, match="no_such_module_at_all"):
        run("run lost_of_a_test:Light press.h5")


def test_the_code_of_the_page_runs():
    page = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    first, code, configured, loop, steps, declared, with_units, on_a_device, with_kernel = blocks
    Path("light.py").write_text(first)
    Path("first_light.py").write_text(with_kernel)
    for line in "".join(re.findall(r"^```sh\n(.*?)^```", page, re.DOTALL | re.MULTILINE)).splitlines():
        words = line.partition(" #")[0].replace("device=gpu", "device=cpu").split()[1:]
        if not {"live", "--live"} & {*words}:  # tests/cli/test_live.py
            done(*words)
    namespace = {}
    exec(first + code + configured + loop + steps + declared + with_units + on_a_device, namespace)
    assert namespace["result"]["light"].any()
    np.testing.assert_array_equal(namespace["again"].height, namespace["onset"].height)
    assert namespace["edges"].shape == namespace["surface"].height.shape
    assert namespace["Wear"].maps["wear"].quantity == "height"
    assert namespace["run"].result()["light"].tolist() == np.full((48, 64), 2).tolist()
    in_percent = engine.run(np.full((4, 2, 3), 120, np.uint8), namespace["LightInPercent"])
    assert in_percent["share"].tolist() == [[100.0] * 3] * 2
    header = io.Header("vertical", dark=np.full((2, 3), 60, np.float32))
    frames = 10 * np.arange(24, dtype=np.uint8).reshape(4, 2, 3)
    for chosen, level in ({}, 60), ({"dark": 10}, 10):
        above = engine.run(MadeUp(frames, header), namespace["LightAboveDark"](level=50, **chosen))
        np.testing.assert_array_equal(above["light"], (frames > 50 + level).sum(axis=0))
