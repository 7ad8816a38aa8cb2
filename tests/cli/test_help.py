"""`mirrorskin --help`: quick, as no command is needed for it, and true to what commands say themselves."""

import json
import subprocess
import sys
from importlib.metadata import version

import pytest
from commands import run

from mirrorskin.cli.main import PURPOSES, app

LOADED = """
import contextlib, io, json, sys
from mirrorskin.cli.main import main
sys.argv = ["mirrorskin", *sys.argv[1:]]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main()
print(json.dumps(list(sys.modules)))
"""


def loaded(*words):
    """Return which modules a command needs."""
    done = subprocess.run([sys.executable, "-c", LOADED, *words], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


HEAVY = (
    "cv2",
    "h5py",
    "jinja2",
    "matplotlib",
    "numpy",
    "pint",
    "pyopencl",
    "rerun",
    "rich",
    "scipy",
    "trimesh",
)

MADE = f"""
import sys
from mirrorskin.cli.main import app
made = list(app.commands.values())
for command in made:
    made += getattr(command, "commands", {{}}).values()
print(len(made), *[name for name in {HEAVY} if name in sys.modules])
"""


def test_no_command_needs_anything_heavy_before_it_runs():
    done = subprocess.run([sys.executable, "-c", MADE], capture_output=True, text=True, check=True)
    count, *heavy = done.stdout.split()
    assert int(count) > len(PURPOSES)
    assert not heavy


@pytest.mark.parametrize(
    "words",
    [
        ["--version"],
        ["reconstruct", "no.h5"],
        ["fuse", "no.h5", "no.h5"],
        ["import", "no.avi", "--motion", "vertical", "-o", "a.h5"],
        ["capture", "vertical", "--rig", "no.toml", "-o", "a.h5"],
        ["measure", "no.h5"],
        ["simulate", "vertical", "--object", "no.stl", "-o", "a.h5"],
    ],
)
def test_a_file_that_is_not_there_is_told_before_anything_heavy_is_imported(words):
    assert not loaded(*words) & set(HEAVY)


def test_the_version_is_that_of_the_package():
    assert run("--version").out == f"mirrorskin {version('mirrorskin')}\n"


@pytest.fixture(scope="module")
def commands():
    return app.commands


def test_help_needs_no_command():
    ours = {name for name in loaded("--help") if name.startswith("mirrorskin.")}
    assert ours == {"mirrorskin.cli", "mirrorskin.cli.groups", "mirrorskin.cli.main"}


def test_a_command_s_help_needs_no_other():
    others = {f"mirrorskin.cli.{name}" for name in PURPOSES} - {"mirrorskin.cli.reconstruct"}
    assert not loaded("reconstruct", "--help") & others


def test_help_says_of_each_command_what_its_own_help_begins_with(commands):
    assert list(commands) == list(PURPOSES)
    for name, purpose in PURPOSES.items():
        assert commands[name].name == name
        assert purpose.endswith(".")
        assert " ".join(commands[name].help.split()).startswith(purpose[:-1])


@pytest.mark.parametrize("group", [(), ("calibrate",), ("rig",), ("twin",), ("bench",)])
def test_the_help_of_a_group_cuts_nothing_short(group, commands):
    said = " ".join(run(*group, "--help").out.partition("\nCommands:\n")[2].split())
    own = (
        {name: one.help.split("\n\n")[0] for name, one in commands[group[0]].commands.items()}
        if group
        else PURPOSES
    )
    assert said == " ".join(f"{name} {purpose}" for name, purpose in own.items())


@pytest.mark.parametrize("name", PURPOSES)
def test_every_command_has_a_help_of_its_own(name):
    ended = run(name, "--help")
    assert ended.code == 0
    assert PURPOSES[name][:-1].split()[0] in ended.out
    assert f"mirrorskin {name} " in ended.out or f"{name} [OPTIONS]" in ended.out


def test_a_name_that_is_misspelt_is_answered_with_the_one_that_was_meant():
    ended = run("reconstuct")
    assert ended.code == 2
    assert "'reconstruct'" in ended.said
    assert len(ended.said.splitlines()) == 1


def test_a_name_that_nobody_knows_is_refused():
    ended = run("import_")
    assert ended.code == 2
    assert "No such command 'import_'" in ended.said


@pytest.mark.parametrize("group", ["calibrate", "rig", "twin"])
def test_a_group_alone_shows_its_help_as_it_is(group):
    ended = run(group)
    assert ended.code == 2
    assert ended.said == run(group, "--help").out


def test_a_closed_pipe_ends_a_command_without_a_traceback():
    command = [sys.executable, "-m", "mirrorskin.cli.main", "bench", "--list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait() == 1
