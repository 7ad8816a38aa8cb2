"""The emulated controller answers like GRBL's own firmware, and the driver knows grblHAL's answers."""

import re
from pathlib import Path

import pytest
from firmware import PROGRAM, Firmware, is_hal
from scripted_grbl import ScriptedGrbl
from transcript import REST, SETTINGS, play, read

from mirrorskin.hw.base.rig_file import TwistAxis
from mirrorskin.hw.stages.replies import parse
from mirrorskin.io import InputError
from mirrorskin.twin.emulator.port import GrblMachine
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

GRBL, HAL = (read(Path(__file__).with_name(name)) for name in ("grbl-1.1h.txt", "grblhal-1.1f.txt"))
FIRMWARE = HAL if is_hal(PROGRAM) else GRBL
LATE = 0.2  # seconds: between looks at whether it rests, and of a program on a busy computer


def emulated():
    """Play the requests on simulated time."""
    clock = SimulatedClock()
    return list(play(GrblMachine(SETTINGS, clock=clock), clock))


@pytest.fixture(scope="module", params=["emulator", *(["firmware"] if PROGRAM else [])])
def both(request, tmp_path_factory):
    """What one answers, and what it should."""
    if request.param == "emulator":
        return emulated(), GRBL
    with Firmware(PROGRAM, tmp_path_factory.mktemp("grbl"), SETTINGS) as firmware:
        return list(play(firmware)), FIRMWARE


def statuses(exchange):
    """The states of reports, and where they say that it is."""
    match = (re.match(r"<([^|>]*)\|MPos:([-\d.,]+)", line) for line in exchange.said)
    return [(result[1], [float(value) for value in result[2].split(",")]) for result in match if result]


def words(exchange):
    """What it said, without reports, settings, and the year of its build."""
    return [re.sub(r"(VER:\S+?)\..*", r"\1", line) for line in exchange.said if line[0] not in "<$"]


def test_the_emulator_gives_the_same_replies(both):
    ours, theirs = ([(exchange.sent, words(exchange)) for exchange in played] for played in both)
    assert ours == theirs


def test_it_reports_the_same_states_and_places(both):
    for ours, theirs in zip(*both, strict=True):
        for (state, place), (expected, where) in zip(statuses(ours), statuses(theirs), strict=True):
            moved = 0.5 if (state, ours.sent) != ("Idle", REST) else 1e-3  # until it was stopped
            assert (ours.sent, state) == (theirs.sent, expected)
            assert place == pytest.approx(where, abs=moved)


def test_its_settings_have_the_same_values(both):
    ours, theirs = (
        {number: float(value) for line in lines for number, value in re.findall(r"^\$(\d+)=([-\d.]+)", line)}
        for lines in (played[2].said for played in both)
    )
    assert len(ours) >= 20
    assert ours == {number: theirs[number] for number in ours}


def test_moves_take_as_long(both):
    for last, exchange in enumerate(both[1]):
        if exchange.sent == REST:
            two = slice(last - 1, last + 1)  # the line of an arc is answered late, as its pieces find room
            ours, theirs = (sum(exchange.seconds for exchange in played[two]) for played in both)
            assert ours == pytest.approx(theirs, abs=LATE)


@pytest.mark.parametrize("played", [GRBL, HAL])
def test_the_driver_reads_every_line(played):
    assert [line for item in played for line in item.said if parse(line.encode()) is None] == []


@pytest.fixture
def hal(opened, clock):
    """Open a controller that tells of itself what grblHAL does."""

    def open_hal(settings=(), **answers):
        text = {
            exchange.sent: "\r\n".join(exchange.said) for exchange in HAL if exchange.sent in ("$I", "$$")
        }
        return opened(ScriptedGrbl(clock, answers=text | answers), **dict(settings))[0]

    return open_hal


def test_the_driver_supports_grblhal(hal):
    stage = hal()
    assert stage.firmware == "grblHAL 1.1f.20260817"
    assert stage.parameters[110] == 1200


def test_axes_that_grblhal_calls_otherwise_are_missed(hal):
    text = "[VER:1.1f.20260817:]\r\n[AXS:6:XYZUVW]\r\n[FIRMWARE:grblHAL]\r\nok"
    with pytest.raises(InputError, match="no axis C"):
        hal({"twist": TwistAxis(letter="C", limits=(-9, 9), speed=9.0)}, **{"$I": text})


def test_feeds_of_linear_axes_alone_are_refused(hal):
    with pytest.raises(InputError, match=r"set \$701=0"):
        hal(**{"$$": "$701=1\r\nok"})
