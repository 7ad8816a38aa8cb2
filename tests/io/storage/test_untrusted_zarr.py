"""Zarr of unknown origin: it runs no code, reads nothing outside of it, and is refused in one line."""

from __future__ import annotations

import contextlib
import functools
import gzip
import http.server
import json
import os
import pickle
import shutil
import socket
import struct
import subprocess
import sys
import threading
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from stacks import SHAPE, random_stack, read_all, record, sphere
from traps import Trap

from mirrorskin import io
from mirrorskin.io.base.url import Url

zarr = pytest.importorskip("zarr")

import aiohttp  # noqa: E402
import fsspec  # noqa: E402
import google_crc32c  # noqa: E402
import numcodecs  # noqa: E402
import numcodecs.pickles  # noqa: E402
from zarr.codecs import BloscCodec, BytesCodec, GzipCodec, ShardingCodec, ZstdCodec  # noqa: E402

STACK = "entry/instrument/detector/data"
GIVEN = {"motion": "vertical", "travel": io.Steps(0.3)}
UTF8, PICKLE = {"id": "vlen-utf8"}, {"id": "pickle", "protocol": 4}


def refused(path, **options):
    """Return the line with which a recording is refused, whatever is done with it."""
    with pytest.raises(io.InputError) as caught, io.open_recording(path, **options) as recording:
        read_all(recording, 3)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 600
    assert message.startswith(str(path))
    return message


def put(folder, name, document):
    place = folder / name
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(json.dumps(document))


def put_array(folder, name, chunk, key=None, **document):
    """Write an array of version 2 of one chunk."""
    shape = document.get("shape", [])
    defaults = {"zarr_format": 2, "shape": shape, "chunks": shape, "order": "C", "fill_value": None}
    put(folder / name, ".zarray", defaults | {"filters": None, "compressor": None} | document)
    (folder / name / (key or ".".join("0" for _ in shape) or "0")).write_bytes(chunk)


def theirs(folder, ours=True):
    """Write a recording of version 2 whose frames are plain bytes."""
    put(folder, ".zgroup", {"zarr_format": 2})
    put(folder, "entry/.zgroup", {"zarr_format": 2})
    put(folder, "entry/.zattrs", {"mirrorskin_recording": 1} if ours else {})
    put_array(folder, STACK, random_stack().tobytes(), dtype="|u1", shape=list(SHAPE))
    if ours:
        put_array(
            folder,
            "entry/instrument/stage/travel",
            np.arange(8.0).tobytes(),
            dtype="<f8",
            shape=[8],
        )
        put_array(
            folder,
            "entry/instrument/stage/motion",
            numcodecs.VLenUTF8().encode(np.array(["vertical"], object)),
            dtype="|O",
            filters=[UTF8],
        )
    for group in ("entry/instrument", "entry/instrument/detector", "entry/instrument/stage"):
        put(folder, f"{group}/.zgroup", {"zarr_format": 2})
    return folder


@pytest.fixture
def flag(tmp_path, monkeypatch):
    """A file that is there once a pickle was decoded, which numcodecs is told to do."""
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    return tmp_path / "flag"


def trap(flag):
    """Return a pickle that makes a file when it is decoded."""
    data = pickle.dumps(Trap(flag))
    numcodecs.pickles.Pickle().decode(data)
    flag.unlink()  # it works
    return data


def consolidated_2(folder):
    """Copy all metadata into one document, and remove what it was copied from."""
    actual = {
        str(path.relative_to(folder)): json.loads(path.read_text())
        for path in folder.rglob(".z*")
        if path.parent != folder or path.name == ".zgroup"
    }
    put(folder, ".zmetadata", {"zarr_consolidated_format": 1, "metadata": actual})
    for name in actual:
        if name != ".zgroup":
            (folder / name).unlink()


@contextlib.contextmanager
def served(folder, handler=http.server.SimpleHTTPRequestHandler, **settings):
    """Serve a folder on this machine; yield the address."""

    class Quiet(handler):
        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder), **settings)
    )
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextlib.contextmanager
def delivered(folder, method):
    """Yield the path or address of a store that was written to a folder."""
    if method == "zip":
        yield Path(shutil.make_archive(str(folder), "zip", folder))
    elif method == "http":
        with served(folder.parent) as address:
            yield Url(f"{address}/{folder.name}")
    else:
        yield folder


