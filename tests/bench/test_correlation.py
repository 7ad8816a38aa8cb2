"""Correlations are compared before they are timed."""

import numpy as np
import pytest

from mirrorskin.bench import correlation, run_suite
from mirrorskin.bench.peers.correlation import Peer, numpy_
from mirrorskin.bench.same import DisagreementError
from mirrorskin.kernels.errors import DeviceError


@pytest.mark.parametrize("word", ["mean", "cosine", "sine", "residual"])
def test_a_peer_that_differs_is_named_and_nothing_is_timed(device, monkeypatch, word):
    def correlate(frames, phase):
        found = numpy_.correlate(frames, phase)
        getattr(found, word)[3, 5] += 0.01
        return found

    timed = []
    peers = [Peer("Odd one", correlate, numpy_.slide)]
    monkeypatch.setattr(correlation, "find_peers", lambda: (peers, {}))
    monkeypatch.setattr("mirrorskin.bench.harness._measured", lambda *given: timed.append(given))
    with pytest.raises(
        DisagreementError, match=f"Odd one differs from mirrorskin in the {word} of 1 of 3072"
    ):
        run_suite(device, ["correlate-uint8"], quick=True)
    assert not timed


def test_a_window_that_forgets_nothing_is_named_and_nothing_is_timed(device, monkeypatch):
    def slide(sums, now, gone, basis):
        numpy_.slide(sums, now, np.zeros_like(gone), basis)

    timed = []
    peers = [Peer("Odd one", numpy_.correlate, slide)]
    monkeypatch.setattr(correlation, "find_peers", lambda: (peers, {}))
    monkeypatch.setattr("mirrorskin.bench.harness._measured", lambda *given: timed.append(given))
    with pytest.raises(
        DisagreementError, match="Odd one differs from mirrorskin in the mean of 3072 of 3072"
    ):
        run_suite(device, ["sliding"], quick=True)
    assert not timed


def test_a_device_without_room_for_the_stack_is_refused(small_device):
    small_device.max_allocation = 16 * 48 * 64 - 1
    with pytest.raises(DeviceError, match="has no room for 16 frames at once"):
        run_suite(small_device, ["correlate-uint8"], quick=True)
