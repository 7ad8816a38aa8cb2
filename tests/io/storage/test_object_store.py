"""Zarr in an object store with S3's protocol: moto's server, if 'moto[server]' is installed."""

from __future__ import annotations

import shutil

import pytest
from commands import run
from stacks import record, sphere

from mirrorskin import io
from mirrorskin.evaluation.base.object_store import object_store

pytest.importorskip("s3fs", reason="needs 'mirrorskin[s3]'")
pytest.importorskip("moto.server", reason="needs 'moto[server]'")

ADDRESS = "s3://presses/press.zarr"


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    """A recording, which is also in the store of the module's tests, and the store."""
    path = record(sphere(), tmp_path_factory.mktemp("made") / "press.h5", truth=sphere().truth)
    with object_store("presses") as store:
        assert run("export", path, "-o", ADDRESS).code == 0
        yield path, store


@pytest.fixture
def bucket(press, tmp_path, monkeypatch):
    """The store, with the recording's file in the working directory."""
    path, store = press
    shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return store


def test_results_are_those_of_the_file_bit_for_bit(bucket):
    for name, result in ((ADDRESS, "s3.h5"), ("press.h5", "file.h5")):
        assert run("reconstruct", name, "-o", result).code == 0
    actual = [io.open_result(name).maps() for name in ("s3.h5", "file.h5")]
    assert {name: values.tobytes() for name, values in actual[0].items()} == {
        name: values.tobytes() for name, values in actual[1].items()
    }


def refused(*words):
    ended = run(*words)
    assert ended.code == 2
    assert len(ended.said.splitlines()) == 1
    return ended.said


def test_a_bucket_that_is_not_there(bucket):
    assert "s3://nowhere/press.zarr: there is no Zarr" in refused("info", "s3://nowhere/press.zarr")


def test_a_store_that_is_gone(bucket, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    assert f"{ADDRESS}: the store does not answer" in refused("info", ADDRESS)


def test_credentials_that_are_missing(bucket, monkeypatch, tmp_path):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    assert f"{ADDRESS}: access is refused" in refused("info", ADDRESS)


def test_a_chunk_that_is_gone_leaves_no_result(bucket, tmp_path):
    bucket.copy("presses/press.zarr/", "presses/short.zarr/", recursive=True)
    bucket.rm("presses/short.zarr/entry/instrument/detector/data/c/0/0/0")
    before = sorted(tmp_path.iterdir())
    message = refused("reconstruct", "s3://presses/short.zarr", "-o", "s3.h5")
    assert "data/c/0/0/0, is missing: copy it again" in message
    assert sorted(tmp_path.iterdir()) == before


def test_a_pattern_names_all_that_answer(bucket):
    assert "1 done" in run("batch", "s3://presses/pre*.zarr", "-o", "results").out