DANGEROUS = {
    "compressor of a text": {"dtype": "|O", "filters": [UTF8], "compressor": PICKLE},
    "filter of a text": {"dtype": "|O", "filters": [PICKLE]},
    "filter of a text behind another": {"dtype": "|O", "filters": [UTF8, PICKLE]},
    "compressor of a number": {"dtype": "<f8", "compressor": PICKLE},
    "filter of a number": {"dtype": "<f8", "filters": [PICKLE]},
}


@pytest.mark.parametrize("consolidated", [False, True])
@pytest.mark.parametrize("method", ["folder", "zip", "http"])
@pytest.mark.parametrize("kind", DANGEROUS)
def test_no_pickle_is_decoded(tmp_path, flag, kind, method, consolidated):
    folder = theirs(tmp_path / "x.zarr")
    name = "entry/title" if "text" in kind else "entry/instrument/stage/tilt"
    put_array(folder, name, trap(flag), **DANGEROUS[kind])
    if consolidated:
        consolidated_2(folder)
    with delivered(folder, method) as path:
        assert f"/{name} needs the codec 'pickle'; only" in refused(path)
        with pytest.raises(io.InputError, match="needs the codec 'pickle'"):
            io.describe(path)
        with pytest.raises(io.InputError, match="needs the codec 'pickle'"):
            io.save_zarr(path, tmp_path / "copy.zarr")
    assert not flag.exists()


@pytest.mark.parametrize("ours", [True, False])
@pytest.mark.parametrize("place", [{"compressor": PICKLE}, {"filters": [PICKLE]}])
def test_no_pickle_of_frames_is_decoded(tmp_path, flag, ours, place):
    folder = theirs(tmp_path / "x.zarr", ours)
    put_array(folder, STACK, trap(flag), dtype="|u1", shape=list(SHAPE), **place)
    assert f"/{STACK} needs the codec 'pickle'; only" in refused(folder, **GIVEN)
    assert not flag.exists()


def test_what_others_keep_next_to_their_frames_is_not_decoded(tmp_path, flag):
    folder = theirs(tmp_path / "x.zarr", ours=False)
    put_array(folder, "entry/notes", trap(flag), **DANGEROUS["compressor of a text"])
    put_array(folder, "entry/odd", b"", dtype=[["a", "<f8"]], compressor={"id": "unheard-of"})
    with io.open_recording(folder, **GIVEN) as recording:
        np.testing.assert_array_equal(read_all(recording, 3).frames, random_stack())
    assert io.describe(folder)["stacks"] == "1"
    assert not flag.exists()


def codecs_3(*codecs):
    return [{"name": "bytes", "configuration": {"endian": "little"}}, *codecs]


def shards(codecs, index=None):
    settings = {"chunk_shape": [1, 5, 7], "codecs": codecs, "index_location": "end"}
    settings["index_codecs"] = index or codecs_3({"name": "crc32c"})
    return [{"name": "sharding_indexed", "configuration": settings}]


UNKNOWN = {"name": "numcodecs.pickle", "configuration": {}}


@pytest.mark.parametrize("inline", [False, True])
@pytest.mark.parametrize(
    "codecs",
    [
        codecs_3(UNKNOWN),
        [UNKNOWN],
        ["numcodecs.pickle"],
        codecs_3({"id": "zstd", **UNKNOWN}),
        shards(codecs_3(UNKNOWN)),
        shards(codecs_3(), codecs_3(UNKNOWN)),
    ],
)
def test_codecs_of_version_3_are_those_that_are_allowed(tmp_path, codecs, inline):
    folder = tmp_path / "x.zarr"
    zarr.create_array(folder, name="x", data=random_stack(), chunks=(1, 5, 7), compressors=None)
    zarr.open_group(folder, mode="a")
    document = json.loads((folder / "x/zarr.json").read_text()) | {"codecs": codecs}
    put(folder, "x/zarr.json", document)
    if inline:
        root = json.loads((folder / "zarr.json").read_text())
        copies = {"kind": "inline", "must_understand": False, "metadata": {"x": document}}
        put(folder, "zarr.json", root | {"consolidated_metadata": copies})
        (folder / "x/zarr.json").unlink()
    assert "/x needs the codec 'numcodecs.pickle'; only" in refused(folder, **GIVEN)


def edit(folder, **changes):
    put(folder, "zarr.json", json.loads((folder / "zarr.json").read_text()) | changes)


