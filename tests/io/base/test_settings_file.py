import os
from typing import Annotated, Literal

import msgspec
import pytest
from msgspec import Meta

from mirrorskin import io
from mirrorskin.io.base.settings_file import load_toml

Length = Annotated[float, Meta(gt=0, description="a length above 0, in mm,", examples=[0.5])]


class Axis(msgspec.Struct, frozen=True):
    limits: Annotated[tuple[float, float], Meta(description="two numbers", examples=[[-1, 1]])] = (0.0, 1.0)
    direction: Literal[1, -1] = 1

    def __post_init__(self):
        if not self.limits[0] < self.limits[1]:
            raise ValueError("limits are out of order: write [least, greatest]")


class Stage(msgspec.Struct, frozen=True, rename="kebab"):
    press_depth: Length
    home: bool = True
    lean: Axis | None = None


class Rig(msgspec.Struct, frozen=True):
    stage: Stage
    size: Annotated[Length | tuple[Length, Length], Meta(description="one or two lengths", examples=[1])] = 3


def load(tmp_path, text):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return load_toml(path, Rig, "write it anew")


def test_missing_keys_have_their_defaults(tmp_path):
    assert load(tmp_path, "[stage]\npress-depth = 2") == Rig(Stage(2.0))
    assert load(tmp_path, "size=[1, 2]\n[stage]\npress-depth = 2").size == (1.0, 2.0)
    lean = load(tmp_path, "[stage]\npress-depth = 2\n[stage.lean]\nlimits = [1, 2]").stage.lean
    assert lean == Axis((1.0, 2.0))


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("", "stage is missing: add table [stage]"),
        ("[stage]", "stage.press-depth is missing: add press-depth = 0.5 in [stage]"),
        ("stage = 3", "stage is 3: write [stage] alone in a line, and its keys below"),
        ("[stage]\npress_depth = 2", "stage.press_depth is not known: did you mean press-depth?"),
        ("[stage]\nx = 2", "stage.x is not known: there are press-depth, home, lean"),
        (
            "[stage]\npress-depth = 0",
            "stage.press-depth is 0: a length above 0, in mm, is needed; write e.g. press-depth = 0.5",
        ),
        ("[stage]\npress-depth = nan", "stage.press-depth is nan: a length above 0"),
        ("[stage]\npress-depth = true", "stage.press-depth is true: a length above 0"),
        (f"[stage]\npress-depth = 1{'0' * 400}", "a length above 0"),
        (
            "[stage]\npress-depth = 1\nhome = 1",
            "stage.home is 1: one of true, false is needed; write e.g. home = true",
        ),
        (
            "[stage]\npress-depth = 1\n[stage.lean]\ndirection = 2",
            "stage.lean.direction is 2: one of 1, -1 is needed",
        ),
        (
            "[stage]\npress-depth = 1\n[stage.lean]\nlimits = [2, 1]",
            "[stage.lean] limits are out of order: write [least, greatest]",
        ),
        ("size = [1, 2, 3]\n[stage]\npress-depth = 1", "size is [1, 2, 3]: one or two lengths is needed"),
        ("[stage", "is not TOML: "),
    ],
)
def test_a_message_names_file_key_and_remedy(tmp_path, text, answer):
    with pytest.raises(io.InputError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "rig.toml"))
    assert "\n" not in message
    assert answer in message


def test_a_file_that_is_not_text_or_missing(tmp_path):
    path = tmp_path / "rig.toml"
    with pytest.raises(io.InputError, match=r"cannot be read: .*; write it anew"):
        load_toml(path, Rig, "write it anew")
    path.write_bytes(b"press = \xff")
    with pytest.raises(io.InputError, match=r"is not text in UTF-8: .*; write it anew"):
        load_toml(path, Rig, "write it anew")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_is_not_part_of_the_text(tmp_path, encoding):
    path = tmp_path / "rig.toml"
    path.write_text("[stage]\npress-depth = 2", encoding=encoding)
    assert load_toml(path, Rig, "write it anew").stage.press_depth == 2.0


def test_a_decimal_comma_is_named(tmp_path):
    with pytest.raises(io.InputError, match=r"line 2: 0,5: write the number with a decimal point, 0\.5"):
        load(tmp_path, "[stage]\npress-depth = 0,5  # mm\n")


def test_a_pipe_without_a_writer_is_refused(tmp_path):
    os.mkfifo(tmp_path / "rig.toml")
    with pytest.raises(io.InputError, match="is not a regular file: save its contents in one first"):
        load_toml(tmp_path / "rig.toml", Rig, "write it anew")
