"""HDF5 files of other programs: every way of storing a stack is read; refusals are one line."""

from __future__ import annotations

import os
import subprocess
import sys
import tracemalloc

import h5py
import numpy as np
import pytest
from stacks import SHAPE, random_stack, read_all, record, sphere

from mirrorskin import io
from mirrorskin.io.storage import hdf5
from mirrorskin.io.storage.hdf5 import Hdf5File
from mirrorskin.io.storage.zarr import open_file

STACK = random_stack()
GIVEN = {"motion": "vertical", "travel": io.Steps(0.3)}
UNKNOWN_FILTER = 32999


def bare(file):
    file["frames"] = STACK


def big_endian(file):
    file["x"] = STACK.astype(">u2")


def compact(file):
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_layout(h5py.h5d.COMPACT)
    space = h5py.h5s.create_simple(SHAPE)
    h5py.Dataset(h5py.h5d.create(file.id, b"x", h5py.h5t.STD_U8LE, space, plist))[...] = STACK


def resizable(file):
    file.create_dataset("x", data=STACK[:3], maxshape=(None, 5, 7), chunks=(2, 3, 4)).resize(8, axis=0)
    file["x"][3:] = STACK[3:]


def twelve_bits(file):
    kind = h5py.h5t.STD_U16LE.copy()
    kind.set_precision(12)
    h5py.Dataset(h5py.h5d.create(file.id, b"x", kind, h5py.h5s.create_simple(SHAPE)))[...] = STACK


def virtual_in_itself(file):
    file["parts/first"], file["parts/last"] = (
        STACK[:3].reshape(1, *STACK[:3].shape),
        STACK[3:].reshape(1, 5, 5, 7),
    )
    layout = h5py.VirtualLayout(SHAPE, "u1")
    layout[:3] = h5py.VirtualSource(file["parts/first"])[0]
    layout[3:] = h5py.VirtualSource(file["parts/last"])[0]
    file.create_virtual_dataset("x", layout)


FOUND = [bare, big_endian, compact, resizable, twelve_bits, virtual_in_itself]


def read(path, **options):
    with io.open_recording(path, **GIVEN | options) as recording:
        return read_all(recording, 3)[0]


def refused(path, line, **options):
    """Hold that a file is refused, in one line that matches."""
    with (
        pytest.raises(io.InputError, match=line) as caught,
        io.open_recording(path, **GIVEN | options) as recording,
    ):
        read_all(recording, 3)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 450
    return message


@pytest.fixture
def path(tmp_path):
    return tmp_path / "theirs.h5"


@pytest.mark.parametrize("write", FOUND)
def test_the_only_stack_of_a_file_is_found(path, write):
    with h5py.File(path, "w", libver="earliest" if write is compact else "latest") as file:
        write(file)
    np.testing.assert_array_equal(read(path), STACK)


def test_of_several_stacks_one_is_named(path):
    with h5py.File(path, "w") as file:
        file["a/one"], file["two"] = STACK, STACK[::-1]
    for name in ("two", "/two", "./two", "//two"):
        np.testing.assert_array_equal(read(path, dataset=name), STACK[::-1])
    np.testing.assert_array_equal(read(path, dataset="a/one"), STACK)
    refused(path, r"theirs\.h5 contains 2 stacks, /a/one, /two: choose with --dataset")


@pytest.mark.parametrize("subfolder", [".", "deep/down"])
def test_links_inside_the_folder_are_followed(tmp_path, path, subfolder):
    other = tmp_path / subfolder / "other.h5"
    other.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(other, "w") as file:
        file["there/x"] = STACK
        file["back"] = h5py.ExternalLink(path, "/soft")
    with h5py.File(path, "w") as file:
        file["near"] = h5py.ExternalLink(f"{subfolder}/other.h5", "/there/x")
        file["group"] = h5py.ExternalLink(str(other), "there")
        file["soft"] = h5py.SoftLink("/near")
        file.create_group("sub")["relative"] = h5py.SoftLink("./back")
        file["sub/back"] = h5py.ExternalLink(f"{subfolder}/other.h5", "/back")
    for name in ("near", "group/x", "soft", "sub/relative", "sub/back"):
        np.testing.assert_array_equal(read(path, dataset=name), STACK)
    # All of them are closed again: HDF5 would not open one for writing otherwise.
    for each in (path, other):
        h5py.File(each, "r+").close()


