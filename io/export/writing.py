"""Files that are written in one go."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from mirrorskin.io.atomic import MAKE_ROOM, new_file
from mirrorskin.io.plain import plainly


def write_new(path: Path, parts: Sequence[bytes]) -> None:
    """Write the parts of a file, which exists whole or not at all.

    Raises
    ------
    InputError
        It cannot be written there.
    """
    with (
        new_file(path) as descriptor,
        plainly(f"{path} could not be written", MAKE_ROOM),
        os.fdopen(descriptor, "wb", closefd=False) as file,
    ):
        file.writelines(parts)
