"""The formats of other programs. Each is declared once, in its own module, and packages may add more.

A module of this folder declares a format as ``NAME = Format(...)`` with literal arguments: help texts and
errors list formats without importing their modules. An installed package names its own by an entry point in
the group `FORMATS`, such as ``mine = "my_package.my_format:MINE"``. Nothing heavy is imported here.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mirrorskin.io.base import declarations
from mirrorskin.io.base.url import is_zarr

if TYPE_CHECKING:
    from mirrorskin.io.model.frames import FrameReader

FORMATS = "mirrorskin.formats"
"""Group of entry points by which packages add formats."""

FOLDER = "/"
"""What stands for a folder among suffixes."""

_HERE = Path(__file__).parent
_OURS = (".h5", ".hdf5", ".nxs", ".mat", ".zarr", "")  # for which no package is asked
_NUMPY = (".npy", ".npz")
_MARK_BYTES = 4096  # bytes of a file in which a mark is looked for


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A format of files of other programs, with frames, for results, or both.

    Attributes
    ----------
    name : str
        What a file of it is, such as "TIFF".
    suffixes : tuple of str
        In lower case, such as ".tif"; `FOLDER` for folders.
    source : str
        How lists of sources of frames name it, such as "a video (AVI, MP4)"; "" if it has no frames.
    reader : str
        Name of the class that reads its frames, a `FrameReader`, in the module of the declaration. Its
        arguments are the path, and by name those of ``takes``.
    folder_mark : (str, bytes)
        Name of a file that shows that a folder is of this format, and a text at its start; ("", b"") if no
        folder is.
    has_positions : bool
        Whether files may contain positions or times of the frames.
    takes : tuple of str
        Which of the options "dataset", "channel", "memory_limit" and "verify" the reader takes.
    content : str
        What an exported file contains, such as "a mesh"; formats with the same content are listed together.
    encoder : str
        Name of the function that encodes a `Result`, in the module of the declaration. Its arguments are the
        result, and by name those of ``options``. It returns the parts of the file and a description. With
        ``writes_itself`` the arguments are the result and the path, and it returns the description.
    options : tuple of str
        Which of the options "map_name", "section", "points" and "float32" of ``export_result`` it takes.
    needs_heights : bool
        Whether heights in millimetres are needed to export it.
    writes_itself : bool
        Whether the encoder writes the file.
    decoder : str
        Name of the function that returns the `Result` of a file, in the module of the declaration. Its
        argument is the content of the file, bytes.
    signatures : tuple of bytes
        First bytes of the files that the decoder reads, by which they are recognised whatever their suffix.
    of_recordings : bool
        Whether the encoder takes a recording, too.
    recorder : str
        Name of the class that writes frames while they come, in the module of the declaration; "" if none
        does. See `mirrorskin.io.formats.mcap.GrowingMessages`.
    package, extra : str
        Package that its encoder and decoder need, and the extra of mirrorskin that installs it.
    exported : tuple of tuples of str
        Rows of the table of exports in the documentation: suffix and option, content, unit and where it is
        stated, holes, filled heights, programs that open it.
    decoded : tuple of str
        Row of the table of surfaces in the documentation: suffix, content that is read, unit and where it is
        stated, holes, position, what is refused.
    module : str
        Module of the declaration; it is set when the format is found.
    """

    name: str
    suffixes: tuple[str, ...]
    source: str = ""
    reader: str = ""
    folder_mark: tuple[str, bytes] = ("", b"")
    has_positions: bool = True
    takes: tuple[str, ...] = ()
    content: str = ""
    encoder: str = ""
    options: tuple[str, ...] = ()
    needs_heights: bool = True
    writes_itself: bool = False
    decoder: str = ""
    signatures: tuple[bytes, ...] = ()
    of_recordings: bool = False
    recorder: str = ""
    package: str = ""
    extra: str = ""
    exported: tuple[tuple[str, ...], ...] = ()
    decoded: tuple[str, ...] = ()
    module: str = ""

    def load(self, name: str) -> Any:
        """Return what is called so in the format's module."""
        return getattr(import_module(self.module), name)


@functools.cache
def _built_in() -> tuple[Format, ...]:
    """Return the formats that the modules of this folder, and that of our Zarr stores, declare."""
    files = (*sorted(_HERE.glob("*.py")), _HERE.parent / "files" / "result_file.py")
    return declarations.declared(Format, files, "mirrorskin.io")


def _installed() -> Iterator[Format]:
    """Yield the formats that installed packages add."""
    for point, form in declarations.installed(FORMATS, "format"):
        if not isinstance(form, Format):
            from mirrorskin.io.base.types import InputError

            raise InputError(f"{point.value}, in the entry points {FORMATS}, is no mirrorskin.io.Format")
        yield replace(form, module=point.module)


def formats(installed: bool = True) -> tuple[Format, ...]:
    """Return all formats, or the built-in ones."""
    return (*_built_in(), *(_installed() if installed else ()))


