"""The settings of a batch: every key has an effect, and errors name their place."""

import math
import re
import tomllib
from pathlib import Path

import pytest

from mirrorskin import io
from mirrorskin.cli.settings import read_settings
from mirrorskin.engine.batch.jobs import Plan
from mirrorskin.io import Region

EVERYTHING = """
[stack]
dataset = "/entry/frames"
motion = "vertical"
travel-step = "0.1mm"
travel-start = "1cm"
phase-step = "45deg"
tilt = "2.5deg"
pixel-size = "0.03mm,40um"
region = "100,50,64x48"
frames = "10:200"
verify = false

[press]
event = "release"
method = "threshold"
threshold = 0.25
thresholds = [0.25]
inclinations = ["12deg"]
hold = 3
subframe = true
dark = 12
bright = 200.5
noise = 1.5
fill = false
modulus = "120kPa"

[rotation]
method = "paper"
tilt = "3deg"
zenith-gain = "5.7/deg"
zenith-offset = 10
noise = 2
per-turn = true
robust = true
heights = "ball.h5"

[slip]
contact = "press.h5"
per-frame = true
window-size = 12
window-step = 6
noise = 1.5
modulus = "0.2MPa"
"""


@pytest.fixture
def settings(tmp_path):
    """Read settings of a text, from a file that is called b.toml."""

    def read(text):
        (tmp_path / "b.toml").write_text(text, encoding="utf-8")
        return read_settings((tmp_path / "b.toml").relative_to(tmp_path), 1000)

    return read


def test_every_key_arrives_in_the_engine_s_words_and_units(settings):
    plan = settings(EVERYTHING)
    assert plan.opening == {
        "dataset": "/entry/frames",
        "motion": "vertical",
        "travel": io.Steps(0.1, 10.0),
        "phase": io.Steps(math.radians(45)),
        "tilt": pytest.approx(math.radians(2.5)),
        "pixel_size": (0.03, pytest.approx(0.04)),
        "region": Region(rows=(50, 98), columns=(100, 164)),
        "frames": (10, 200),
        "verify": False,
    }
    assert plan.press == {
        "event": "release",
        "method": "threshold",
        "threshold": 0.25,
        "thresholds": (0.25,),
        "inclinations": (pytest.approx(math.radians(12)),),
        "hold": 3,
        "subframe": True,
        "dark": 12.0,
        "bright": 200.5,
        "noise": 1.5,
        "fill": False,
        "modulus": 0.12,
    }
    assert plan.rotation == {
        "method": "paper",
        "tilt": pytest.approx(math.radians(3)),
        "zenith_gain": pytest.approx(5.7 * 180 / math.pi),
        "zenith_offset": 10.0,
        "noise": 2.0,
        "per_turn": True,
        "robust": True,
        "heights": Path("ball.h5"),
    }
    assert plan.slip == {
        "contact": Path("press.h5"),
        "per_frame": True,
        "window_size": 12,
        "window_step": 6,
        "noise": 1.5,
        "modulus": 0.2,
    }
    assert plan.memory_limit == 1000


def test_every_key_is_an_option_of_reconstruct_too(settings):
    from mirrorskin.cli.main import app

    command = app.commands["reconstruct"]
    options = {
        name.removeprefix("--")
        for parameter in command.params
        for name in (*parameter.opts, *parameter.secondary_opts)
    }
    assert set(re.findall(r"^([a-z-]+) =", EVERYTHING, re.MULTILINE)) <= options


def test_missing_settings_are_left_to_the_recordings(settings):
    assert settings("") == read_settings(None, 1000) == Plan(memory_limit=1000)
    assert settings("[press]\n[stack]\n") == Plan(memory_limit=1000)


def test_an_operation_replaces_the_methods(settings, tmp_path):
    plan = settings("[operation]\nclass = 'mirrorskin.engine:Onset'\nthreshold = 0.4\n[stack]\nframes = '2:'")
    options = {"threshold": 0.4}
    assert plan == Plan(
        {"frames": (2, None)},
        memory_limit=1000,
        operation="mirrorskin.engine:Onset",
        operation_options=options,
    )
    (tmp_path / "mine.py").write_text(WEAR)
    plan = settings("[operation]\nclass = 'mine.py:Wear'\ntravel-offset = '100um'\nangles = ['1deg', '2deg']")
    assert plan.operation == f"{tmp_path.resolve()}/mine.py:Wear", "workers may be in another folder"
    assert plan.operation_options == {
        "travel_offset": pytest.approx(0.1),
        "angles": pytest.approx([math.radians(1), math.radians(2)]),
    }


WEAR = """
from mirrorskin import engine

class Wear(engine.Operation):
    travel_offset: float = engine.option(default=0.0, unit="mm", help="added to each travel")
    angles: list[float] = engine.option(default=None, unit="rad", help="angles")
"""


