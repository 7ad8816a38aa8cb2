"""What is kept in the user's cache folder."""

import logging

import pytest

from mirrorskin.kernels import remember


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(remember.platformdirs, "user_cache_path", lambda *_: tmp_path / "cache")
    return tmp_path / "cache"


def test_answers_are_kept_by_topic_and_circumstances(folder):
    assert remember.recall("ld", (1, "a")) is None
    remember.keep("ld", (1, "a"), "system")
    remember.keep("ld", (1, "b"), "other")
    remember.keep("shape", (1, "a"), "0")
    assert remember.recall("ld", (1, "a")) == "system"
    assert remember.recall("ld", (1, "b")) == "other"
    assert remember.recall("shape", (1, "a")) == "0"
    assert len(list(folder.iterdir())) == 3


def test_a_folder_that_cannot_be_written_is_no_failure(folder, caplog):
    folder.write_text("a file where the folder should be")
    with caplog.at_level(logging.INFO):
        remember.keep("ld", 1, "system")
    assert "found out again" in caplog.text
    assert remember.recall("ld", 1) is None
