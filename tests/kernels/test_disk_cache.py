"""The contents of the user's cache folder."""

import logging

import pytest

from mirrorskin.kernels import disk_cache


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_cache.platformdirs, "user_cache_path", lambda *_: tmp_path / "cache")
    return tmp_path / "cache"


def test_answers_are_kept_by_topic_and_circumstances(folder):
    assert disk_cache.recall("ld", (1, "a")) is None
    disk_cache.keep("ld", (1, "a"), b"system")
    disk_cache.keep("ld", (1, "b"), b"other")
    disk_cache.keep("shape", (1, "a"), b"0")
    assert disk_cache.recall("ld", (1, "a")) == b"system"
    assert disk_cache.recall("ld", (1, "b")) == b"other"
    assert disk_cache.recall("shape", (1, "a")) == b"0"
    assert len(list(folder.iterdir())) == 3


@pytest.mark.parametrize("damage", [lambda kept: kept[:-1], lambda kept: b"", lambda kept: kept[:-1] + b"x"])
def test_what_is_not_as_it_was_written_is_found_out_again(folder, damage):
    disk_cache.keep("ld", 1, b"system")
    (record,) = folder.iterdir()
    record.write_bytes(damage(record.read_bytes()))
    assert disk_cache.recall("ld", 1) is None
    disk_cache.keep("ld", 1, b"system")
    assert disk_cache.recall("ld", 1) == b"system"


def test_a_folder_that_cannot_be_written_is_not_a_failure(folder, caplog):
    folder.write_text("a file where the folder should be")
    with caplog.at_level(logging.INFO):
        disk_cache.keep("ld", 1, b"system")
    assert "computed again" in caplog.text
    assert disk_cache.recall("ld", 1) is None