@pytest.mark.parametrize(
    "settings",
    [
        {"compressor": numcodecs.Blosc("zstd")},
        {"compressor": numcodecs.Zlib()},
        {"compressor": numcodecs.GZip()},
        {"compressor": numcodecs.LZ4()},
        {"compressor": numcodecs.Zstd()},
        {"compressor": None},
        {"compressor": numcodecs.Zstd(), "filters": [numcodecs.Shuffle(2)]},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["<u2", ">u2"])
def test_version_2_is_read_in_all_codecs_that_are_allowed(tmp_path, settings, dtype):
    frames, folder = random_stack("uint16").astype(dtype), tmp_path / "x.zarr"
    document = {"dtype": dtype, "shape": list(SHAPE)}
    packed = frames.tobytes()
    for settings_of_filter in settings.get("filters", []):
        packed = bytes(settings_of_filter.encode(packed))
    if settings["compressor"]:
        packed = settings["compressor"].encode(packed)
        document["compressor"] = settings["compressor"].get_config()
    document["filters"] = [codec.get_config() for codec in settings.get("filters", [])]
    put_array(folder, "", bytes(packed), key="0.0.0", **document)
    with io.open_recording(folder, **GIVEN) as recording:
        np.testing.assert_array_equal(read_all(recording, 3).frames, frames)


CODECS_3 = {"blosc": BloscCodec(), "gzip": GzipCodec(), "zstd": ZstdCodec()}


@pytest.mark.parametrize("name", CODECS_3)
@pytest.mark.parametrize("sharded", [False, True])
def test_version_3_is_read_in_all_codecs_that_are_allowed(tmp_path, name, sharded):
    settings = {"chunks": (2, 5, 7), "shards": (4, 5, 7) if sharded else None, "compressors": CODECS_3[name]}
    zarr.create_array(tmp_path / "x.zarr", data=random_stack(), **settings)
    with io.open_recording(tmp_path / "x.zarr", **GIVEN) as recording:
        assert recording.storage.lower() == f"zarr, chunks (2, 5, 7), {name}"
        np.testing.assert_array_equal(read_all(recording, 3).frames, random_stack())


def test_shards_inside_of_shards_are_read(tmp_path):
    inner = ShardingCodec(chunk_shape=(1, 5, 7), codecs=[BytesCodec()])
    settings = {"serializer": ShardingCodec(chunk_shape=(2, 5, 7), codecs=[inner]), "compressors": None}
    zarr.create_array(tmp_path / "x.zarr", data=random_stack(), chunks=(4, 5, 7), **settings)
    with io.open_recording(tmp_path / "x.zarr", **GIVEN) as recording:
        np.testing.assert_array_equal(read_all(recording, 3).frames, random_stack())


@pytest.mark.parametrize(
    ("sizes", "refused_size"),
    [
        ({"chunks": SHAPE}, "0.00028"),
        ({"chunks": (2, 5, 7)}, None),
        ({"chunks": (4, 5, 7), "shards": SHAPE}, "0.00014"),
        ({"chunks": (2, 5, 7), "shards": SHAPE}, None),
        ({"chunks": (1, 50, 70)}, "0.0035"),
    ],
)
def test_a_chunk_that_states_more_than_the_memory_limit_is_refused(tmp_path, sizes, refused_size):
    folder, limit = tmp_path / "x.zarr", {"memory_limit": 100, **GIVEN}
    zarr.create_array(folder, data=random_stack(), **sizes)
    if refused_size:
        message = f"/data is in chunks of {refused_size} MB: raise --memory, or write smaller ones"
        assert message in refused(folder, **limit)
    else:
        io.open_recording(folder, **limit).close()


FRAMES = bytes(int(np.prod(SHAPE)))
PACKERS = {
    "blosc": numcodecs.Blosc().encode,
    "gzip": gzip.compress,
    "lz4": numcodecs.LZ4().encode,
    "zlib": zlib.compress,
    "zstd": numcodecs.Zstd().encode,
}


@pytest.mark.parametrize("harm", ["longer", "cut", "no chunk"])
@pytest.mark.parametrize(
    ("name", "version"), [*((name, 2) for name in PACKERS), *((name, 3) for name in CODECS_3)]
)
def test_damaged_chunks_are_refused(tmp_path, name, version, harm):
    pack, folder = PACKERS[name], tmp_path / "x.zarr"
    chunk = {"longer": pack(FRAMES + FRAMES), "cut": pack(FRAMES)[:-9], "no chunk": b"no chunk"}[harm]
    if version == 2:
        put_array(folder, "", chunk, dtype="|u1", shape=list(SHAPE), compressor={"id": name})
    else:
        zarr.create_array(folder, data=random_stack(), chunks=SHAPE, compressors=CODECS_3[name])
        (folder / "c/0/0/0").write_bytes(chunk)
    message = refused(folder, **GIVEN)
    assert "frames 0 to 7 of /data cannot be read: it is damaged" in message


@pytest.mark.parametrize("chunk", [b"", b"\xff\xff\xff\xff", b"\2\0\0\0\1\0\0\0a", b"\1\0\0\0\0\0\0\4a"])
def test_damaged_texts_are_refused(tmp_path, chunk):
    folder = theirs(tmp_path / "x.zarr")
    put_array(folder, "entry/title", chunk, dtype="|O", filters=[UTF8])
    assert "/entry/title" in refused(folder)


def test_only_what_is_needed_is_decoded(tmp_path):
    folder = theirs(tmp_path / "x.zarr")
    settings = {"dtype": "|u1", "compressor": {"id": "zlib"}}
    for number in range(5):
        put_array(folder, f"entry/x{number}", b"no chunk", key="0", shape=[1 << 29], **settings)
    with io.open_recording(folder) as recording:
        np.testing.assert_array_equal(read_all(recording, 3).frames, random_stack())


@pytest.mark.parametrize("name", ["zarr.json", "c/0/0/0", "c/7/0/0"])
def test_nothing_outside_of_a_folder_is_read(tmp_path, name):
    folder = tmp_path / "x.zarr"
    zarr.create_array(folder, data=random_stack(), chunks=(1, 5, 7), compressors=None)
    (folder / name).rename(tmp_path / "outside")
    (folder / name).symlink_to(tmp_path / "outside")
    assert f"{name} leads out of the store, to" in refused(folder, **GIVEN)


def test_links_inside_of_a_folder_are_followed(tmp_path):
    zarr.create_array(tmp_path / "store", data=random_stack(), chunks=(1, 5, 7), compressors=None)
    (tmp_path / "store/c/3/0/0").rename(tmp_path / "store/three")
    (tmp_path / "store/c/3/0/0").symlink_to("../../../three")
    (tmp_path / "x.zarr").symlink_to("store")
    with io.open_recording(tmp_path / "x.zarr", **GIVEN) as recording:
        np.testing.assert_array_equal(read_all(recording, 3).frames, random_stack())


@pytest.mark.parametrize(
    ("name", "message"),
    [("zarr.json", "is not a regular file"), ("c/0/0/0", "is not"), ("c/6/0/0", "is not")],
)
def test_a_pipe_in_a_folder_is_refused(tmp_path, name, message):
    folder = tmp_path / "x.zarr"
    zarr.create_array(folder, data=random_stack(), chunks=(1, 5, 7), compressors=None)
    (folder / name).unlink()
    os.mkfifo(folder / name)
    assert message in refused(folder, **GIVEN)


def test_a_pipe_in_place_of_a_store_is_refused(tmp_path):
    os.mkfifo(tmp_path / "x.zarr")
    assert "is neither a folder nor a regular file" in refused(tmp_path / "x.zarr")


@pytest.mark.parametrize("name", ["../x", "a/../../x", "/etc", "a//b", ".", "a/\0"])
@pytest.mark.parametrize("version", [2, 3])
def test_names_that_lead_out_of_a_store_are_refused(tmp_path, name, version):
    folder = tmp_path / "x.zarr"
    document = {"zarr_format": version, "shape": [8, 5, 7]}
    if version == 2:
        put(folder, ".zgroup", {"zarr_format": 2})
        put(folder, ".zmetadata", {"metadata": {f"{name}/.zarray": document}})
    else:
        copies = {"kind": "inline", "metadata": {name: document | {"node_type": "array"}}}
        group = {"zarr_format": 3, "node_type": "group", "consolidated_metadata": copies}
        put(folder, "zarr.json", group)
    assert "it is damaged (the name" in refused(folder)


def test_a_store_of_others_is_read_from_a_server_that_lists_its_folders(tmp_path):
    folder = theirs(tmp_path / "x.zarr", ours=False)
    with delivered(folder, "http") as path, io.open_recording(path, **GIVEN) as recording:
        np.testing.assert_array_equal(read_all(recording, 3).frames, random_stack())


def test_a_silent_server_is_refused(monkeypatch):
    timeout = {"timeout": aiohttp.ClientTimeout(total=0.2)}  # otherwise that of aiohttp
    monkeypatch.setitem(fsspec.config.conf, "http", {"client_kwargs": timeout})
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()  # connections are made, and nothing is ever read or sent
        message = refused(Url(f"http://127.0.0.1:{server.getsockname()[1]}/x.zarr"))
    assert "the store does not answer" in message


@pytest.mark.parametrize("code", [401, 403, 500])
def test_a_server_that_refuses_is_reported(tmp_path, code):
    class Refusing(http.server.SimpleHTTPRequestHandler):
        def do_GET(self):
            self.send_error(code)

    with served(tmp_path, Refusing) as address:
        message = refused(Url(f"{address}/x.zarr"))
    assert ("access is refused" if code < 500 else "the store does not answer") in message


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """A recording in a zip."""
    folder = tmp_path_factory.mktemp("made")
    io.save_zarr(record(sphere(), folder / "press.h5"), folder / "press.zarr")
    return Path(shutil.make_archive(str(folder / "press.zarr"), "zip", folder / "press.zarr"))


def test_a_zip_that_was_cut_is_refused_wherever(archive, tmp_path):
    data, path = archive.read_bytes(), tmp_path / "x.zarr.zip"
    for length in sorted({*range(0, len(data), 1 + len(data) // 40), 1, 21, 22, len(data) - 1}):
        path.write_bytes(data[:length])
        assert "it is damaged" in refused(path)


def test_a_zip_with_damaged_bytes_is_read_or_refused_in_a_line(archive, tmp_path):
    data, path = bytearray(archive.read_bytes()), tmp_path / "x.zarr.zip"
    random = np.random.default_rng(1)
    for _ in range(40):
        damaged = bytearray(data)
        for place in random.integers(0, len(data), 20):
            damaged[place] ^= int(random.integers(1, 256))
        path.write_bytes(damaged)
        with contextlib.suppress(io.InputError), io.open_recording(path) as recording:
            read_all(recording, 3)


def test_a_zip_of_something_else_is_refused(tmp_path):
    path = tmp_path / "x.zarr.zip"
    path.write_text("no zip")
    assert "it is damaged (File is not a zip file)" in refused(path)
    for name, content in {
        "x.zarr/zarr.json": "{}",
        "readme.txt": "",
        "zarr.json": "{",
        ".zgroup": "[]",
        "zarr.json/": "",
    }.items():
        with zipfile.ZipFile(path, "w") as file:
            file.writestr(name, content)
        assert "it is damaged" in refused(path) or "there is no Zarr array or group" in refused(path)


@pytest.mark.parametrize("place", [(200, 2**64 - 150), (2**64 - 2, 2**64 - 2)])
def test_places_that_a_shard_cannot_have_are_refused(tmp_path, place):
    folder = tmp_path / "x.zarr"
    zarr.create_array(folder, data=random_stack(), chunks=(4, *SHAPE[1:]), shards=SHAPE, compressors=None)
    chunk = folder / "c" / "0" / "0" / "0"
    data = chunk.read_bytes()
    index = len(data) - 2 * 16 - 4
    index_bytes = struct.pack("<QQQQ", *place, *place)
    checksum = struct.pack("<I", google_crc32c.value(index_bytes))
    chunk.write_bytes(data[:index] + index_bytes + checksum)
    assert "damaged" in (message := refused(folder, **GIVEN)) or "states an invalid range of bytes" in message
    assert "overflow" not in message


def test_a_damaged_document_ends_all_that_is_read_next_to_it(tmp_path):
    """Errors of what goes on would be printed at the end of the program."""
    folder = tmp_path / "x.zarr"
    folder.mkdir()
    (folder / ".zarray").write_text("{")
    ended = subprocess.run(
        [sys.executable, "-c", REPEATED, str(folder)], capture_output=True, text=True, check=True
    )
    assert ended.stderr == ""


REPEATED = """
import sys
from mirrorskin import io
for _ in range(200):
    try:
        io.describe(sys.argv[1])
    except io.InputError as error:
        assert "it is damaged" in str(error)
"""


@pytest.mark.parametrize(
    "address", ["github://a:b@c/x.zarr", "reference://x", "zip://x.zarr::s3://b/x.zip", "data://x"]
)
def test_addresses_of_anything_but_stores_are_refused(address):
    with pytest.raises(io.InputError, match="addresses of stores begin with one of http, https"):
        io.describe(address)
