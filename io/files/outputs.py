"""Whether the file of a result can be written."""

from __future__ import annotations

from pathlib import Path

from mirrorskin.io.base.system import as_input_error
from mirrorskin.io.base.types import InputError
from mirrorskin.io.base.url import ZARR_SUFFIX, is_zarr
from mirrorskin.io.formats.registry import export_format
from mirrorskin.io.storage.atomic import check_output
from mirrorskin.io.storage.existing import Replaces

_OTHER_FORMATS = {  # suffixes that a result cannot have, with the command that makes one from it
    **dict.fromkeys(("pdf", "svg"), "view"),
    "html": "report",
    **dict.fromkeys(("jpg", "jpeg", "npy", "avi", "mp4", "json", "toml"), ""),
}


def check_result_output(path: Path, *keep: Path | None, overwrite: bool = False) -> None:
    """Raise InputError for a result, HDF5 or Zarr, that could not be written, before any work is done.

    Parameters
    ----------
    path : Path
        File to write, or Zarr store, which must not exist.
    *keep : Path or None
        Inputs; see `check_output`.
    overwrite : bool
        Whether an existing file that can be computed again may be replaced.

    Raises
    ------
    InputError
        See `check_output`; or the suffix belongs to another format.

    Examples
    --------
    >>> check_result_output(Path("result.h5"), Path("press.h5"))  # doctest: +SKIP
    """
    if is_zarr(path) and path.suffix.lower() == ZARR_SUFFIX:
        from mirrorskin.io.files.zarr_export import check_store

        with as_input_error(f"{path} cannot be written", "choose another place with -o"):
            check_store(path)
        return
    _check_format(path)
    check_output(path, *keep, replaces=replaced_by_result(overwrite))


def replaced_by_result(overwrite: bool) -> Replaces:
    """Return which existing files a new result may replace."""
    return "derived" if overwrite else "unused"


def _check_format(path: Path) -> None:
    """Raise InputError if the suffix of a result belongs to another format."""
    suffix = path.suffix.lower().removeprefix(".")
    if suffix in _OTHER_FORMATS or export_format(path.suffix.lower()) is not None:
        command = _OTHER_FORMATS.get(suffix, "export")
        then = f", then 'mirrorskin {command}' makes .{suffix} of it" if command else ""
        raise InputError(f"{path}: a result is HDF5 (.h5) or Zarr (.zarr): write it so{then}")
