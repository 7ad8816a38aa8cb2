"""Every declared option refuses what it cannot use in a line that names it and has an example that works.

The cases are generated from the options of all commands, and from the tables of a batch's settings.
"""

from __future__ import annotations

import re

import click
import pytest
from click.core import ParameterSource

from mirrorskin.cli.declared import DeclaredOption
from mirrorskin.cli.groups import MOTIONS, MotionOption, refuse_foreign
from mirrorskin.cli.main import app
from mirrorskin.cli.settings import read_settings
from mirrorskin.cli.stack import STACK
from mirrorskin.engine.base.reconstruction import method_for
from mirrorskin.engine.batch.jobs import TABLES
from mirrorskin.io import InputError


def all_commands(group, names=()):
    """Yield the names and the commands of a group, and of the groups in it."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from all_commands(command, (*names, name))
        else:
            yield " ".join((*names, name)), command


COMMANDS = dict(all_commands(app))
TERMS = [
    pytest.param(parameter._term, id=f"{name} {parameter.opts[0]}")
    for name, command in COMMANDS.items()
    for parameter in command.params
    if isinstance(parameter, DeclaredOption)
]
NUMBERS = ("number", "numbers", "integer", "integers", "map")
UNITS = ("mm", "rad", "MPa", "N", "s", "counts/rad", "mm/N", "mm,mm")
OTHER_UNIT = {"rad": "5mm", "counts/rad": "5/mm"}  # 5deg is none of the others


def wrong_texts(term):
    """Return texts that are no value of an option."""
    texts = ["fast", "1 mm mm", "5,5,", "0x1"]
    if term.unit in UNITS:
        texts += ["5", OTHER_UNIT.get(term.unit, "5deg"), "1foo"]
    elif term.unit in ("region", "range", "WxH"):
        texts += ["5", "0x0", "-1:-5"]
    else:
        texts += ["5mm"]
    if term.kind.startswith("integer"):
        texts.append("2.5")
    if term.least is not None:
        texts.append(str(term.least - 1))
    if term.most is not None:
        texts.append(str(term.most + 1))
    return texts


@pytest.mark.parametrize("term", [param for param in TERMS if param.values[0].kind in NUMBERS])
def test_a_wrong_value_is_refused_with_an_example_that_works(term):
    for text in wrong_texts(term):
        with pytest.raises(InputError) as refused:
            term.read(text, term.flag)
        message = str(refused.value)
        assert message.startswith(term.flag)
        assert "\n" not in message
        for example in re.findall(r"; write e\.g\. (\S+?),?(?: or |$)", message):
            term.read(example, term.flag)
        assert all(word in message for word in term.words) or term.unit in ("region", "range")


@pytest.mark.parametrize("name", COMMANDS)
def test_an_unknown_choice_is_refused(name):
    for parameter in COMMANDS[name].params:
        if isinstance(parameter.type, click.Choice):
            with pytest.raises(click.UsageError, match="is not one of") as refused:
                parameter.type_cast_value(click.Context(COMMANDS[name]), "teapot")
            assert "'teapot'" in str(refused.value)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("name", COMMANDS)
def test_an_option_of_another_motion_is_refused(name, motion):
    for parameter in COMMANDS[name].params:
        if not isinstance(parameter, MotionOption):
            continue
        context = click.Context(COMMANDS[name])
        context.set_parameter_source(parameter.name, ParameterSource.COMMANDLINE)
        if not parameter.motions or motion in parameter.motions:
            refuse_foreign(context, motion, "a.h5")
        else:
            with pytest.raises(InputError, match=rf"^{parameter.opts[0]} applies to .+ only; a.h5 is a "):
                refuse_foreign(context, motion, "a.h5")


STACK_KEYS = [term for term in STACK.without("dataset", "channel", "phases", "travel").terms if term.unit]


@pytest.mark.parametrize("term", STACK_KEYS, ids=lambda term: term.name)
def test_a_wrong_setting_of_a_stack_is_refused_with_file_table_and_key(tmp_path, term):
    path = tmp_path / "b.toml"
    for value in ["5", "true", *(f'"{text}"' for text in wrong_texts(term))]:
        path.write_text(f"[stack]\n{term.flag[2:]} = {value}\n")
        with pytest.raises(InputError) as refused:
            read_settings(path, 1000)
        assert str(refused.value).startswith(f"{path}: stack.{term.flag[2:]}"), value
        assert "\n" not in str(refused.value)


METHODS = {table: method_for(motion) for motion, table in TABLES.items()}
KEYS = [
    pytest.param(table, option, id=f"{table}.{option.name}")
    for table, method in METHODS.items()
    for option in method.options.values()
    if not option.python_only
]


TOGETHER = {"thresholds": 'inclinations = ["5deg"]', "inclinations": "thresholds = [0.3]"}  # both are needed


def wrong_values(option):
    """Return values in TOML that are none of an option."""
    if option.kind == "flag":
        return ["1", '"yes"']
    if option.kind == "choice":
        return ['"teapot"', "1"]
    if option.kind in ("file", "path"):
        return ["1", "true"]
    values = ["true", "{}"]
    if option.kind in ("numbers", "integers"):
        return [*values, "1", '["fast"]', "[true]"]
    values += ['"fast"', "[1]"]
    if option.kind == "integer":
        values.append("2.5")
    if option.unit in UNITS:
        return [*values, "5", f'"{OTHER_UNIT.get(option.unit, "5deg")}"']
    low, high = option.within
    values += [str(bound) for bound in (None if low is None else low - 1, option.above) if bound is not None]
    return [
        *values,
        *([] if high is None else [str(high + 1)]),
        *(["nan"] if option.kind == "number" else []),
    ]


@pytest.mark.parametrize(("table", "option"), KEYS)
def test_a_wrong_setting_is_refused_with_file_table_key_and_an_example_that_works(tmp_path, table, option):
    key, path = option.name.replace("_", "-"), tmp_path / "b.toml"
    for value in wrong_values(option):
        path.write_text(f"[{table}]\n{key} = {value}\n")
        with pytest.raises(InputError) as refused:
            read_settings(path, 1000)
        message = str(refused.value)
        assert message.startswith(f"{path}: {table}.{key}"), value
        assert "\n" not in message
        if option.unit not in UNITS and not option.words and option.kind in NUMBERS and option.kind != "map":
            assert f"{key} is " in message, "refused by the table, before the class"
        for example in re.findall(rf"; write e\.g\. {key} = (\S+)$", message):
            path.write_text(f"[{table}]\n{key} = {example}\n{TOGETHER.get(key, '')}\n")
            assert option.name in getattr(read_settings(path, 1000), table)
