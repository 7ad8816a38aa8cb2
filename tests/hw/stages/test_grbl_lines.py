from __future__ import annotations

import time

from hypothesis import given
from hypothesis import strategies as st

from mirrorskin.hw.stages.replies import AHEAD, LONGEST, Noise, Splitter, Window

TEXT = st.binary(max_size=40).map(lambda text: text.replace(b"\n", b"").replace(b"\r", b""))


@given(st.lists(TEXT, max_size=12), st.lists(st.integers(1, 30), max_size=40))
def test_lines_are_the_same_however_they_arrive(lines, cuts):
    data = b"".join(line + b"\r\n" for line in lines)
    splitter, actual = Splitter(), []
    for part in cuts:
        actual += splitter.feed(data[:part], 0.0)
        data = data[part:]
    actual += splitter.feed(data, 0.0)
    assert [line for line, _ in actual] == [line for line in lines if line]


def test_a_line_is_as_old_as_its_first_byte():
    splitter = Splitter()
    assert splitter.feed(b"a\nb", 1.0) == [(b"a", 1.0)]
    assert splitter.feed(b"c", 2.0) == []
    assert splitter.feed(b"\nd\n", 3.0) == [(b"bc", 1.0), (b"d", 3.0)]


def test_a_line_without_an_end_does_not_fill_the_memory():
    splitter = Splitter()
    pieces = [line for k in range(50) for line, _ in splitter.feed(b"x" * 100, k)]
    assert len(b"".join(pieces)) >= 5000 - LONGEST - 100
    assert max(map(len, pieces)) <= LONGEST + 100


def test_noise_is_borne_until_it_is_too_much_within_a_second():
    noise = Noise()
    assert not any(noise.add(200, float(second)) for second in range(0, 100, 2))
    assert noise.total == 10_000
    assert noise.add(100, 98.5)


def test_a_flood_of_noise_is_counted_as_quickly_as_it_comes():
    noise, begun = Noise(), time.process_time()
    assert all(noise.add(1, 0.0) == (k >= 256) for k in range(30_000))
    assert time.process_time() - begun < 10  # quadratic work would take minutes


@given(
    st.integers(20, 200),
    st.lists(st.one_of(st.none(), st.text("GXYZ0123456789", max_size=19)), max_size=80),
)
def test_no_byte_more_than_the_buffer_holds_is_ever_sent(size, events):
    window, buffer, taken, given_in = Window(size), [], [], []
    for event in events:
        if event is None and buffer:
            taken.append(buffer.pop(0))
            assert window.answer() == taken[-1].decode().strip()
        elif event is not None:
            number = window.add(event)
            given_in.append(event.encode() + b"\n")
            assert number == len(given_in)
        while (line := window.next(0.0)) is not None:
            buffer.append(line)
            assert sum(map(len, buffer)) <= size
        waiting = given_in[len(taken) + len(buffer) :]
        assert not waiting or sum(map(len, buffer)) + len(waiting[0]) > size
    assert [*taken, *buffer] == given_in[: len(taken) + len(buffer)]
    assert window.done == len(taken)


def test_a_reset_forgets_all_lines():
    window = Window(8)
    first, second = window.add("abc"), window.add("defghi")
    window.next(0.0)
    window.clear()
    assert not window.busy
    assert window.done < first < second
    assert window.next(0.0) is None


def test_no_motion_is_sent_far_ahead_of_when_it_is_due():
    window, sent, now = Window(), 0, 100.0
    for _ in range(20):
        window.add("G1", 0.25)
    while window.busy:
        while window.next(now) is not None:
            window.answer()
            sent += 1
            begun = now - 100.0
            assert 0.25 * sent - begun <= AHEAD + 0.25
        assert 0.25 * sent - (now - 100.0) > AHEAD or sent == 20, "there is always enough in store"
        now += 0.01
    assert sent == 20


def test_after_a_pause_no_more_is_sent_than_before():
    window = Window()
    for _ in range(20):
        window.add("G1", 0.25)
    counts = []
    for now in (100.0, 200.0):
        counts.append(0)
        while window.next(now) is not None:
            counts[-1] += 1
    assert counts == [3, 3]


def test_a_fast_motion_has_enough_in_store_to_slow_down():
    window, count = Window(), 0
    for _ in range(20):
        window.add("G1", 0.25, ramp=2.0)
    while window.next(100.0) is not None:
        count += 1
    assert AHEAD + 1.0 < 0.25 * count <= AHEAD + 1.25
