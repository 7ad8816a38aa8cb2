"""Normals are compared before they are timed; what is said of the limits."""

from dataclasses import replace

import numpy as np
import pytest

from mirrorskin.bench import normals, run_suite
from mirrorskin.bench.harness import Measured, Timing
from mirrorskin.bench.peers.normals import Peer, numpy_
from mirrorskin.bench.peers.normals.odd import answer
from mirrorskin.bench.results import Row
from mirrorskin.bench.same import DisagreementError, check_normals
from mirrorskin.bench.turns import fill
from mirrorskin.engine import estimate_normals

CASE = normals.NormalsCase("normals-uint8", (48, 64), np.dtype(np.uint8))


@pytest.mark.parametrize(
    ("word", "change"),
    [("contact", 1), ("vectors", 1e-3), ("sigma", 1e-4), ("mean", 0.01), ("vectors", np.nan)],
)
def test_a_peer_that_differs_is_named_and_nothing_is_timed(device, monkeypatch, word, change):
    def spoil(frames, turn):
        found = numpy_.normals(frames, turn)
        values = getattr(found, word)
        values[13, 9] = values[13, 9] ^ change if word == "contact" else values[13, 9] + change
        return found

    timed = []
    monkeypatch.setattr(normals, "find_peers", lambda: ([Peer("Odd one", spoil)], {}))
    monkeypatch.setattr("mirrorskin.bench.harness._measured", lambda *given: timed.append(given))
    with pytest.raises(
        DisagreementError, match=f"Odd one differs from mirrorskin in the {word} of 1 of 3072"
    ):
        run_suite(device, ["normals-uint8"], quick=True)
    assert not timed


def test_contact_may_differ_where_it_is_in_doubt(device):
    frames = np.empty((8, *CASE.shape), np.uint8)
    fill(frames)
    turn = replace(CASE.turn, noise=0.4)  # so little that many are near the limit
    pixels = np.arange(CASE.pixels)
    wide, narrow = (answer(frames, turn, pixels, slack).contact for slack in (1.01, 0.99))
    doubtful, sure = (np.flatnonzero(chosen)[0] for chosen in (wide != narrow, wide & narrow))
    known = {"tilt": turn.tilt, "gain": turn.gain, "offset": turn.offset}
    ours = estimate_normals(frames, turn.phase, **known, noise=turn.noise, device=device)
    theirs = numpy_.normals(frames, turn)
    check_normals("peer", ours, theirs, frames, turn)
    theirs.contact.flat[doubtful] = 1 - ours.contact.flat[doubtful]
    check_normals("peer", ours, theirs, frames, turn)
    theirs.contact.flat[sure] ^= 1
    with pytest.raises(DisagreementError, match="in the contact of 1 of 3072"):
        check_normals("peer", ours, theirs, frames, turn)


@pytest.mark.parametrize(("cached", "binds", "share"), [(0.5, "memory", 50), (4.0, "arithmetic", 80)])
def test_it_is_said_which_limit_binds(cached, binds, share):
    def row(name, seconds, operations=0):
        timing = Timing(seconds, seconds, seconds, 1)
        measured = Measured(timing, {"kernel": timing}, {}, 0.0, 0.0)
        return Row(name, measured, CASE.bytes, operations=operations)

    ours = 2.0 if binds == "memory" else 5.0
    rows = [row("triad limit", 1.0), row("mirrorskin, in the cache", cached), row("mirrorskin", ours)]
    rows.append(row("multiply-add limit", 2.0, operations=8 * 10**9))
    notes = normals._notes(CASE, {one.name: one for one in rows})
    assert notes[0].startswith("29 bytes a pixel: ")
    assert notes[1] == f"{binds} binds: the kernel reaches {share} % of that limit"
    assert notes[2].startswith("at most 4 G multiply-adds/s: ")
