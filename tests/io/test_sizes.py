"""Small files that claim gigabytes are refused before memory is allocated."""

import io as memory
import resource
import shutil
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib

import av
import cv2
import h5py
import hdf5plugin
import numpy as np
import pytest
import tifffile
from numcodecs import blosc
from PIL import Image as pil  # noqa: N813

from mirrorskin import io
from mirrorskin.io.base import system
from mirrorskin.io.files.arrays import ArrayRecording, read_array, read_map
from mirrorskin.io.formats.pictures import decode_bytes, read_picture
from mirrorskin.io.storage.hdf5 import Hdf5File

POSITIONS = {"motion": "vertical", "travel": io.Steps(0.1)}


def head(shape, dtype="|u1"):
    """Return the header that NumPy writes before an array."""
    file = memory.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": dtype, "fortran_order": False, "shape": tuple(shape)}
    )
    return file.getvalue()


def bomb(path, shape, stated=None):
    """Write an archive of zeros, of which another shape may be stated."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frames.npy", head(stated or shape) + bytes(np.prod(shape, dtype=int)))
    return path


def small_archive(path, **more):
    np.savez_compressed(path, frames=np.zeros((3, 8, 8), np.uint8), travel=np.arange(3.0), **more)
    return path


def test_an_archive_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = bomb(tmp_path / "bomb.npz", (64, 1024, 1024))
    assert path.stat().st_size < 1 << 20
    monkeypatch.setattr("mirrorskin.io.files.arrays.MAX_UNPACKED_BYTES", 1 << 20)
    tracemalloc.start()
    with pytest.raises(io.InputError, match=f"takes {64 << 20} bytes of memory, and at most {1 << 20} are"):
        io.open_recording(path, **POSITIONS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


def test_the_memory_limit_raises_what_an_archive_may_take(tmp_path, monkeypatch):
    path = small_archive(tmp_path / "a.npz")
    monkeypatch.setattr("mirrorskin.io.files.arrays.MAX_UNPACKED_BYTES", 100)
    with pytest.raises(io.InputError, match=r"raise --memory, or write it with numpy\.savez"):
        io.open_recording(path, **POSITIONS)
    with io.open_recording(path, memory_limit=300, **POSITIONS) as recording:
        assert recording.shape == (3, 8, 8)


def test_an_archive_that_is_not_compressed_has_no_limit(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", frames=np.zeros((3, 8, 8), np.uint8))
    monkeypatch.setattr("mirrorskin.io.files.arrays.MAX_UNPACKED_BYTES", 10)
    with io.open_recording(tmp_path / "a.npz", **POSITIONS) as recording:
        assert recording.shape == (3, 8, 8)


def test_arrays_that_are_not_needed_are_not_read(tmp_path):
    path = small_archive(tmp_path / "a.npz")
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("other.npy", head((1 << 40,)))
    with io.open_recording(path, **POSITIONS) as recording:
        assert recording.frame(2).shape == (8, 8)


@pytest.mark.parametrize("stated", [(1 << 40, 8, 8), (2, 8, 8), (1 << 62, 1 << 62, 8), (0, 8, 8)])
def test_a_header_that_disagrees_with_the_archive_is_refused(tmp_path, stated):
    path = bomb(tmp_path / "a.npz", (3, 8, 8), stated)
    with pytest.raises(io.InputError, match="bytes of values and has another number"):
        io.open_recording(path, **POSITIONS)


def test_a_header_without_end_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frames.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 31) + bytes(1 << 26))
    for read in (io.describe, lambda path: io.open_recording(path, **POSITIONS)):
        with pytest.raises(io.InputError, match="is not a NumPy array"):
            read(tmp_path / "a.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_an_archive_that_numpy_does_not_write_is_refused(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.writestr("frames.npy", head((3, 8, 8)) + bytes(192))
    with pytest.raises(io.InputError, match="is compressed by method"):
        io.open_recording(tmp_path / "a.npz", **POSITIONS)


@pytest.mark.parametrize("shape", [(1 << 40, 8, 8), (1 << 62, 1 << 62, 1 << 62), (-1, 8, 8)])
def test_an_array_file_that_states_more_than_it_has_is_refused(tmp_path, shape):
    (tmp_path / "a.npy").write_bytes(head(shape) + bytes(64))
    for read in (lambda path: io.open_recording(path, **POSITIONS), read_array):
        with pytest.raises(io.InputError, match="is not a NumPy array of numbers"):
            read(tmp_path / "a.npy")


@pytest.mark.parametrize("name", ["a.npy", "b.npy"])
def test_an_array_file_that_is_an_archive_is_refused(tmp_path, name):
    with (tmp_path / name).open("wb") as file:
        (np.savez if name == "a.npy" else np.savez_compressed)(file, frames=np.zeros((3, 8, 8)))
    for read in (io.describe, read_array, lambda path: io.open_recording(path, **POSITIONS)):
        with pytest.raises(io.InputError, match="is not a NumPy array"):
            read(tmp_path / name)


def png(width, height, depth=16, colour=2):
    """Return a PNG that states its size and holds a few bytes of zeros."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    start = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", start)
        + chunk(b"IDAT", zlib.compress(bytes(99)))
        + chunk(b"IEND", b"")
    )