def raw_files(path):
    """Write a stack whose frames lie in two raw files beside it."""
    data = b"header" + STACK.tobytes() + b"rest"
    path.parent.joinpath("a.raw").write_bytes(data[:106])
    path.parent.joinpath("b.raw").write_bytes(data[106:])
    with h5py.File(path, "w") as file:
        file.create_dataset("x", SHAPE, "u1", external=[("a.raw", 6, 100), ("b.raw", 0, 180)])


def test_raw_files_are_read_from_next_to_the_file(tmp_path, path, monkeypatch):
    raw_files(path)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("a.raw", "b.raw"):
        (elsewhere / name).write_bytes(bytes(300))
    monkeypatch.chdir(elsewhere)
    np.testing.assert_array_equal(read(path), STACK)
    assert np.array_equal(read("../theirs.h5"), STACK)
    with io.open_recording(path, **GIVEN) as recording:
        assert recording.storage == "in raw files"


def virtual(path, names, length=2, missing=0):
    """Write a virtual stack from files of two frames each; the last file lacks some."""
    layout = h5py.VirtualLayout(SHAPE, "u1", filename=path)
    for k, name in enumerate(names):
        part = STACK[length * k : length * (k + 1)]
        kept = part[: len(part) - (missing if name == names[-1] else 0)]
        with h5py.File(path.parent / name, "w") as file:
            file["x"] = kept
        layout[length * k : length * (k + 1)] = h5py.VirtualSource(name, "x", part.shape)
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("x", layout)


def test_a_virtual_stack_is_read(path, tmp_path, monkeypatch):
    virtual(path, [f"part{k}.h5" for k in range(4)])
    monkeypatch.chdir(tmp_path.parent)
    np.testing.assert_array_equal(read(path), STACK)
    with io.open_recording(path, **GIVEN) as recording:
        assert recording.storage == "virtual"


def test_a_virtual_stack_that_is_not_whole_is_refused(path, tmp_path):
    names = [f"part{k}.h5" for k in range(4)]
    virtual(path, names, missing=1)
    refused(path, r"/x claims 280 bytes and its file contains 245: it was cut short")
    virtual(path, names[:3])
    refused(path, r"/x claims 280 bytes and its file contains 210: it was cut short")
    virtual(path, names)
    with h5py.File(tmp_path / "part2.h5", "w") as file:
        file["y"] = STACK
    refused(path, r"/x needs x of part2\.h5: it is not there")
    with h5py.File(tmp_path / "part2.h5", "w") as file:
        file.create_dataset("x", (2, 5, 7), "u1")
    refused(path, r"part2\.h5: /x claims 70 bytes and its file contains none: it was never written")
    (tmp_path / "part2.h5").unlink()
    refused(path, r"the virtual dataset /x leads to part2\.h5, which does not exist: copy it there")


