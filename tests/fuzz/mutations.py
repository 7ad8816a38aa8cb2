"""Ways to damage a file: in its bytes, in its metadata, and in its kind."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import tifffile

NUMBERS = [0, 1, 2, 7, 8, 0xFF, 1 << 15, 1 << 31, (1 << 31) - 1, (1 << 32) - 1, 1 << 62, (1 << 63) - 1]
TEXTS = [
    "",
    "\x1b]0;title\x07\x1b[2J",
    "two\nlines\r\n\tand more",
    "\u03b4 \u5de5\u5177 \U0001f9ea",
    r"$\frac{1}{$ \unknown{",
    "<script>alert(1)</script>",
    "\u202eright to left\u2028",
    "x" * 100_000,
    "nan",
    "../../../etc/passwd",
]
WORDS = [
    "nan",
    "-inf",
    "1e308",
    "1e-320",
    "-1",
    "0",
    "1_0",
    "999999999999999999999",
    "\u0663",
    "x",
    "",
    "#",
    ",",
    "\x00",
    "\x1b[2J",
]

Mutation = Callable[[bytes, random.Random], bytes]


def damage(data: bytes, chance: random.Random) -> bytes:
    """Damage bytes in one of the ways that disks, copies and wires do."""
    mutable = bytearray(data)
    kind = chance.choice(["bits", "bytes", "number", "copy", "zeros", "cut"])
    for _ in range(chance.choice([1, 1, 1, 2, 4, 16]) if mutable else 0):
        at = chance.randrange(len(mutable))
        if kind == "bits":
            mutable[at] ^= 1 << chance.randrange(8)
        elif kind == "bytes":
            mutable[at] = chance.randrange(256)
        elif kind == "number":
            width, number = chance.choice([2, 4, 8]), chance.choice(NUMBERS)
            order = chance.choice(["little", "big"])
            mutable[at : at + width] = (number % (1 << 8 * width)).to_bytes(width, order)
        elif kind == "copy":
            start, length = chance.randrange(len(mutable)), chance.choice([8, 64, 512])
            mutable[at : at + length] = mutable[start : start + length]
        elif kind == "zeros":
            mutable[at : at + chance.choice([8, 64, 512])] = bytes(8)
        else:
            del mutable[at:]
            break
    return bytes(mutable)


def splice(data: bytes, other: bytes, chance: random.Random) -> bytes:
    """Put the end of another file after the start of one."""
    return data[: chance.randrange(len(data) + 1)] + other[chance.randrange(len(other) + 1) :]


def change_words(data: bytes, chance: random.Random) -> bytes:
    """Replace, repeat or drop words of a text."""
    words = re.split(r"(\s+|[,;=:/])", data.decode("utf-8", "replace"))
    for _ in range(chance.choice([1, 1, 2, 5])):
        at = chance.randrange(len(words))
        words[at] = chance.choice(
            [chance.choice(WORDS), chance.choice(TEXTS), words[at] * 2, chance.choice(words)]
        )
    return "".join(words).encode("utf-8", "replace")


def change_json(data: bytes, chance: random.Random) -> bytes:
    """Drop a key of JSON, or give it a value of another kind."""
    try:
        tree = json.loads(data)
    except ValueError:
        return damage(data, chance)
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        for key, value in list(node.items() if isinstance(node, dict) else enumerate(node)):
            places.append((node, key))
            if isinstance(value, dict | list):
                visit(value)

    if isinstance(tree, dict | list):
        visit(tree)
    if places:
        node, key = chance.choice(places)
        if isinstance(node, dict) and chance.random() < 0.3:
            del node[key]
        else:
            node[key] = chance.choice(
                [None, True, -1, 0, 1 << 40, 1e308, [], {}, [0], [1 << 20] * 3, *TEXTS, {"name": "pickle"}]
            )
    return json.dumps(tree).encode()


def odd_array(sound: np.ndarray, chance: random.Random) -> Any:
    """Return an array of another type, another shape, or with other values."""
    sound = np.asarray(sound)
    numbers = sound.astype(float) if sound.dtype.kind in "biuf" else np.arange(3.0)
    holes = numbers.copy()
    holes[chance.randrange(len(holes)) if holes.ndim and len(holes) else ...] = chance.choice(
        [np.nan, np.inf, -np.inf, 1e308, -1e30, 1e-320]
    )
    return chance.choice(
        [
            lambda: numbers.astype(
                chance.choice(["f2", "f4", "f8", "i1", "i8", "u1", ">u2", ">f4", "c16", "?"])
            ),
            lambda: holes,
            lambda: np.full_like(numbers, chance.choice([np.nan, np.inf, 0, 1e308, -1])),
            lambda: numbers.T,
            lambda: numbers[None],
            lambda: numbers[..., None],
            lambda: np.atleast_1d(numbers)[:0],
            lambda: np.atleast_1d(numbers)[:1],
            lambda: np.atleast_1d(numbers)[:-1],
            lambda: np.concatenate([numbers, numbers]) if numbers.ndim else numbers,
            lambda: np.float64(chance.choice([np.nan, 1e308, 0, -1])),
            lambda: chance.choice(TEXTS),
        ]
    )()


def change_hdf5(data: bytes, chance: random.Random) -> bytes:
    """Drop, replace or add an object or an attribute of HDF5."""
    memory = io.BytesIO(data)
    names: list[str] = []
    with h5py.File(memory, "r+") as file:
        file.visit(names.append)
        for _ in range(chance.choice([1, 1, 1, 2, 4])):
            name = chance.choice(names)
            with suppress(RuntimeError):  # a link that was made here leads to itself
                node = file.get(name)
                if node is not None:
                    _change_node(file, name, node, chance)
    return memory.getvalue()


def _change_node(file: h5py.File, name: str, node: Any, chance: random.Random) -> None:
    if len(node.attrs) and chance.random() < 0.2:
        key = chance.choice(list(node.attrs))
        if chance.random() < 0.5:
            del node.attrs[key]
        else:
            odd = [
                1 << 40,
                np.nan,
                0,
                -1.5,
                np.arange(3),
                np.empty(0),
                "\x1b[2J",
                "mm",
                "\u5de5",
                np.float32(2),
            ]
            value = chance.choice(odd)
            node.attrs[key] = value
        return
    kind = chance.choice(["drop", "group", "odd", "odd", "odd", "text", "text", "link", "packed"])
    value = node[()] if isinstance(node, h5py.Dataset) else np.arange(3.0)
    del file[name]
    if kind == "group":
        file.create_group(name)
    elif kind == "text":
        text = chance.choice(TEXTS).replace("\x00", "")
        file[name] = np.array(text.encode() or b"\0") if chance.random() < 0.5 else text
    elif kind == "link":
        file[name] = chance.choice(
            [h5py.SoftLink("/entry"), h5py.SoftLink("/gone"), h5py.SoftLink(f"/{name}")]
        )
    elif kind != "drop":
        changed = odd_array(value, chance) if kind == "odd" else np.asarray(value)
        packed = (
            kind == "packed"
            and np.ndim(changed)
            and np.size(changed)
            and np.asarray(changed).dtype.kind in "iuf"
        )
        if packed:
            file.create_dataset(name, data=changed, chunks=True, compression="gzip")
        else:
            file[name] = changed


def change_npz(data: bytes, chance: random.Random) -> bytes:
    """Drop, rename or replace a member of an archive of arrays."""
    with np.load(io.BytesIO(data)) as archive:
        arrays: dict[str, Any] = dict(archive)
    name, save = chance.choice(list(arrays)), chance.choice([np.savez, np.savez_compressed])
    kind = chance.choice(["drop", "rename", "odd", "odd", "bytes"])
    value = arrays.pop(name)
    if kind == "rename":
        arrays[chance.choice(["frames", "dark", "x", "\x1b[2J", "\u5de5", "a/b", "travel"])] = value
    elif kind == "odd":
        arrays[name] = odd_array(value, chance)
    memory = io.BytesIO()
    save(memory, **arrays)
    if kind == "bytes":
        with zipfile.ZipFile(memory, "a") as zipped:
            zipped.writestr(f"{name}.npy", damage(npy(value), chance))
    return memory.getvalue()


def npy(array: Any) -> bytes:
    """Return an array as NumPy saves it."""
    memory = io.BytesIO()
    np.save(memory, array, allow_pickle=False)
    return memory.getvalue()


def change_npy(data: bytes, chance: random.Random) -> bytes:
    """Replace an array by an odd one, or change a word of its header."""
    if chance.random() < 0.5:
        return npy(odd_array(np.load(io.BytesIO(data)), chance))
    head, rest = data[:10], data[10:]
    stop = int.from_bytes(head[8:10], "little")
    changed = change_words(rest[:stop], chance)
    return head[:8] + (len(changed) % 65536).to_bytes(2, "little") + changed + rest[stop:]


def change_png(data: bytes, chance: random.Random) -> bytes:
    """Damage what the chunks of a PNG hold, with sound checksums; or make a picture of another kind."""
    if chance.random() < 0.4:
        values = np.asarray(odd_picture(chance))
        return cv2.imencode(chance.choice([".png", ".jpg", ".webp", ".bmp"]), values)[1].tobytes()
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    victim = chance.randrange(len(chunks))
    kind, body = chunks[victim]
    chunks[victim] = kind, damage(body, chance)
    if chance.random() < 0.2:
        chunks.insert(victim, chance.choice(chunks))
    return data[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def odd_picture(chance: random.Random) -> np.ndarray:
    """Return a picture that OpenCV can write."""
    rows, columns = chance.choice([(20, 24), (20, 24), (1, 1), (24, 20), (3, 200)])
    shape: tuple[int, ...] = chance.choice(
        [(rows, columns), (rows, columns), (rows, columns, 3), (rows, columns, 4)]
    )
    values = np.arange(np.prod(shape)).reshape(shape) * chance.choice([0, 1, 7, 255])
    return values.astype(chance.choice([np.uint8, np.uint16]))


def change_tiff(data: bytes, chance: random.Random) -> bytes:
    """Make a TIFF of another kind: depth, channels, pages, packing."""
    memory, values = io.BytesIO(), odd_picture(chance)
    depth = chance.choice(["u1", "u2", "i2", "u4", "f2", "f4", "f8", "?", "c8"])
    options: dict[str, Any] = {"compression": chance.choice([None, "zlib"]), "bigtiff": chance.random() < 0.3}
    with tifffile.TiffWriter(memory, bigtiff=options.pop("bigtiff")) as file:
        for _ in range(chance.choice([1, 1, 2, 4])):
            if chance.random() < 0.1:
                values = values[:-1] if len(values) > 1 else values
            with np.errstate(over="ignore"):
                page = values.astype(depth)
            file.write(page, description="\x1b[2J", metadata=None, **options)
    return memory.getvalue()


SEMANTIC: dict[str, Mutation] = {
    ".h5": change_hdf5,
    ".npz": change_npz,
    ".npy": change_npy,
    ".png": change_png,
    ".tif": change_tiff,
    ".json": change_json,
    ".toml": change_words,
    ".csv": change_words,
    ".obj": change_words,
    ".words": change_words,
    ".txt": change_words,
}
"""What changes the meaning of files, by their suffix."""


def mutate(path: Path, whole: dict[Path, bytes], chance: random.Random) -> bytes:
    """Return a file of this name that is damaged, spliced, empty, of another kind, or means something odd."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy and tifffile warn of what is meant to be odd
        return _mutated(path, whole, chance)


def _mutated(path: Path, whole: dict[Path, bytes], chance: random.Random) -> bytes:
    data = whole[path]
    semantic = SEMANTIC.get(path.suffix)
    ascii_mesh = path.suffix in (".ply", ".stl") and path.stem.startswith("ascii")
    if ascii_mesh:
        semantic = change_words
    kind = chance.choices(
        ["bytes", "semantic", "splice", "other", "empty"], [10, 10 if semantic else 0, 2, 1, 0.1]
    )[0]
    if kind == "semantic" and semantic is not None:
        changed = semantic(data, chance)
        return damage(changed, chance) if chance.random() < 0.1 else changed
    if kind in ("splice", "other"):
        alike = [other for other in whole if (other.suffix == path.suffix) == (kind == "splice")]
        other = whole[chance.choice(alike)] if alike else data
        return splice(data, other, chance) if kind == "splice" else other
    return damage(data, chance) if kind == "bytes" else b""