def jpeg(width, height):
    """Return the start of a progressive JPEG that states its size."""
    frame = struct.pack(">BHHB", 8, height, width, 1) + b"\x01\x11\x00"
    return b"\xff\xd8\xff\xe0\x00\x04ab\xff\xc2" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


def test_a_picture_that_states_gigabytes_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(png(30_000, 30_000))
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((9, 9), np.uint8))
    data = (tmp_path / "a.tif").read_bytes()
    for tag in (256, 257):  # width and height
        at = data.index(struct.pack("<HH", tag, 3 if struct.pack("<HH", tag, 3) in data else 4))
        data = data[: at + 2] + struct.pack("<HII", 4, 1, 60_000) + data[at + 12 :]
    (tmp_path / "a.tif").write_bytes(data)
    for name in ("a.png", "a.tif"):
        with pytest.raises(io.InputError, match=rf"{name}.*a picture of .*000 takes \d+ bytes of memory"):
            read_picture(tmp_path / name)


def test_a_compressed_image_that_states_gigabytes_is_refused():
    for data in (png(60_000, 60_000, 8, 0), jpeg(60_000, 60_000)):
        with pytest.raises(io.InputError, match="bytes of memory"):
            decode_bytes(data, "an image")


@pytest.mark.parametrize(
    "data",
    [b"", b"\xff\xd8", b"\xff\xd8\xff\xff\xff", b"BM" + bytes(60), b"P5 9 9 9 ", b"GIF89a" + bytes(60)],
)
def test_a_compressed_image_of_another_kind_is_refused(data):
    with pytest.raises(io.InputError, match=r"^an image is ") as refusal:
        decode_bytes(data, "an image")
    assert "\n" not in str(refusal.value)


def test_a_folder_of_pictures_that_decoders_cannot_hold_is_refused(tmp_path):
    for number in range(3):
        (tmp_path / f"frame{number}.png").write_bytes(png(30_000, 30_000, 8, 0))
    with pytest.raises(io.InputError, match=r"frame0\.png: a picture of .* takes \d+ bytes of memory"):
        io.open_recording(tmp_path, **POSITIONS)


def test_a_map_is_refused_if_its_float32_copy_is_too_large(tmp_path, monkeypatch):
    cv2.imwrite(str(tmp_path / "dark.png"), np.zeros((300, 300), np.uint8))
    monkeypatch.setattr("mirrorskin.io.base.system.check_unpacked.__defaults__", (4 * 90_000,))
    with pytest.raises(io.InputError, match=r"dark\.png, as float32, takes 450000 bytes of memory"):
        read_map(tmp_path / "dark.png")


# Reads the pictures, arrays, messages or videos named, and prints the largest size that was compared with the
# limit, and how much memory was taken at the same time.
MEASURE = """
import gc, sys
from pathlib import Path
import cv2, av, mcap.stream_reader, mcap_ros2.decoder, tifffile
import numpy as np
from mirrorskin import io
from mirrorskin.io.files import arrays
from mirrorskin.io.formats import mcap
from mirrorskin.io.base import opencv
from mirrorskin.io.base import system
from mirrorskin.io.formats import video

def status(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(name)).split()[1])

def read(path):
    with io.open_recording(path, memory_limit=1, motion="vertical", travel=io.Steps(0.1)) as recording:
        out = np.empty((1, *recording.shape[1:]), recording.dtype)
        while recording.read(out) is not None:
            pass

read(sys.argv[1])  # imports, and what libraries keep
counted = []
for module in (arrays, mcap, opencv, video):
    module.check_unpacked = lambda size, *_: counted.append(size)
for path in sys.argv[2:]:
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    before = status("VmRSS")
    counted.clear()
    read(path)
    print(Path(path).name, max(counted), status("VmHWM") - before)
"""

SIDE = 3000  # pixels along each side of a picture: 9 MB, more than Python itself takes meanwhile


def bands(count):
    """Return frames of bands, which are packed in no time."""
    return np.broadcast_to(np.arange(SIDE, dtype=np.uint8), (count, SIDE, SIDE)).copy()


