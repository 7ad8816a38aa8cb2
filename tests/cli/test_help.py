"""`mirrorskin --help`: quick, without importing commands, and consistent with their own help."""

import ast
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from commands import done, loaded, refused, run

from mirrorskin.cli.main import PURPOSES, app, main

HEAVY = (
    "bokeh",
    "cv2",
    "h5py",
    "jinja2",
    "matplotlib",
    "numpy",
    "panel",
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
    process = subprocess.run([sys.executable, "-c", MADE], capture_output=True, text=True, check=True)
    count, *heavy = process.stdout.split()
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
        ["app", "no.h5"],
        ["measure", "no.h5"],
        ["simulate", "vertical", "--object", "no.stl", "-o", "a.h5"],
    ],
)
def test_a_file_that_is_not_there_is_reported_before_anything_heavy_is_imported(words):
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
    place = "mirrorskin.cli.commands"
    others = {f"{place}.{name}" for name in PURPOSES} - {f"{place}.reconstruct"}
    assert not loaded("reconstruct", "--help") & others


def test_help_lists_the_purpose_of_each_command(commands):
    assert list(commands) == list(PURPOSES)
    for name, purpose in PURPOSES.items():
        assert commands[name].name == name
        assert purpose.endswith(".")
        assert " ".join(commands[name].help.split()).startswith(purpose[:-1])


@pytest.mark.parametrize("group", [(), ("calibrate",), ("rig",), ("twin",)])
def test_the_help_of_a_group_cuts_nothing_short(group, commands):
    text = " ".join(run(*group, "--help").out.partition("\nCommands:\n")[2].split())
    purposes = (
        {name: command.help.split("\n\n")[0] for name, command in commands[group[0]].commands.items()}
        if group
        else PURPOSES
    )
    assert text == " ".join(f"{name} {purpose}" for name, purpose in purposes.items())


@pytest.mark.parametrize("name", PURPOSES)
def test_every_command_has_a_help_of_its_own(name):
    ended = done(name, "--help")
    assert PURPOSES[name][:-1].split()[0] in ended.out
    assert f"mirrorskin {name} " in ended.out or f"{name} [OPTIONS]" in ended.out


def test_a_name_that_is_misspelt_is_answered_with_the_one_that_was_meant():
    refused("'reconstruct'", "reconstuct")


def test_an_unknown_name_is_refused():
    refused("No such command 'import_'", "import_")


@pytest.mark.parametrize("group", ["calibrate", "rig", "twin"])
def test_a_group_alone_shows_its_help_as_it_is(group):
    ended = run(group)
    assert ended.code == 2
    assert ended.said == run(group, "--help").out


def test_a_closed_pipe_ends_a_command_without_a_traceback():
    command = [sys.executable, "-m", "mirrorskin.cli.main", "devices"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait() == 1


# Shell completion


@pytest.fixture
def ask(monkeypatch, capsys):
    """Answer an instruction of a shell: the exit code and what is printed."""

    def answer(instruction, **variables):
        for name, value in {"_MIRRORSKIN_COMPLETE": instruction, **variables}.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(sys, "argv", ["mirrorskin"])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, *capsys.readouterr()

    return answer


@pytest.fixture
def complete(ask):
    """Complete a command line as bash does, and return the answers, each as "type,value"."""

    def answers(line):
        code, out, errors = ask("bash_complete", COMP_WORDS=line, COMP_CWORD=str(line.count(" ")))
        assert (code, errors) == (0, "")
        return out.split()

    return answers


@pytest.mark.parametrize(
    ("line", "answers"),
    [
        ("mirrorskin re", ["plain,reconstruct", "plain,report"]),
        ("mirrorskin --ver", ["plain,--version"]),
        ("mirrorskin calibrate ze", ["plain,zenith"]),
        ("mirrorskin twin ", ["plain,serve"]),
        ("mirrorskin reconstruct --travel-st", ["plain,--travel-step", "plain,--travel-start"]),
        ("mirrorskin twin serve --ready", []),  # hidden
        ("mirrorskin sample p", ["plain,press", "plain,pictures"]),
        ("mirrorskin import frames --motion ver", ["plain,vertical"]),
        ("mirrorskin reconstruct pre", ["file,pre"]),
        ("mirrorskin score missing.h5 --truth pre", ["file,pre"]),
        ("mirrorskin reconstruct missing.h5 -o pre", ["file,pre"]),
        ("mirrorskin simulate vertical --object ba", ["file,ba"]),
        ("mirrorskin reconstruct missing.h5 --travel-step ", []),
    ],
)
def test_a_command_line_is_completed(line, answers, complete):
    assert sorted(complete(line)) == sorted(answers)


def test_every_command_is_offered(complete):
    assert complete("mirrorskin ") == [f"plain,{name}" for name in PURPOSES]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_gets_its_script(shell, ask):
    code, out, _ = ask(f"{shell}_source")
    assert code == 0
    assert f"_MIRRORSKIN_COMPLETE={shell}_complete" in out


def test_the_script_of_bash_completes_in_bash(tmp_path):
    program = tmp_path / "mirrorskin"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -P -m mirrorskin.cli.main "$@"\n')
    program.chmod(0o755)
    line = (
        f'eval "$(_MIRRORSKIN_COMPLETE=bash_source {program})"; COMP_WORDS=(mirrorskin sco) COMP_CWORD=1;'
        f' $(complete -p mirrorskin | sed "s/.*-F \\([^ ]*\\) .*/\\1/") {program}; echo "${{COMPREPLY[@]}}"'
    )
    process = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert process.stdout == "score\n"


def test_another_instruction_is_refused(ask):
    code, _, errors = ask("bash")
    assert (code, errors.count("\n")) == (2, 1)
    assert "bash_source" in errors


def test_completion_of_a_command_imports_no_command():
    asked = {"_MIRRORSKIN_COMPLETE": "bash_complete", "COMP_WORDS": "mirrorskin re", "COMP_CWORD": "1"}
    ours = {name for name in loaded(**asked) if name.startswith("mirrorskin.")}
    assert ours == {"mirrorskin.cli", "mirrorskin.cli.groups", "mirrorskin.cli.main"}


@pytest.mark.parametrize("name", ["reconstruct", "twin serve", "sample"])
def test_completion_of_an_option_imports_nothing_heavy(name):
    words = f"mirrorskin {name} -"
    asked = {"_MIRRORSKIN_COMPLETE": "bash_complete", "COMP_WORDS": words}
    assert not loaded(**asked, COMP_CWORD=str(words.count(" "))) & set(HEAVY)


# What help, messages and docstrings refer to


def test_no_text_of_the_product_names_a_file_of_the_documentation():
    root = Path(__file__).parents[2]
    names = [
        f"{path.relative_to(root)}:{node.lineno}"
        for package in ("cli", "engine", "hw", "io", "kernels", "view")
        for path in (root / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and "docs/" in node.value
    ]
    assert names == []  # an installed wheel has no docs
