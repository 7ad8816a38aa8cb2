"""Options by annotation, and operations, steps and methods as plain values."""

import copy
import enum
import multiprocessing
import pickle
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from commands import done, refused
from installed_packages import install
from numpy.typing import ArrayLike, NDArray
from stacks import record, sphere

from mirrorskin import engine, io
from mirrorskin.cli.declared import term_of
from mirrorskin.cli.settings import read_settings
from mirrorskin.engine.base.options import Configured, option
from mirrorskin.engine.base.provenance import describe
from mirrorskin.engine.base.reconstruction import load_operation
from mirrorskin.engine.batch.cluster import run_cluster
from mirrorskin.engine.batch.jobs import Plan, make_jobs
from mirrorskin.io.base.own_class import OPERATIONS
from mirrorskin.kernels.device import open_device

MODULE = """
import enum
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin import engine, io


class Mode(enum.Enum):
    SUM = "sum"
    MEAN = 2


class Kinds(engine.Operation):
    '''Sum of the frames.'''

    count_of: int = engine.option(default=1, help="a whole number")
    level: float = engine.option(default=1.0, unit="counts", help="a number")
    fast: bool = engine.option(default=False, help="a flag")
    maybe: bool | None = engine.option(default=None, help="a flag or none")
    title: str = engine.option(default="light", help="free text")
    mode: Mode = engine.option(default=Mode.SUM, help="one of some")
    side: Literal["left", "right"] = engine.option(default="left", help="one of two")
    place: Path = engine.option(default=Path("here"), help="a path")
    numbers: Sequence[int] = engine.option(default=(1, 2), help="whole numbers")
    shares: list[float] = engine.option(default=[0.5], unit="share", help="numbers")
    pulse: float | Literal["estimate"] | None = engine.option(default=None, unit="Hz", help="or a word")
    dark: ArrayLike | None = engine.option(default=None, unit="counts", help="a map")

    total = io.Map("total")

    def start(self, shape, dtype):
        self.sum = np.zeros(shape)
    def push(self, frames):
        self.sum += sum(np.asarray(frame, float) for frame in frames)
    def result(self):
        return {"total": self.sum}
"""
WORDS = (
    "--count-of 3 --level 2.5 --fast --no-maybe --title any:text --mode MEAN --side right --place a/b"
    " --numbers 4,5 --shares 0.25,0.75 --pulse estimate"
)
SETTINGS = """
[operation]
class = "kinds_of_a_test.py:Kinds"
count-of = 3
level = 2.5
fast = true
maybe = false
title = "any:text"
mode = "MEAN"
side = "right"
place = "a/b"
numbers = [4, 5]
shares = [0.25, 0.75]
pulse = "estimate"
"""
EXPECTED = {
    "count_of": 3,
    "level": 2.5,
    "fast": True,
    "maybe": False,
    "title": "any:text",
    "mode": "MEAN",
    "side": "right",
    "numbers": (4, 5),
    "shares": (0.25, 0.75),
    "pulse": "estimate",
}