def large_pictures(folder):
    """Write folders of two pictures each: of every kind, and one with pictures of several kinds."""
    grey = bands(1)[0]
    colours = np.stack([grey, grey[::-1], grey[:, ::-1]], axis=-1)
    deep, packed = grey.astype(np.uint16) * 300, {"compression": "deflate"}
    writers = {
        "grey.png": lambda path: cv2.imwrite(path, grey),
        "deep.png": lambda path: cv2.imwrite(path, deep),
        "colours.png": lambda path: cv2.imwrite(path, colours),
        "opacity.png": lambda path: cv2.imwrite(path, np.dstack([colours, grey])),
        "table.png": lambda path: pil.fromarray(grey).convert("P").save(path),
        "grey.bmp": lambda path: cv2.imwrite(path, grey),
        "colours.bmp": lambda path: cv2.imwrite(path, colours),
        "deep.pgm": lambda path: cv2.imwrite(path, deep),
        "colours.jpg": lambda path: pil.fromarray(colours).save(path),
        "progressive.jpg": lambda path: pil.fromarray(colours).save(path, progressive=True),
        "plain.tif": lambda path: tifffile.imwrite(path, grey),
        "swapped.tif": lambda path: tifffile.imwrite(path, deep, byteorder=">"),
        "piece.tif": lambda path: tifffile.imwrite(path, deep, rowsperstrip=SIDE, **packed),
        "tiles.tif": lambda path: tifffile.imwrite(path, deep, tile=(256, 256), **packed),
        "colours.tif": lambda path: tifffile.imwrite(path, colours, photometric="rgb", **packed),
    }
    for name, write in writers.items():
        (folder / name).mkdir()
        for number in range(2):
            write(str(folder / name / f"frame{number}{name[-4:]}"))
    several = folder / "several"
    several.mkdir()
    for number, name in enumerate(("grey.png", "grey.bmp", "plain.tif")):
        shutil.copy(folder / name / f"frame0{name[-4:]}", several / f"frame{number}{name[-4:]}")
    return [*(folder / name for name in writers), several]


def large_files(folder):
    """Write archives, messages and videos with pictures of the same size."""
    frames = bands(2)
    np.savez_compressed(folder / "a.npz", frames=frames)
    np.savez_compressed(folder / "converted.npz", frames=frames.astype(np.float64))
    with ArrayRecording(frames, {"travel": np.arange(2.0)}, {}) as source:
        io.save_messages(source, folder / "a.mcap")
    for name, codec, kind in (("a.mp4", "libx264", "yuv420p"), ("a.mkv", "ffv1", "gray")):
        with av.open(str(folder / name), "w") as film:
            stream = film.add_stream(codec, rate=25)
            stream.width = stream.height = SIDE
            stream.pix_fmt = kind
            for frame in frames:
                film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "gray").reformat(format=kind)))
            film.mux(stream.encode())
    return [folder / name for name in ("a.npz", "converted.npz", "a.mcap", "a.mp4", "a.mkv")]


@pytest.mark.slow
@pytest.mark.parametrize("write", [large_pictures, large_files])
def test_the_size_that_is_checked_covers_all_memory_that_is_taken(tmp_path, write):
    paths = write(tmp_path)
    command = [sys.executable, "-c", MEASURE, *map(str, [paths[0], *paths])]
    measured = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    slack = 6 << 20  # of libraries and Python itself
    rows = [line.split() for line in measured.splitlines()]
    assert [name for name, counted, taken in rows if int(taken) > int(counted) + slack] == [], measured
    assert len(rows) == len(paths)


def test_the_limit_is_what_the_documentation_states():
    assert system.MAX_UNPACKED_BYTES == 1 << 30


HEAD = struct.pack(">IIBBBBB", 16, 16, 8, 0, 0, 0, 0)


@pytest.mark.parametrize(
    "chunks",
    [
        [(b"IHDR", HEAD), (b"IHDR", HEAD), (b"IDAT", zlib.compress(bytes(16 * 17)))],
        [(b"IHDR", HEAD), (b"IDAT", zlib.compress(bytes(16 * 17 - 1)))],
        [(b"IHDR", HEAD), (b"IDAT", b"no deflate")],
        [(b"IHDR", HEAD)],
    ],
)
def test_a_png_that_is_not_one_whole_picture_is_refused_before_libpng_prints(chunks, capfd):
    whole = [(b"IHDR", HEAD), (b"IDAT", zlib.compress(bytes(16 * 17)))]
    assert decode_bytes(png_of(whole), "an image").samples.shape == (16, 16)
    with pytest.raises(io.InputError, match="it is not one picture of 16 x 16"):
        decode_bytes(png_of(chunks), "an image")
    assert capfd.readouterr().err == ""