def test_a_tilt_may_be_estimated(settings):
    assert settings('[rotation]\ntilt = "estimate"').rotation == {"tilt": "estimate"}


@pytest.mark.parametrize(
    ("table", "line", "message"),
    [
        ("stack", 'travel-start = "1mm"', "travel-start needs stack.travel-step: give both"),
        ("stack", 'pixel-size = "1mm,-1mm"', "pixel-size: a length above 0"),
        ("stack", 'tilt = "50deg"', "tilt: tilt 50 deg: above 0 and up to 30 deg"),
        ("rotation", 'tilt = "0deg"', "tilt 0 deg: above 0 and up to 30 deg is needed"),
        ("rotation", 'zenith-gain = "0/deg"', "zenith-gain 0.0: counts per radian other than 0"),
        (
            "rotation",
            'tilt = "estimate"\nheights = "ball.h5"',
            "heights register frames, which needs a tilt: give it",
        ),
        (
            "press",
            'method = "change-point"\nsubframe = false',
            "subframe is False, but a change-point lies between frames",
        ),
        ("press", 'method = "change-point"\nthreshold = 0', "threshold 0.0: a change-point needs a share"),
        ("press", 'method = "change-point"\nthreshold = 1', "threshold 1.0: a change-point needs a share"),
        ("press", 'method = "change-point"\nhold = 13', "hold 13: a change-point needs a number of frames"),
        (
            "press",
            'method = "change-point"\nthresholds = [0.5]\ninclinations = ["5deg"]',
            "thresholds and inclinations need method 'threshold'",
        ),
        ("press", "thresholds = [0.5]", "inclinations do not match: 1 thresholds and 0 inclinations. Give"),
        ("press", "thresholds = [0.5, 0.4]", "thresholds 0.5, 0.4: give them from the lowest"),
        ("press", "zenith-gain = 1", "zenith-gain is not known: there are method, threshold"),
        ("press", 'modulus = "-1MPa"', "modulus -1MPa: a pressure above 0 is needed"),
        ("stack", "travel_step = '1mm'", "travel_step is not known: did you mean travel-step?"),
    ],
)
def test_what_cannot_be_used_is_reported_with_file_table_and_key(settings, table, line, message):
    with pytest.raises(io.InputError) as refused:
        settings(f"[{table}]\n{line}\n")
    assert str(refused.value).startswith(f"b.toml: {table}.{message}")
    assert "\n" not in str(refused.value)


BAND = """
from mirrorskin import engine, io

class Band(engine.Operation):
    low: float = engine.option(default=0.0, unit="counts", help="lowest brightness")
    high: float = engine.option(default=1.0, unit="counts", help="highest brightness")

    def check_options(self):
        if self.low >= self.high:
            raise io.InputError("a band needs low below high")
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[presses]\n", "b.toml: presses is not known: did you mean press?"),
        ("press = 2\n", "b.toml: press is 2: write [press] alone in a line"),
        ("[press]\nhold = 1" + 5000 * "0", "b.toml is not TOML: Exceeds the limit"),
        (
            "[operation]\nthreshold = 0.5",
            "b.toml: operation.class: MODULE:CLASS or FILE.py:CLASS is needed; write",
        ),
        ("[operation]\nclass = 'none.py:A'", "b.toml: operation.class: "),
        (
            "[operation]\nclass = 'mirrorskin.engine:Onset'\ndepth = 1",
            "b.toml: operation.depth is not known: there are class, threshold",
        ),
        (
            "[operation]\nclass = 'mirrorskin.engine:ChangePoint'\nthreshold = 0",
            "b.toml: operation.threshold 0.0: a change-point needs a share",
        ),
        ("[operation]\nclass = 'mine.py:Band'\nlow = 2.0", "b.toml: operation: a band needs low below high"),
        (
            "[operation]\nclass = 'mirrorskin.engine:Onset'\n[press]\nhold = 2",
            "b.toml: press is not known: there are stack, operation",
        ),
    ],
)
def test_a_file_that_makes_no_sense_is_reported(settings, text, message):
    Path("mine.py").write_text(BAND)
    with pytest.raises(io.InputError) as refused:
        settings(text)
    assert str(refused.value).startswith(message)


def test_the_page_lists_the_keys_of_a_stack(settings):
    page = (Path(__file__).parents[2] / "docs" / "batch.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^### `\[stack\]`.*?\n(.*?)(?=^##)", page, re.MULTILINE | re.DOTALL)
    firsts = re.findall(r"^\| (`[^|]*`) \|", text, re.MULTILINE)
    listed = {name for first in firsts for name in re.findall("`([a-z-]+)`", first)}
    assert listed == {*tomllib.loads(EVERYTHING)["stack"], "travel"}
    example, operation = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert settings(example).press == {"method": "change-point", "fill": False}
    Path("mine.py").write_text(WEAR)
    assert settings(operation).operation_options == {"travel_offset": pytest.approx(0.1)}
