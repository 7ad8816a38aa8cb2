"""What a dataset claims against what its file holds, before any memory is taken for it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import h5py

from mirrorskin.io.plain import plainly
from mirrorskin.io.types import InputError

if TYPE_CHECKING:
    from mirrorskin.io.hdf5 import Hdf5File

_VIRTUAL_DEEP = 4


def check_storage(file: Hdf5File, dataset: h5py.Dataset, depth: int = 0, frames: int | None = None) -> None:
    """Refuse a dataset that HDF5 could not deliver, or would make up with fill values.

    Parameters
    ----------
    file : Hdf5File
        Knows where it may look for what is stored elsewhere.
    dataset : h5py.Dataset
    depth : int, optional
        How many virtual datasets led here.
    frames : int, optional
        How many there must be, along the first axis, where more are yet to be written.

    Raises
    ------
    InputError
        A filter that is not installed, chunks too large to unpack, or less data than the shape says.
    """
    if depth > _VIRTUAL_DEEP:
        where = file.where(dataset)
        raise InputError(f"{where}: virtual datasets are nested too deeply; copy the frames into one dataset")
    with plainly(lambda: file.where(dataset)):
        shape, offset = dataset.id.shape, dataset.id.get_offset()
        if frames is not None:
            shape = (frames, *shape[1:])
        claimed, unit = math.prod(shape) * dataset.id.dtype.itemsize, "bytes"
        if offset is not None:
            held = h5py.h5i.get_file_id(dataset.id).get_filesize() - offset
        elif dataset.chunks and not dataset.is_virtual:
            _check_filters(dataset, file.where(dataset), file.memory_limit)
            claimed = math.prod(-(-n // c) for n, c in zip(shape, dataset.chunks, strict=True))
            held, unit = dataset.id.get_num_chunks(), "chunks"
        else:
            held = _bytes_held(file, dataset, depth)
    if held < claimed:
        raise InputError(
            f"{file.where(dataset)} claims {claimed} {unit} and its file holds {held}: it was cut short; "
            "copy it again"
        )


def describe_storage(dataset: h5py.Dataset) -> str:
    """Tell how a dataset is stored, for people."""
    if dataset.is_virtual:
        return "virtual"
    if dataset.chunks is None:
        return "in raw files" if dataset.external else "in one piece"
    names = [name.split(";")[0].strip() or str(code) for code, name in _filters(dataset)]
    return f"chunks {dataset.chunks}, {', '.join(names) or 'raw'}"


def _filters(dataset: h5py.Dataset) -> list[tuple[int, str]]:
    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(i) for i in range(plist.get_nfilters())]
    return [(code, name.decode(errors="replace")) for code, _, _, name in filters]


def _check_filters(dataset: h5py.Dataset, where: str, memory_limit: int | None) -> None:
    filters = _filters(dataset)
    if not all(h5py.h5z.filter_avail(code) for code, _ in filters):
        import hdf5plugin  # noqa: F401  # which registers bitshuffle, blosc and others with HDF5
    for code, name in filters:
        if not h5py.h5z.filter_avail(code):
            raise InputError(
                f"{where} is packed with filter {code} ({name or 'unnamed'}), which is not installed: "
                "install its HDF5 plugin and name its folder in HDF5_PLUGIN_PATH"
            )
    # A frame needs room in any case, however it is packed.
    several = filters and dataset.ndim > 2 and dataset.chunks[0] > 1
    size = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    if several and memory_limit is not None and size > memory_limit:
        raise InputError(
            f"{where} is packed in chunks of {size / 1e6:.3g} MB where memory is limited to "
            f"{memory_limit / 1e6:.3g} MB: raise --memory, or repack it with h5repack in chunks of one frame"
        )


def _bytes_held(file: Hdf5File, dataset: h5py.Dataset, depth: int) -> int:
    """Return what there is of a dataset that lies elsewhere, in its header, or nowhere yet."""
    if dataset.is_virtual:
        elements = sum(_mapped(file, dataset, part, depth) for part in dataset.virtual_sources())
        return elements * int(dataset.dtype.itemsize)
    if dataset.external:
        what = f"the raw storage of {dataset.name}"
        parts = [(file.beside(dataset, name, what), offset, size) for name, offset, size in dataset.external]
        return sum(min(size, max(0, path.stat().st_size - offset)) for path, offset, size in parts)
    return int(dataset.id.get_storage_size())


def virtual_source(file: Hdf5File, dataset: h5py.Dataset, part: Any) -> h5py.Dataset:
    """Return the dataset that a part of a virtual one comes from; InputError if it is not there."""
    what = f"the virtual dataset {dataset.name}"
    origin = dataset.file if part.file_name == "." else file.open_beside(dataset, part.file_name, what)
    source = file.walk(origin, part.dset_name)
    if not isinstance(source, h5py.Dataset):
        raise InputError(f"{file.where(dataset)} needs {part.dset_name} of {part.file_name}: it is not there")
    return source


def _mapped(file: Hdf5File, dataset: h5py.Dataset, part: Any, depth: int) -> int:
    """Return how many elements of a virtual dataset one of its sources holds."""
    source = virtual_source(file, dataset, part)
    check_storage(file, source, depth + 1)
    selected = part.src_space
    if selected.get_select_type() == h5py.h5s.SEL_ALL:
        return min(int(part.vspace.get_select_npoints()), int(source.size))
    if selected.is_regular_hyperslab() and any(
        h5py.h5s.UNLIMITED in numbers for numbers in selected.get_regular_hyperslab()
    ):
        return int(source.size)
    _, last = selected.get_select_bounds()
    reaches = all(end < count for end, count in zip(last, source.shape, strict=True))
    return int(part.vspace.get_select_npoints()) if reaches else 0
