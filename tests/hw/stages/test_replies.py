from __future__ import annotations

import random

import pytest

from mirrorskin.hw.stages.replies import (
    Alarm,
    Banner,
    Message,
    Ok,
    Refusal,
    Setting,
    Status,
    parse,
    salvage,
)

PLACE = {"X": 1.5, "Y": -2.0, "Z": 0.25}


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        (b"ok", Ok()),
        (b" ok\r", Ok()),
        (b"error:20", Refusal(20)),
        (b"ALARM:1", Alarm(1)),
        (b"$110=500.000", Setting(110, "500.000")),
        (b"$13=0 (report inches, bool)", Setting(13, "0")),
        (b"[MSG:Caution: Unlocked]", Message("MSG:Caution: Unlocked")),
        (b"[OPT:V,15,128]", Message("OPT:V,15,128")),
        (b">G54:ok", Message(">G54:ok")),
        (b"<Idle|MPos:1.500,-2.000,0.250|FS:0,0>", Status("idle", machine=PLACE)),
        (b"<Hold:1|WPos:1.5,-2,.25|Bf:15,128>", Status("hold", 1, work=PLACE)),
        (b"<Run|MPos:1.5,-2,0.25|WCO:1.5,-2,0.25>", Status("run", machine=PLACE, offset=PLACE)),
    ],
)
def test_each_reply_is_read(line, reply):
    assert parse(line) == reply


@pytest.mark.parametrize(
    ("line", "version"),
    [
        (b"Grbl 1.1h ['$' for help]", (1, 1)),
        (b"Grbl 0.9j ['$' for help]", (0, 9)),
        (b"GrblHAL 1.1f ['$' or '$HELP' for help]", (1, 1)),
        (b"Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]", (3, 7)),
    ],
)
def test_the_banner_contains_the_version(line, version):
    banner = parse(line)
    assert isinstance(banner, Banner)
    assert banner.version == version


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"o",
        b"okay",
        b"error",
        b"error:",
        b"<Idle|MPos:1,2,3",
        b"<Idle|MPos:1,2>",
        b"<Idle|MPos:1,2,x>",
        b"<Idle|MPos:1,2,nan>",
        b"<Idle|MPos:1,2,inf>",
        b"<Idle>",
        b"<Idle|MPos:1,2,3|WPos:1,2,3>",
        b"<Odd|MPos:1,2,3>",
        b"<Idle,MPos:0.000,0.000,0.000,WPos:0.000,0.000,0.000>",
        b"[MSG:half",
        b"\xff\xfe",
        b"$x=1",
    ],
)
def test_lines_of_no_controller_are_ignored(line):
    assert parse(line) is None


def test_random_bytes_raise_nothing_and_hardly_ever_mean_anything():
    lines = random.Random(1).randbytes(100_000).split(b"\n")
    assert sum(parse(line) is not None for line in lines) == 0
    assert sum(salvage(line)[0] is not None for line in lines) == 0


@pytest.mark.parametrize(
    ("line", "reply", "noise"),
    [
        (b"<Idle|MPos:1.5ok", Ok(), 14),
        (b"<Idle|MP<Idle|MPos:1.5,-2,.25>", Status("idle", machine=PLACE), 8),
        (b"\xffALARM:2", Alarm(2), 1),
        (b"nothing at all", None, 14),
    ],
)
def test_a_reply_behind_half_a_line_is_saved(line, reply, noise):
    assert parse(line) is None
    assert salvage(line) == (reply, noise)


@pytest.mark.parametrize(
    ("state", "detail", "rests"),
    [
        ("idle", None, True),
        ("run", None, False),
        ("jog", None, False),
        ("home", None, False),
        ("hold", 0, True),
        ("hold", 1, False),
        ("hold", None, True),
        ("door", 0, True),
        ("door", 1, True),
        ("door", 2, False),
        ("door", 3, False),
        ("alarm", None, True),
    ],
)
def test_a_hold_rests_once_it_is_complete(state, detail, rests):
    assert Status(state, detail).rests == rests


def test_common_codes_have_words_and_all_have_their_number():
    assert "limit switch" in str(Alarm(1))
    assert "reset in motion" in str(Alarm(3))
    assert "locked" in str(Refusal(9))
    assert "error:77" in str(Refusal(77))
    assert "ALARM:77" in str(Alarm(77))