@pytest.fixture
def kinds(tmp_path, monkeypatch):
    """Return the class above, in a module that other processes can import."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "kinds_of_a_test.py").write_text(MODULE)
    sys.modules.pop("kinds_of_a_test", None)
    yield load_operation("kinds_of_a_test:Kinds")
    del sys.modules["kinds_of_a_test"]


def changed(kinds):
    dark = np.array([[1.0, np.nan], [-0.0, 4.0]])
    return kinds(**EXPECTED, place="a/b", dark=dark, device="cpu")


def test_annotations_decide_the_kinds(kinds):
    kind_of = {
        name: declared_option.kind
        for name, declared_option in kinds.options.items()
        if name not in ("device", "memory_limit")
    }
    assert kind_of == {
        "count_of": "integer",
        "level": "number",
        "fast": "flag",
        "maybe": "flag",
        "title": "text",
        "mode": "choice",
        "side": "choice",
        "place": "path",
        "numbers": "integers",
        "shares": "numbers",
        "pulse": "number",
        "dark": "map",
    }
    operation = changed(kinds)
    assert operation.mode is sys.modules["kinds_of_a_test"].Mode.MEAN
    assert kinds(mode=operation.mode) == kinds(mode="MEAN")
    assert (operation.place, operation.numbers, operation.maybe) == (Path("a/b"), (4, 5), False)
    written = describe(operation)
    assert (written["mode"], written["place"], written["numbers"]) == ("MEAN", "a/b", "[4, 5]")


def test_the_command_line_and_settings_have_the_kinds(kinds):
    record(sphere(), Path("press.h5"))
    done(f"run kinds_of_a_test:Kinds press.h5 -o total.h5 {WORDS}")
    process = io.open_result("total.h5").process
    plan = read_settings_of(SETTINGS)
    assert plan.operation_options == EXPECTED | {"place": Path("a/b")}
    for name, value in EXPECTED.items():
        assert process[name] == (str(list(value)) if isinstance(value, tuple) else value)
    assert process["place"] == "a/b"
    text = done("run kinds_of_a_test:Kinds --help").out
    for line in (
        "--mode [sum|MEAN]",
        "--title TEXT",
        "--place FILE",
        "--numbers N[,...]",
        "--pulse HZ|estimate",
    ):
        assert line in text
    refused("--numbers 4.5: a whole number is needed", "run kinds_of_a_test:Kinds press.h5 --numbers 4.5")


def read_settings_of(text):
    Path("b.toml").write_text(text)
    return read_settings(Path("b.toml"), 1000)


class Wall:
    """Some object."""


class Light(enum.Enum):
    RED = "red"
    BLUE = "blue"


@pytest.mark.parametrize(
    ("annotation", "default", "line"),
    [
        (int, 1.5, "1.5: a whole number is needed"),
        ("int", "2", "'2': a whole number is needed"),
        (float, "2", "'2': a number is needed"),
        (bool, 1, "1: use True or False"),
        (bool | None, "yes", "'yes': use True or False"),
        (str, 2, "2: a text is needed"),
        (Light, "green", "unknown light 'green'. Use red or blue"),
        (Literal["a", "b"], "c", "unknown light 'c'. Use a or b"),
        (Path, 3, "3: a path is needed"),
        (Sequence[int], (1, 2.5), "2.5: a whole number is needed"),
        (list[float], ["a"], "'a': a number is needed"),
        (tuple[float, float], (1.0,), "2 numbers are needed"),
        (ArrayLike, "no.npy", "no.npy"),
        (NDArray[Any], object(), "numbers are needed"),
        (Wall, 3, "3: a Wall is needed"),
    ],
)
def test_a_bad_default_is_refused_where_the_class_is_defined(annotation, default, line):
    body = {"light": option(default=default, help="light"), "__annotations__": {"light": annotation}}
    with pytest.raises(io.InputError, match=f"^Own: .*{line}") as caught:
        type("Own", (Configured,), body | {"__module__": __name__})
    assert "\n" not in str(caught.value)

    class Base(Configured):
        light: annotation = option(default=None, help="light")

    with pytest.raises(io.InputError, match=f"^Own: .*{line}"):
        type("Own", (Base,), {"light": default})


def test_an_option_needs_an_annotation_that_can_be_evaluated():
    with pytest.raises(io.InputError, match="Own: option light has no type: annotate it"):
        type("Own", (Configured,), {"light": option(default=1, help="light")})
    body = {"light": option(default=1, help="light"), "__annotations__": {"light": "Lihgt"}}
    with pytest.raises(io.InputError, match="Own: the annotation Lihgt cannot be evaluated: name 'Lihgt'"):
        type("Own", (Configured,), body | {"__module__": __name__})


def test_annotations_may_be_texts_with_names_of_a_function():
    class Mine(enum.Enum):
        ONE = 1

    class Own(Configured):
        mine: "Mine" = option(default="ONE", help="mine")

    assert Own().mine is Mine.ONE


def test_an_object_of_a_class_is_for_python_only():
    class Own(Configured):
        wall: Wall | None = option(default=None, help="wall")

    assert Own.options["wall"].python_only
    wall = Wall()
    assert Own(wall=wall).wall is wall
    assert Own(wall=wall) == Own(wall=wall)


def test_a_default_of_a_misspelt_option_is_refused():
    with pytest.raises(io.InputError, match=r"^Early has no option treshold: did you mean threshold\?$"):
        type("Early", (engine.Onset,), {"treshold": 0.3})


def test_defaults_are_written_as_on_the_command_line():
    class Own(Configured):
        light: Light = option(default=Light.BLUE, help="light")
        angles: Sequence[float] = option(default=[np.pi], unit="rad", help="angles")

    assert [term_of(declared).shown_default for declared in Own.options.values()] == ["blue", "180deg"]


def test_equal_options_make_equal_operations(kinds):
    first, other = changed(kinds), changed(kinds)
    assert first == other
    assert hash(first) == hash(other)
    assert len({first, other, kinds()}) == 2
    assert first != first.with_options(dark=np.ones((2, 2)))
    assert first != first.with_options(level=3.0)
    assert engine.Onset() != engine.ChangePoint()
    assert engine.Press(hold=3) == engine.Press(hold=3)


def test_the_representation_evaluates():
    for operation in (
        engine.Onset(),
        engine.Press(thresholds=[0.25, 0.75], inclinations=[0.1, 0.2], device="cpu"),
    ):
        assert eval(repr(operation), vars(engine)) == operation
    with_arrays = engine.Onset(dark=np.zeros((2, 2)), bright=np.full((30, 40), 9.0))
    assert repr(with_arrays) == "Onset(dark=[[0.0, 0.0], [0.0, 0.0]], bright=<float64 (30, 40)>)"
    assert repr(engine.Onset(device=open_device("cpu"))).startswith("Onset(device=")


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda original: pickle.loads(pickle.dumps(original))]
)
def test_copies_are_equal(kinds, copied):
    operation = changed(kinds)
    engine.run(np.ones((3, 2, 2), np.uint8), operation)
    assert copied(operation) == operation
    device = open_device("cpu")
    devices = copied(engine.Onset(device=[device]))
    assert devices.devices == [device]
    local = type("Local", (engine.Onset,), {})
    assert copy.deepcopy(local()) == copy.copy(local()) == local()


def answer(operation, frames):
    """Run an operation in another process."""
    return operation, operation.__dask_tokenize__(), engine.run(frames, operation).maps()


@pytest.mark.parametrize("name", ["kinds_of_a_test:Kinds", "kinds_of_a_test.py:Kinds"])
def test_an_operation_runs_in_a_spawned_process(kinds, name):
    operation = changed(load_operation(name))
    frames = np.arange(12, dtype=np.uint8).reshape(3, 2, 2)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        other, token, maps = pool.apply(answer, (operation, frames))
    assert other == operation
    assert token == operation.__dask_tokenize__() != operation.with_options(level=3.0).__dask_tokenize__()
    np.testing.assert_array_equal(maps["total"], engine.run(frames, operation)["total"])


def test_dask_has_the_same_token_for_equal_operations(kinds):
    base = pytest.importorskip("dask.base")
    assert base.tokenize(changed(kinds)) == base.tokenize(changed(kinds))
    assert base.tokenize(changed(kinds)) != base.tokenize(kinds())


def test_a_class_that_another_process_cannot_import_is_refused(tmp_path):
    local = type("Local", (engine.Onset,), {"__qualname__": "maker.<locals>.Local", "__module__": __name__})
    line = r"^Local is defined in a function: another process cannot import it\. Move it to a module$"
    with pytest.raises(io.InputError, match=line):
        pickle.dumps(local())
    job = make_jobs([tmp_path / "press.h5"], tmp_path)
    with pytest.raises(io.InputError, match=line):
        next(run_cluster(job, Plan(operation=local), "tcp://127.0.0.1:1"))
    program = (
        "import pickle\nfrom mirrorskin import engine\nclass Own(engine.Onset): pass\npickle.dumps(Own())"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "InputError: Own is defined in __main__: another process cannot import it" in ended.stderr


def test_a_plan_takes_the_class_or_its_name(kinds):
    plan = Plan(operation=kinds)
    assert plan.kind("vertical") is kinds
    named = plan.for_other_processes()
    assert named.operation == "kinds_of_a_test:Kinds"
    assert plan.key("vertical") == named.key("vertical")
    assert load_operation(kinds) is kinds


@pytest.fixture
def installed(kinds, tmp_path):
    """An installed package that gives a name to an operation."""
    install(tmp_path, OPERATIONS, **{"sum-of-kinds": "kinds_of_a_test:Kinds"})
    return kinds


def test_an_installed_operation_has_a_name(installed):
    record(sphere(), Path("press.h5"))
    assert load_operation("sum-of-kinds") is installed
    done("run sum-of-kinds press.h5 -o total.h5 --level 2")
    assert io.open_result("total.h5").process["level"] == 2.0
    for command in ("run sum-of-kinds", "live vertical --operation sum-of-kinds"):
        assert "--count-of" in done(f"{command} --help").out
    plan = read_settings_of("[operation]\nclass = 'sum-of-kinds'\nlevel = 2.0\n")
    assert (plan.kind("vertical"), plan.operation_options) == (installed, {"level": 2.0})
    refused("sum-of-kind: did you mean sum-of-kinds?", "run sum-of-kind press.h5")
