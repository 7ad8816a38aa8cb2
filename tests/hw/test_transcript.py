"""The emulated controller answers as GRBL's own firmware did when the transcript was made."""

import re
from pathlib import Path

import pytest
from firmware import PROGRAM, Firmware
from transcript import REST, SETTINGS, play, read

from mirrorskin.hw.emulator.port import GrblMachine

FIRMWARE = read(Path(__file__).with_name("grbl-1.1h.txt"))
LATE = 0.2  # seconds: between looks at whether it rests, and of a program on a busy computer


def emulated():
    """Play the requests by a clock of their own."""
    now = 0.0

    def sleep(seconds):
        nonlocal now
        now += seconds

    return list(play(GrblMachine(SETTINGS, clock=lambda: now), lambda: now, sleep))


@pytest.fixture(scope="module", params=["emulator", *(["firmware"] if PROGRAM else [])])
def answered(request, tmp_path_factory):
    if request.param == "emulator":
        return emulated()
    with Firmware(PROGRAM, tmp_path_factory.mktemp("grbl"), SETTINGS) as firmware:
        return list(play(firmware))


def statuses(exchange):
    """The states of reports, and where they say that it is."""
    found = (re.match(r"<([^|>]*)\|MPos:([-\d.,]+)", line) for line in exchange.said)
    return [(one[1], [float(value) for value in one[2].split(",")]) for one in found if one]


def words(exchange):
    """What it said, without reports, settings, and the year of its build."""
    return [re.sub(r"(VER:\S+?)\..*", r"\1", line) for line in exchange.said if line[0] not in "<$"]


def test_it_says_the_same(answered):
    assert [(one.sent, words(one)) for one in answered] == [(one.sent, words(one)) for one in FIRMWARE]


def test_it_reports_the_same_states_and_places(answered):
    for ours, theirs in zip(answered, FIRMWARE, strict=True):
        for (state, place), (expected, where) in zip(statuses(ours), statuses(theirs), strict=True):
            moved = 0.5 if (state, ours.sent) != ("Idle", REST) else 1e-3  # until it was stopped
            assert (ours.sent, state) == (theirs.sent, expected)
            assert place == pytest.approx(where, abs=moved)


def test_its_settings_have_the_same_values(answered):
    ours, theirs = (
        {number: float(value) for line in one for number, value in re.findall(r"^\$(\d+)=([-\d.]+)", line)}
        for one in (answered[2].said, FIRMWARE[2].said)
    )
    assert len(ours) >= 20
    assert ours == {number: theirs[number] for number in ours}


def test_moves_take_as_long(answered):
    for last, exchange in enumerate(FIRMWARE):
        if exchange.sent == REST:
            both = slice(last - 1, last + 1)  # the line of an arc is answered late, as its pieces find room
            ours, theirs = (sum(one.seconds for one in played[both]) for played in (answered, FIRMWARE))
            assert ours == pytest.approx(theirs, abs=LATE)
