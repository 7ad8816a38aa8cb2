"""Pictures for printing: PNG that says how large its pixels are."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.atomic import MAKE_ROOM, new_file
from mirrorskin.io.plain import plainly
from mirrorskin.io.sequence import quiet_opencv

_HEAD = 33  # bytes of PNG's mark and its first chunk, after which the pixels' size may be told
_INCH = 0.0254


def save_print(picture: NDArray[np.uint8], path: str | Path, dots_per_inch: float) -> None:
    """Write a grey picture as PNG; the file exists whole or not at all.

    Parameters
    ----------
    picture : ndarray, (H, W), uint8
    path : str or Path
    dots_per_inch : float
        That it is to be printed with.

    Raises
    ------
    InputError
        It cannot be written there.
    """
    path, per_metre = Path(path), round(dots_per_inch / _INCH)
    with quiet_opencv() as cv2:
        _, encoded = cv2.imencode(".png", picture)
    plain = encoded.tobytes()
    size = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    chunk = struct.pack(">I", len(size) - 4) + size + struct.pack(">I", zlib.crc32(size))
    with (
        new_file(path) as descriptor,
        plainly(f"{path} could not be written", MAKE_ROOM),
        os.fdopen(descriptor, "wb", closefd=False) as file,
    ):
        file.write(plain[:_HEAD] + chunk + plain[_HEAD:])