def _named(suffix: str, use: str) -> Format | None:
    """Return the format of a suffix that has a reader or an encoder; packages are only asked if none has."""

    def found(candidates: Iterable[Format]) -> Format | None:
        return next((form for form in candidates if suffix in form.suffixes and getattr(form, use)), None)

    return found(_built_in()) or (None if suffix in _OURS else found(_installed()))


def format_of_frames(path: Path) -> Format | None:
    """Return the format of a path with frames of another program; None for HDF5, Zarr and arrays."""
    if is_zarr(path):
        return None
    suffix = path.suffix.lower()
    with suppress(OSError):  # reported when it is opened
        if path.is_dir():
            suffix = FOLDER
            if form := next((form for form in _built_in() if marks_folder(form, path)), None):
                return form
    return None if suffix in _NUMPY else _named(suffix, "reader")


def marks_folder(form: Format, folder: Path) -> bool:
    """Return whether a folder contains the file that shows that it is of a format."""
    name, text = form.folder_mark
    if not name or not (folder / name).is_file():
        return False
    with (folder / name).open("rb") as file:
        return text in file.read(_MARK_BYTES)


def format_of_surface(path: Path) -> Format | None:
    """Return the format of a file with a surface of another program, by its content or its suffix."""
    if is_zarr(path):
        return None
    try:
        with path.open("rb") if path.is_file() else BytesIO() as file:
            head = file.read(_MARK_BYTES)
    except OSError:  # reported when it is opened
        head = b""
    by_content = (form for form in _built_in() if form.decoder and head.startswith(form.signatures))
    return next(by_content, None) or _named(path.suffix.lower(), "decoder")


def surfaces() -> str:
    """Return the names of the surfaces of other programs that are read, for help texts: "X3P, SUR or GSF"."""
    *names, last = (form.name for form in formats(installed=False) if form.decoder)
    return f"{', '.join(names)} or {last}"


def holds_arrays(path: Path) -> bool:
    """Return whether a path is a file of NumPy."""
    return not is_zarr(path) and path.suffix.lower() in _NUMPY and not path.is_dir()


def has_frames(path: Path) -> bool:
    """Return whether a file may contain a stack of frames, by its suffix."""
    form = format_of_frames(path)
    return (
        is_zarr(path)
        or holds_arrays(path)
        or (form.source != "" if form else path.suffix.lower() in _OURS[:-1])
    )


def is_of_others(path: Path) -> bool:
    """Return whether a path has frames in neither HDF5 nor Zarr, by its suffix or as a folder."""
    return holds_arrays(path) or format_of_frames(path) is not None


def open_reader(path: Path, form: Format, **options: Any) -> FrameReader:
    """Open frames of another program, with the options that are given and that its reader takes."""
    from mirrorskin.io.base.types import InputError

    for name in ("dataset", "channel"):
        if options.get(name) is not None and name not in form.takes:
            raise InputError(f"{path}: a {form.name} has no --{name}: leave it out")
    reader: FrameReader = form.load(form.reader)(path, **{name: options.get(name) for name in form.takes})
    return reader


def sources() -> str:
    """Return the sources of frames for help texts: "HDF5, ..., TIFF, MCAP, or a folder of pictures"."""
    others = sorted((form.source for form in formats(installed=False) if form.source), key=len)
    listed = ["HDF5", "Zarr", "NPY", "NPZ", *others]
    return ", ".join([*listed[:-1], f"or {listed[-1]}"])


def export_format(suffix: str) -> Format | None:
    """Return the format that results are exported to by a suffix."""
    return _named(suffix, "encoder")


def exports(installed: bool = True) -> dict[str, Format]:
    """Return the formats that results are exported to, by suffix; all, or the built-in ones."""
    return {suffix: form for form in formats(installed) if form.encoder for suffix in form.suffixes}


def export_suffixes(option: str = "") -> tuple[str, ...]:
    """Return the suffixes of exports, or of those that take an option.

    Examples
    --------
    >>> export_suffixes("points")
    ('.ply',)
    """
    return tuple(suffix for suffix, form in exports().items() if not option or option in form.options)


def contents() -> str:
    """Return the contents and suffixes of exports: "a mesh .ply .stl, points .xyz"."""
    kinds: dict[str, list[str]] = {}
    for suffix, form in exports(installed=False).items():
        kinds.setdefault(form.content, []).append(suffix)
    return ", ".join(f"{kind} {' '.join(suffixes)}" for kind, suffixes in kinds.items())


def missing_package(form: Format) -> str:
    """Return what is missing to export or read a format, with the remedy; "" if nothing is."""
    if not form.package or find_spec(form.package) is not None:
        return ""
    remedy = f"mirrorskin[{form.extra}]" if form.extra else form.package
    return f"the package {form.package}: pip install '{remedy}'"