@pytest.mark.parametrize(
    ("method", "kind"),
    [("..", "link"), ("absolute", "virtual"), ("symlink", "raw"), ("by another", "link"), ("..", "raw")],
)
def test_nothing_outside_the_folder_is_read(tmp_path, method, kind):
    outside, home = tmp_path / "outside", tmp_path / "home"
    for folder in (outside, home / "sub"):
        folder.mkdir(parents=True)
    with h5py.File(outside / "x.h5", "w") as file:
        bare(file)
    (outside / "x.raw").write_bytes(STACK.tobytes())
    (home / "sub" / "link").symlink_to(outside)
    names = {
        "..": "../outside",
        "absolute": str(outside),
        "symlink": "sub/link",
        "by another": "../../outside",
    }
    name = f"{names[method]}/x.{'raw' if kind == 'raw' else 'h5'}"
    path = home / ("sub/theirs.h5" if method == "by another" else "theirs.h5")
    with h5py.File(path, "w") as file:
        if kind == "link":
            file["x"] = h5py.ExternalLink(name, "/frames")
        elif kind == "raw":
            file.create_dataset("x", SHAPE, "u1", external=[(name, 0, 280)])
        else:
            layout = h5py.VirtualLayout(SHAPE, "u1")
            layout[...] = h5py.VirtualSource(name, "frames", SHAPE)
            file.create_virtual_dataset("x", layout)
    if method == "by another":
        with h5py.File(home / "theirs.h5", "w") as file:
            file["x"] = h5py.ExternalLink("sub/theirs.h5", "/x")
    refused(
        home / "theirs.h5", r"leads out of its folder, to .*: copy that file into its folder", dataset="x"
    )


