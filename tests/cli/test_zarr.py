"""Stacks in Zarr on the command line: at addresses as in folders; refusals in one line."""

from __future__ import annotations

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from commands import refused, run
from stacks import record, sphere

from mirrorskin import io

pytest.importorskip("zarr")
fsspec = pytest.importorskip("fsspec")

ADDRESS = "memory://bucket/press.zarr"


@pytest.fixture
def bucket(tmp_path):
    """A store in memory, where a recording is exported to from the working directory."""
    record(sphere(), tmp_path / "press.h5", truth=sphere().truth)
    store = fsspec.filesystem("memory")
    assert run("export press.h5 -o", ADDRESS).code == 0
    yield store
    store.rm("/bucket", recursive=True)


def test_a_command_reads_an_address_as_a_file(bucket):
    assert run("reconstruct", ADDRESS, "-o", "zarr.h5").code == 0
    assert run("reconstruct press.h5 -o hdf5.h5").code == 0
    heights = [io.open_result(name).height for name in ("zarr.h5", "hdf5.h5")]
    assert heights[0].tobytes() == heights[1].tobytes()


@pytest.mark.parametrize("output", ["result.zarr", "memory://bucket/result.zarr"])
def test_a_result_is_written_as_zarr_and_read_as_a_file(bucket, output):
    assert run("reconstruct press.h5").code == 0
    ended = run("reconstruct press.h5 -o", output)
    assert (ended.code, ended.out.split(":")[0]) == (0, output.split(":")[0])
    first, second = io.open_result("press-result.h5"), io.open_result(output)
    assert {name: values.tobytes() for name, values in first.maps().items()} == {
        name: values.tobytes() for name, values in second.maps().items()
    }
    assert {**first.process, "date": ""} == {**second.process, "date": ""}  # they may be a second apart
    scores = [run("score", name, "--truth", "press.h5").out for name in ("press-result.h5", output)]
    assert scores[0] == scores[1]


def test_info_differs_in_the_storage_alone(bucket):
    first, second = (run("info", name).out.splitlines() for name in ("press.h5", ADDRESS))
    different = [pair for pair in zip(first, second, strict=True) if pair[0] != pair[1]]
    assert len(different) == 1
    assert different[0][1].split() == ["storage", "Zarr,", "chunks", "(8,", "5,", "7),", "Blosc"]


def test_a_batch_takes_addresses_and_keeps_what_is_made(bucket):
    assert "1 done" in run("batch memory://bucket/*.zarr -o results").out
    assert "1 kept" in run("batch", ADDRESS, "-o", "results").out


def test_a_pattern_does_not_look_into_stores(bucket):
    assert run("export press.h5 -o other.zarr").code == 0
    ended = run("batch **/* -o results")
    assert (ended.code, sorted(path.name for path in Path("results").glob("*-result.h5"))) == (
        0, ["other-result.h5", "press-result.h5"],
    )  # fmt: skip


def test_nothing_is_exported_next_to_a_store_that_is_there(bucket):
    for words in (("reconstruct", "press.h5"), ("export", "press-result.h5", "-o", "taken.zarr")):
        assert run(*words).code == 0
    ended = run("export press-result.h5 -o a.ply -o taken.zarr")
    assert (ended.code, Path("a.ply").exists()) == (2, False)
    assert "taken.zarr exists: remove it" in ended.said


def test_a_batch_mixes_files_and_addresses(bucket):
    assert "2 done" in run("batch", ADDRESS, "press.h5", "-o", "results").out


def test_verify_reads_all_frames(bucket):
    assert "all 8 frames are as they were recorded" in run("info --verify", ADDRESS).out


def test_import_makes_hdf5_of_an_address(bucket):
    assert run("import", ADDRESS, "--motion", "vertical", "-o", "back.h5").code == 0
    with io.open_recording("back.h5") as recording, io.open_recording("press.h5") as first:
        assert recording.frame(5).tolist() == first.frame(5).tolist()
        assert recording.travel.tolist() == first.travel.tolist()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("reconstruct", "memory://bucket/nothing.zarr"), "memory://bucket/nothing.zarr: there is no Zarr"),
        (
            ("reconstruct", ADDRESS),
            "memory://bucket/press-result.h5: this is written as HDF5: name a local file",
        ),
        (("info", "gone.zarr"), "gone.zarr: no such file"),
        (
            ("info", "unheard://of"),
            "unheard://of cannot be opened: addresses of stores begin with one of http, https",
        ),
        (("export", "press.h5", "-o", ADDRESS), f"{ADDRESS} exists: remove it, or name another"),
        (("reconstruct", "press.h5", "-o", ADDRESS), f"{ADDRESS} exists: remove it, or name another"),
        (("reconstruct", "press.h5", "-o", "no/x.zarr"), "no/x.zarr: there is no folder no: make it first"),
        (("export", "press.h5", "-o", "x.zarr.zip"), "x.zarr.zip: Zarr is written as NAME.zarr: name it so"),
        (("simulate", "vertical", "-o", "new.zarr"), "new.zarr: this is written as HDF5: name a local file"),
        (("batch", "memory://bucket/x*", "-o", "r"), "memory://bucket/x*: no store matches"),
    ],
)
def test_impossible_input_is_one_line_with_its_address(bucket, words, message):
    refused(message, *words)


def test_a_chunk_that_is_lost_in_the_middle_leaves_nothing(bucket, tmp_path):
    bucket.pipe("/bucket/press.zarr/entry/instrument/detector/data/c/0/0/0", b"damaged")
    before = sorted(tmp_path.iterdir())
    refused(
        f"{ADDRESS}: frames 0 to 7 of /entry/instrument/detector/data cannot be read: it is damaged",
        "reconstruct",
        ADDRESS,
        "-o",
        "zarr.h5",
    )
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_behind_a_web_server_is_read_as_a_file(bucket, tmp_path):
    assert run("export press.h5 -o press.zarr").code == 0
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/press.zarr"
        assert run("reconstruct", address, "-o", "web.h5").code == 0
        assert "no Zarr" in run("info", f"{address[:-5]}s.zarr").said
        server.shutdown()
    assert run("reconstruct press.h5").code == 0
    heights = [io.open_result(name).height for name in ("web.h5", "press-result.h5")]
    assert heights[0].tobytes() == heights[1].tobytes()
