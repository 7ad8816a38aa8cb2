"""Which peers there are depends on the libraries that are installed."""

import sys

import pytest

from mirrorskin.bench import peers
from mirrorskin.bench.peers import load_peers


def test_a_peer_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    found, absent = load_peers("onset", ("numpy_", "numba_"))
    assert [peer.name for peer in found] == ["NumPy"]
    assert absent == {"numba": "not installed"}


def test_a_library_that_is_broken_is_not_taken_for_missing(monkeypatch, tmp_path):
    (tmp_path / "half_there.py").write_text("import what_it_needs", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(peers, "LIBRARIES", {"numba_": "half_there"})
    with pytest.raises(ModuleNotFoundError, match="what_it_needs"):
        load_peers("onset", ("numba_",))
