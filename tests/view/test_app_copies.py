"""Files saved by the application, and copied commands that compute the same numbers."""

import asyncio
import shlex
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from commands import done
from shown import ball
from stacks import record

from mirrorskin import io
from mirrorskin.cli.main import app as mirrorskin
from mirrorskin.cli.stack import stack_words
from mirrorskin.twin import Axial, Twin, Vertical
from mirrorskin.view.app.save import SavePane, files
from mirrorskin.view.app.session import Opening, Session
from mirrorskin.view.app.wording import as_command, as_python

SHAPE, PIXEL = (30, 36), 0.26
REGION = io.Region((2, 28), (4, 34))


@pytest.fixture
def press(tmp_path, monkeypatch):
    """A recording of a press, in a folder whose name has a space and a quote."""
    folder = tmp_path / "it's a press"
    folder.mkdir()
    monkeypatch.chdir(folder)
    twin = Twin(object="sphere", shape=SHAPE, pixel_size=PIXEL, movement=Vertical(0.1 * np.arange(12)))
    return record(twin, folder / "press.h5")


@pytest.fixture
def turn(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    movement = Axial(np.arange(8) * np.pi / 4, tilt=0.04, press=1.0)
    twin = Twin(object="sphere", shape=SHAPE, pixel_size=PIXEL, movement=movement, pattern="linear")
    return record(twin, tmp_path / "turn.h5")


def same(first, other):
    """Whether all maps of two results are equal."""
    assert {*first} == {*other}
    for name in first:
        np.testing.assert_array_equal(first[name], other[name], err_msg=name)


def by_command(text):
    words = shlex.split(text)
    assert words[0] == "mirrorskin"
    ended = CliRunner().invoke(mirrorskin, words[1:])
    assert ended.exit_code == 0, ended.output
    return io.open_result("result.h5")


def by_python(text):
    exec(compile(text, "copied", "exec"), {})
    return io.open_result("result.h5")


def changed(source, changes):
    """Return a session with chosen options, none of which is refused."""
    session = Session(source)
    for name, value in changes.items():
        session.choose(name, value)
    assert session.problem == ""
    return session


@pytest.fixture(params=[(as_command, by_command), (as_python, by_python)], ids=["command", "Python"])
def again(request):
    """Compute the result of a session again, from the text that it copies."""
    write, run = request.param
    return lambda session: run(write(session))


CHANGES = [
    {},
    {"threshold": 1 / 3},
    {"threshold": 0.4, "fill": False, "subframe": False, "hold": 1},
    {"noise": 2.5, "dark": 15.25, "travel_sigma": 0.001},
    {"thresholds": [0.3, 0.6], "inclinations": [0.1, 0.2]},
    {"dark": "dark.npy"},
    {"event": "onset", "blur": 0.0, "line_time": 1e-5},
    {"method": "change-point"},
]


@pytest.mark.parametrize("changes", CHANGES, ids=str)
def test_a_press_is_computed_again_with_the_same_numbers(press, changes, again):
    np.save("dark.npy", np.full(SHAPE, 17.25))
    session = changed(press, changes)
    same(session.now.result, again(session))


def test_a_part_of_a_press_is_computed_again(press, again):
    session = Session(press)
    session.choose_part(REGION, (1, None))
    same(session.now.result, again(session))


def test_options_of_a_stack_are_repeated_in_the_command(press, again):
    stack = {"travel_step": 0.2, "travel_start": 0.1, "pixel_size": (0.1, 0.2)}
    keywords = {"travel": io.Steps(0.2, 0.1), "pixel_size": (0.1, 0.2)}
    session = Session(press, Opening(keywords, stack_words(stack), device="0"))
    same(session.now.result, again(session))


@pytest.mark.parametrize("changes", [{"tilt": 0.0371}, {"tilt": "estimate"}, {"zenith_gain": 77.7}], ids=str)
def test_a_rotation_is_computed_again_with_the_same_numbers(turn, changes, again):
    session = changed(turn, changes)
    same(session.now.result, again(session))


def test_another_operation_is_computed_again(press, again):
    session = Session(press)
    session.choose_operation("mirrorskin.engine:Onset")
    session.choose("threshold", 0.35)
    same(session.now.result, again(session))


OWN = """
import numpy as np
from mirrorskin import engine, io

class Brightest(engine.Operation):
    least: float = engine.option(default=0.0, unit="counts", help="counts below which a pixel is 0")
    brightest = io.Map("largest brightness", "counts")
    def start(self, shape, dtype):
        self.most = np.zeros(shape)
    def push(self, frames):
        np.maximum(self.most, frames.max(axis=0), out=self.most)
    def result(self):
        return {"brightest": np.where(self.most < self.least, 0, self.most)}
"""


def test_an_operation_of_ones_own_is_computed_again(press, again):
    Path("own.py").write_text(OWN)
    session = Session(press, Opening(operation="own.py:Brightest"))
    session.choose("least", 100.5)
    same(session.now.result, again(session))


def test_a_result_is_saved_as_the_command_line_saves_it(press):
    session = Session(press)
    pane = SavePane(session)
    assert pane.download.filename == "press-result.h5"
    Path("saved.h5").write_bytes(pane.write())
    done("reconstruct press.h5 -o command.h5")
    same(io.open_result("saved.h5"), io.open_result("command.h5"))


@pytest.mark.parametrize("kind", [*files().values()], ids=str)
def test_every_format_is_exported_as_by_the_command(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    io.save_result(ball(), "ball.h5")
    pane = SavePane(Session(Path("ball.h5")))
    pane.format.value = kind
    written = pane.write()
    suffix, section = kind
    if suffix == ".h5":
        return
    command = "report" if suffix == ".html" else "export"
    done(command, "ball.h5", *(["--section", "apex"] if section else []), "-o", f"command{suffix}")
    assert abs(len(written) - Path(f"command{suffix}").stat().st_size) <= 100  # names and dates


def test_nothing_is_saved_for_options_without_a_result(press):
    session = Session(press)
    session.choose("event", "release")
    pane = SavePane(session)
    assert asyncio.run(pane._file()) is None
    assert "no result has been computed with these options" in pane.problem.object


def test_a_file_that_cannot_be_written_shows_the_reason(press):
    session = Session(press, Opening(operation="mirrorskin.engine:Onset"))
    session.now = type(session.now)(session.now.result.assign(height=None), "no heights")
    pane = SavePane(session)
    pane.format.value = (".ply", False)
    assert asyncio.run(pane._file()) is None
    assert "no heights" in pane.problem.object