def test_links_that_lead_nowhere_are_refused(path, tmp_path):
    (tmp_path / "text.h5").write_text("no HDF5")
    (tmp_path / "loop.h5").symlink_to("loop.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        bare(file)
    with h5py.File(path, "w") as file:
        file["soft"] = h5py.SoftLink("/nothing/here")
        file["gone"] = h5py.ExternalLink("gone.h5", "/x")
        file["loop"] = h5py.ExternalLink("loop.h5", "/x")
        file["text"] = h5py.ExternalLink("text.h5", "/x")
        file["inside"] = h5py.ExternalLink("other.h5", "/x")
        file["folder"] = h5py.ExternalLink(".", "/x")
        file["long"] = h5py.ExternalLink("x" * 300, "/x")
    refused(path, r"theirs\.h5: /: the link soft leads to /nothing/here, which is not there", dataset="soft")
    refused(path, r"the external link gone in / leads to gone\.h5, which does not exist", dataset="gone")
    refused(path, r"the external link loop in / leads to loop\.h5, which does not exist", dataset="loop")
    refused(path, r"text\.h5 is not an HDF5 file", dataset="text")
    refused(path, "the link inside leads to /x, which is not there", dataset="inside")
    refused(path, r"the external link folder in / leads to \., which is not a regular file", dataset="folder")
    refused(path, "the external link long in /: File name too long", dataset="long")


def test_links_that_go_round_are_refused(path, tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["back"] = h5py.ExternalLink("theirs.h5", "/there")
    with h5py.File(path, "w") as file:
        file["self"] = h5py.SoftLink("/self")
        file["a"], file["b"] = h5py.SoftLink("/b"), h5py.SoftLink("/a/a/a")
        file["there"] = h5py.ExternalLink("other.h5", "/back")
        file["again"] = h5py.ExternalLink("theirs.h5", "/again")
    for name in ("self", "a", "b/x", "there", "again"):
        refused(path, "links form a cycle", dataset=name)


def test_a_name_that_is_not_a_stack_is_refused(path):
    with h5py.File(path, "w") as file:
        file["group/x"], file["flat"], file["empty"] = STACK, STACK[0], h5py.Empty("u1")
        file["four"], file["type"] = STACK[None].repeat(2, 0), np.dtype("u1")
    refused(path, r"there is no nothing: name the stack with --dataset", dataset="nothing")
    refused(path, r"there is no flat/x: name", dataset="flat/x")
    refused(path, r"/group is not a dataset: name one with --dataset", dataset="group")
    refused(path, r"/ is not a dataset: name one", dataset="/")
    refused(path, r"/type is not a dataset: name one", dataset="type")
    refused(path, r"/flat has shape \(5, 7\): a stack of frames, \(T, H, W\), is needed", dataset="flat")
    refused(path, r"/four has shape \(2, 8, 5, 7\)", dataset="four")
    refused(path, r"/empty has shape None", dataset="empty")


def test_a_stack_of_too_little_is_refused(path):
    for shape, line in {
        (0, 5, 7): "contains 0 frames: at least 2 are needed",
        (1, 5, 7): "contains 1 frame: at least 2 are needed",
        (8, 5, 0): "its frames have no pixels",
    }.items():
        with h5py.File(path, "w") as file:
            file["x"] = np.zeros(shape, "u1")
        refused(path, line)


@pytest.mark.parametrize("dtype", ["c8", "S3", [("r", "u1"), ("g", "u1")], h5py.vlen_dtype("u1")], ids=str)
def test_a_type_that_frames_cannot_have_is_refused(path, dtype):
    with h5py.File(path, "w") as file:
        file.create_dataset("x", SHAPE, dtype)
    refused(path, r"/x is of type .*: frames are uint8, uint16 or float32; convert it first")


def huge_in_one_piece(file):
    file.create_dataset("x", (10**6, 1000, 1000), "u1")


def huge_in_chunks(file):
    file.create_dataset("x", (10**6, 1000, 1000), "u1", chunks=(1, 1000, 1000), compression="gzip")[3] = 1


def huge_by_a_virtual_source(file):
    file.create_dataset("small", (8, 5), "u1")
    layout = h5py.VirtualLayout((10**6, 1000, 1000), "u1")
    layout[0, 0, 0] = h5py.VirtualSource(file["small"])[0, 0]
    file["small"][...] = 1
    file.create_virtual_dataset("x", layout)


@pytest.mark.parametrize("write", [huge_in_one_piece, huge_in_chunks, huge_by_a_virtual_source])
def test_more_than_the_file_holds_is_refused_before_memory_is_taken(path, write):
    with h5py.File(path, "w") as file:
        write(file)
    tracemalloc.start()
    try:
        refused(
            path,
            r"/x claims [0-9]+ bytes and its file contains ([0-9]+: it was cut short; copy|none: it was)"
            "|/x: frames 0 to 2 of 1000000 were never written, or are missing in this copy: copy it again",
        )
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_a_filter_that_is_not_installed_is_named(path):
    with h5py.File(path, "w") as file:
        stack = file.create_dataset(
            "x", SHAPE, "u1", chunks=(1, 5, 7), compression=UNKNOWN_FILTER, allow_unknown_filter=True
        )
        for k in range(8):
            stack.id.write_direct_chunk((k, 0, 0), STACK[k].tobytes())
    refused(
        path,
        r"/x is packed with filter 32999 \(unnamed\), which is not installed: install its HDF5 plugin "
        "and name its folder in HDF5_PLUGIN_PATH",
    )


def test_a_file_that_was_cut_is_refused_wherever(path):
    record(sphere(), path, "gzip")
    data = path.read_bytes()
    for length in (0, 7, 8, 47, 96, 600, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        line = (
            "is not an HDF5 file"
            if length < 8
            else "it is truncated: copy it again|it is damaged .*: copy it again"
        )
        refused(path, line)
        with pytest.raises(io.InputError, match=line):
            io.describe(path)
    path.write_bytes(data)
    io.open_recording(path).close()


def test_what_is_not_a_file_of_frames_is_refused(tmp_path):
    (tmp_path / "text.h5").write_text("frames")
    (tmp_path / "loop.h5").symlink_to("loop.h5")
    refused(tmp_path / "none.h5", r"none\.h5: no such file")
    refused(tmp_path / "text.h5" / "below.h5", r"below\.h5: no such file")
    refused(tmp_path / "loop.h5", r"loop\.h5: no such file")
    refused(tmp_path / ("x" * 300), "File name too long")
    refused(tmp_path, "is a folder without numbered pictures")
    refused("/dev/null", "is not a regular file")
    refused(
        tmp_path / "text.h5",
        "is not an HDF5 file; frames are read from HDF5, Zarr, NPY, NPZ, MCAP, TIFF, a video .AVI, MP4, .*,"
        " or a folder of numbered pictures",
    )


WRITER = "import h5py, sys; file = h5py.File(sys.argv[1], 'r+'); print('open', flush=True); sys.stdin.read()"


def test_a_file_that_is_being_written_is_refused(path, monkeypatch):
    monkeypatch.delenv("HDF5_USE_FILE_LOCKING", raising=False)
    with h5py.File(path, "w") as file:
        bare(file)
    command = [sys.executable, "-c", WRITER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"open\n"
        refused(path, r"theirs\.h5: another program is writing it: wait until it is done")
        writer.stdin.close()
    np.testing.assert_array_equal(read(path), STACK)


def test_a_damaged_heap_of_texts_is_refused(path):
    """HDF5 itself reads such a heap for ever."""
    with h5py.File(path, "w") as file:
        file["x"] = STACK
        file["x"].attrs["units"] = "counts"
    data = bytearray(path.read_bytes())
    heap = data.find(b"GCOL")
    free = heap + 16 + 16 + 8  # behind the heap's head, and the one text with its own
    assert data[free : free + 2] == b"\0\0"
    data[free + 8 : free + 16] = bytes(8)
    path.write_bytes(data)
    with Hdf5File(path) as file, pytest.raises(io.InputError, match="a heap of texts that does not end"):
        file.attribute("/x", "units")


def test_what_is_neither_number_nor_text_is_refused(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("x", (), h5py.vlen_dtype(np.int32))[()] = [1, 2]
    with Hdf5File(path) as file, pytest.raises(io.InputError, match="neither numbers nor text"):
        file.value(file.find("/x"))


def test_links_that_branch_without_end_are_refused(path, monkeypatch):
    monkeypatch.setattr(hdf5, "_MOST_STEPS", 2_000)
    with h5py.File(path, "w") as file:
        file["x"], file["link0"] = STACK, h5py.SoftLink("/")
        for depth in range(1, 16):
            file[f"link{depth}"] = h5py.SoftLink("/" + "/".join([f"link{depth - 1}"] * 4))
    refused(path, "it is reached through too many links", dataset="link15/x")


def test_a_unit_of_many_letters_is_refused_in_a_line(path):
    with h5py.File(path, "w") as file:
        file["x"] = np.ones(3)
        file["x"].attrs["units"] = "m" * 50_000
    with Hdf5File(path) as file, pytest.raises(io.InputError, match="cannot be converted to mm") as caught:
        file.read(file.find("/x"), (3,), unit="mm")
    assert len(str(caught.value)) < 450


SECRET = b"a line that nobody should see"


def text_in_raw_file(file, name, raw):
    """Write a single text whose bytes are in a raw file."""
    file.create_dataset(name, (1,), f"S{len(SECRET)}", external=[(str(raw), 0, len(SECRET))])


def virtual_text(file, name, source):
    layout = h5py.VirtualLayout((1,), f"S{len(SECRET)}")
    layout[...] = h5py.VirtualSource(str(source), "text", (1,))
    file.create_virtual_dataset(name, layout)


@pytest.fixture
def secret(tmp_path):
    """Two files outside of the recording's folder that hold a text: a plain one and one of HDF5."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "plain").write_bytes(SECRET)
    with h5py.File(outside / "text.h5", "w") as file:
        file["text"] = np.array([SECRET])
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "link").symlink_to(outside)
    return outside


@pytest.mark.parametrize(
    "kind", ["raw", "raw by a link", "raw by ..", "virtual", "virtual by a link", "linked"]
)
@pytest.mark.parametrize(
    "place", ["/entry/title", "/entry/process/note", "/entry/instrument/detector/local_name"]
)
def test_no_text_outside_the_folder_is_read(tmp_path, secret, kind, place):
    path = record(sphere(), tmp_path / "home" / "theirs.h5")
    with h5py.File(path, "r+") as file:
        if place in file:
            del file[place]
        if kind == "linked":
            file[place] = h5py.ExternalLink(str(secret / "text.h5"), "/text")
        elif kind.startswith("virtual"):
            virtual_text(file, place, "link/text.h5" if kind.endswith("link") else secret / "text.h5")
        else:
            names = {"raw": secret / "plain", "raw by a link": "link/plain", "raw by ..": "../outside/plain"}
            text_in_raw_file(file, place, names[kind])
    with Hdf5File(path) as file, pytest.raises(io.InputError, match="leads out of its folder") as caught:
        file.value(file.follow(place, "no remedy"))
    assert SECRET.decode() not in str(caught.value)


@pytest.mark.parametrize("kind", ["raw", "virtual"])
def test_no_list_of_texts_outside_the_folder_is_read(tmp_path, secret, kind):
    path = tmp_path / "home" / "theirs.h5"
    with h5py.File(path, "w") as file:
        if kind == "raw":
            text_in_raw_file(file, "x", secret / "plain")
        else:
            virtual_text(file, "x", secret / "text.h5")
    with Hdf5File(path) as file, pytest.raises(io.InputError, match="leads out of its folder"):
        file.texts(file.find("/x"), "no remedy")


def test_no_text_outside_the_folder_is_shown(tmp_path, secret):
    path = record(sphere(), tmp_path / "home" / "theirs.h5")
    with h5py.File(path, "r+") as file:
        del file["/entry/title"]
        text_in_raw_file(file, "/entry/title", secret / "plain")
    with pytest.raises(io.InputError, match="leads out of its folder"):
        io.describe(path)


def test_no_text_outside_the_folder_is_exported(tmp_path, secret):
    path = record(sphere(), tmp_path / "home" / "theirs.h5")
    with h5py.File(path, "r+") as file:
        text_in_raw_file(file, "/entry/serial", secret / "plain")
    with pytest.raises(io.InputError, match="leads out of its folder"):
        io.save_zarr(path, tmp_path / "out.zarr")
    assert not (tmp_path / "out.zarr").exists()


def test_a_raw_file_of_that_name_in_the_working_directory_is_not_read(tmp_path, secret, monkeypatch):
    """HDF5 itself looks for raw files in the working directory first."""
    path = record(sphere(), tmp_path / "home" / "theirs.h5")
    (path.parent / "plain").write_bytes(b"x" * len(SECRET))
    with h5py.File(path, "r+") as file:
        text_in_raw_file(file, "/entry/serial", "plain")
    monkeypatch.chdir(secret)
    io.save_zarr(path, tmp_path / "out.zarr")
    with open_file(tmp_path / "out.zarr") as file:
        assert file.texts(file.find("/entry/serial"), "") == ("x" * len(SECRET),)


def test_a_pipe_in_place_of_a_raw_file_is_refused(tmp_path):
    """It would be read for ever."""
    os.mkfifo(tmp_path / "pipe")
    path = record(sphere(), tmp_path / "theirs.h5")
    with h5py.File(path, "r+") as file:
        del file["/entry/title"]
        text_in_raw_file(file, "/entry/title", "pipe")
    refused(path, "the raw storage of /entry/title leads to pipe, which is not a regular file")


def test_virtual_sources_in_raw_files_are_refused(path, tmp_path):
    with h5py.File(tmp_path / "part.h5", "w") as file:
        file.create_dataset("x", SHAPE, "u1", external=[("x.raw", 0, 280)])
    (tmp_path / "x.raw").write_bytes(STACK.tobytes())
    with h5py.File(path, "w") as file:
        layout = h5py.VirtualLayout(SHAPE, "u1")
        layout[...] = h5py.VirtualSource("part.h5", "x", SHAPE)
        file.create_virtual_dataset("x", layout)
    refused(path, "has sources in raw files, /x; copy the frames into one dataset")


def test_virtual_sources_that_are_a_pattern_are_refused(path, tmp_path):
    virtual(path, ["part%%b.h5"], length=8)
    refused(path, "names its sources by a pattern; copy the frames into one dataset")


def test_deeply_nested_groups_are_refused(path):
    with h5py.File(path, "w") as file:
        group = file
        for _ in range(hdf5._GROUPS_DEEP + 1):
            group = group.create_group("g")
    message = refused(path, r"theirs\.h5 has groups nested more than 64 deep")
    assert "Copy what is needed" in message


def test_too_many_objects_are_refused(path, monkeypatch):
    monkeypatch.setattr(hdf5, "_MOST_OBJECTS", 20)
    with h5py.File(path, "w") as file:
        for number in range(21):
            file.create_group(f"g{number}")
    refused(path, "has more than 20 groups, datasets and links")


def test_objects_come_once_and_in_order(path):
    with h5py.File(path, "w") as file:
        file["b/two"], file["a/one"] = STACK, STACK
        file["a/again"], file["b/round"] = file["b/two"], file["a"]
        file["soft"] = h5py.SoftLink("/a/one")
    with Hdf5File(path) as file:
        assert [name for name, _ in file.objects()] == ["/a", "/a/again", "/a/one", "/b"]


def packed_zeros(file, name, count):
    file.create_dataset(name, (count,), "u1", chunks=(count,), compression="gzip")[...] = 0


def test_values_of_a_small_file_take_limited_memory(path, monkeypatch):
    monkeypatch.setattr(hdf5, "VALUES_LIMIT", 1_500_000)
    with h5py.File(path, "w") as file:
        packed_zeros(file, "x", 1_000_000)
    with Hdf5File(path) as file:
        file.read(file.find("/x"), (1_000_000,))
        with pytest.raises(io.InputError, match=r"at least 2 MB in memory; at most 1\.5 MB are read"):
            file.read(file.find("/x"), (1_000_000,))
    with Hdf5File(path, memory_limit=3_000_000) as file:
        file.read(file.find("/x"), (1_000_000,))
        file.read(file.find("/x"), (1_000_000,))


def test_texts_that_share_their_bytes_are_counted_each(path, monkeypatch):
    monkeypatch.setattr(hdf5, "VALUES_LIMIT", 1_500_000)
    with h5py.File(path, "w") as file:
        file.create_dataset("x", (200,), h5py.string_dtype())[...] = ["x" * 10_000, *[""] * 199]
    with Hdf5File(path) as file, pytest.raises(io.InputError, match="values other than frames take"):
        file.texts(file.find("/x"), "no remedy")


def test_an_attribute_without_values_is_refused(path):
    with h5py.File(path, "w") as file:
        file.create_group("entry").attrs["mirrorskin_recording"] = np.empty(0, "S4")
    with pytest.raises(io.InputError, match="/entry: it is damaged"):
        io.describe(path)


def test_texts_of_any_length_in_a_virtual_dataset_are_refused(path, tmp_path):
    """HDF5 would read the heaps of other files, which may not end."""
    kind = h5py.string_dtype()
    with h5py.File(tmp_path / "part.h5", "w") as file:
        file.create_dataset("x", data=["a text"], dtype=kind)
    io.save_result(io.Result(height=np.zeros((4, 4), np.float32)), path)
    with h5py.File(path, "r+") as file:
        layout = h5py.VirtualLayout((1,), kind)
        layout[:] = h5py.VirtualSource("part.h5", "x", (1,), kind)
        file.create_virtual_dataset("/entry/process/source", layout)
    with pytest.raises(io.InputError, match="texts of any length in a virtual dataset"):
        io.open_result(path)