def png_of(chunks):
    """Return a PNG of these chunks, and its end."""
    actual = b"\x89PNG\r\n\x1a\n"
    for kind, data in [*chunks, (b"IEND", b"")]:
        actual += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return actual


@pytest.mark.parametrize("kind", ["L", "LA", "RGB", "RGBA", "P", "1", "I;16"])
def test_pngs_of_every_kind_are_read(tmp_path, kind):
    picture = pil.new(kind, (13, 7))
    picture.save(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png").shape == (7, 13)


@pytest.mark.parametrize("columns", [1, 2, 3, 5, 8, 13])
def test_interlaced_pngs_are_read(columns):
    rows = 9
    passes = [
        (0, 0, 8, 8),
        (4, 0, 8, 8),
        (0, 4, 4, 8),
        (2, 0, 4, 4),
        (0, 2, 2, 4),
        (1, 0, 2, 2),
        (0, 1, 1, 2),
    ]
    sizes = [(len(range(x, columns, dx)), len(range(y, rows, dy))) for x, y, dx, dy in passes]
    size = sum(high * (1 + wide) for wide, high in sizes if wide)
    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 1)
    whole = png_of([(b"IHDR", head), (b"IDAT", zlib.compress(bytes(size)))])
    assert decode_bytes(whole, "an image").samples.shape == (rows, columns)
    with pytest.raises(io.InputError, match="it is not one picture"):
        decode_bytes(png_of([(b"IHDR", head), (b"IDAT", zlib.compress(bytes(size - 1)))]), "an image")


@pytest.mark.parametrize(
    ("packing", "pack"),
    [
        ({"compression": "gzip"}, zlib.compress),
        ({"compression": "gzip", "shuffle": True}, zlib.compress),
        (hdf5plugin.Blosc(), lambda values: blosc.compress(values, b"lz4", 5)),
        (hdf5plugin.Bitshuffle(), lambda values: struct.pack(">QI", len(values), 4096) + bytes(1000)),
    ],
)
def test_packed_values_take_no_more_memory_than_they_state(tmp_path, packing, pack):
    """HDF5's own filters would unpack all 64 MiB of a chunk that states 1000 bytes."""
    path, bomb = tmp_path / "a.h5", pack(bytes(1 << 26))
    with h5py.File(path, "w") as file:
        values = file.create_dataset("entry/x", (3000,), "u1", chunks=(1000,), **packing)
        for start in range(0, 3000, 1000):
            values.id.write_direct_chunk((start,), bomb)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with Hdf5File(path) as file, pytest.raises(io.InputError, match="/entry/x: it is damaged"):
        file.read(file.find("/entry/x"), (3000,))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 16 << 10


@pytest.mark.parametrize("packing", [hdf5plugin.LZ4(), hdf5plugin.BZip2(), {"scaleoffset": 0}])
def test_values_that_only_hdf5_unpacks_are_refused(tmp_path, packing):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", data=np.arange(3000), chunks=(1000,), **packing)
    with Hdf5File(tmp_path / "a.h5") as file, pytest.raises(io.InputError, match="supported for frames only"):
        file.read(file.find("/x"), (3000,))


@pytest.mark.parametrize(
    "packing", [{"compression": "gzip", "fletcher32": True, "shuffle": True}, {"lzf": 1}]
)
def test_packed_values_are_what_hdf5_gives(tmp_path, packing):
    packing = {"compression": "lzf"} if "lzf" in packing else packing
    values = np.random.default_rng(0).normal(size=(13, 17))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", data=values, chunks=(4, 17), maxshape=(None, 17), **packing)
        file.create_dataset("big", data=values.astype(">f4"), chunks=(5, 6), **packing)
    with Hdf5File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file.read(file.find("/x"), values.shape), values)
        np.testing.assert_array_equal(file.read(file.find("/x"), (6, 17), rows=6), values[:6])
        np.testing.assert_array_equal(file.read(file.find("/big"), values.shape), values.astype("f4"))


def test_packed_values_of_a_virtual_dataset_are_refused(tmp_path):
    with h5py.File(tmp_path / "part.h5", "w") as file:
        file.create_dataset("x", data=np.arange(30), compression="gzip")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        layout = h5py.VirtualLayout((30,), int)
        layout[:] = h5py.VirtualSource("part.h5", "x", (30,))
        file.create_virtual_dataset("x", layout)
    with Hdf5File(tmp_path / "a.h5") as file, pytest.raises(io.InputError, match="supported for frames only"):
        file.read(file.find("/x"), (30,))
