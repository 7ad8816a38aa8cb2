"""Opening what the controller is plugged into."""

from __future__ import annotations

import errno
import os
from typing import Protocol

import serial

from mirrorskin.io import InputError

SLICE = 0.02
"""Longest time that a read waits, seconds: how finely a silence is measured."""

_WRITE = 0.25  # seconds after which a line that takes nothing more is broken
_REMEDIES = {
    errno.ENOENT: "there is no such port; plug the controller in, or correct the rig file's port",
    errno.ENODEV: "there is no such port; plug the controller in, or correct the rig file's port",
    errno.ENXIO: "there is no such port; plug the controller in, or correct the rig file's port",
    errno.EACCES: "no permission to open it; join the group that owns it (dialout, uucp)",
    errno.EBUSY: "another program uses it; close that first",
    errno.EAGAIN: "another program uses it; close that first",
}


class Port(Protocol):
    """What of a serial port is used: pyserial's, or anything alike."""

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""

    def read(self, size: int = 1, /) -> bytes:
        """Wait for so many bytes, `SLICE` seconds at most, and return what came."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def close(self) -> None:
        """Let the port go."""


def open_port(url: str, baud: int, name: str) -> Port:
    """Open a serial port, or what a URL of pyserial names, for us alone.

    Parameters
    ----------
    url : str
        Such as ``/dev/ttyUSB0``, ``socket://host:port`` or ``rfc2217://host:port``.
    baud : int
        Bits per second.
    name : str
        What to call the stage in messages.

    Returns
    -------
    Port
        Its reads wait `SLICE` seconds at most.

    Raises
    ------
    InputError
        There is no such port, it is in use, or it cannot be opened.
    """
    try:
        port = serial.serial_for_url(url, baud, timeout=SLICE, do_not_open=True)
        if os.name == "posix":
            port.exclusive = True
        if not url.lower().startswith("rfc2217:"):  # which knows no such limit
            port.write_timeout = _WRITE
        port.open()
    except (OSError, ValueError) as error:
        known = _REMEDIES.get(getattr(error, "errno", None) or 0)
        raise InputError(f"{name}: {known or f'cannot be opened ({error}); correct the rig file'}") from error
    opened: Port = port
    return opened


def close_port(port: Port) -> None:
    """Close a port, also one that is gone."""
    socket = getattr(port, "_socket", None)  # pyserial forgets it where the other side has left
    try:
        port.close()
        if socket is not None:
            socket.close()
    except Exception:  # pyserial raises many kinds, and there is nothing left to do
        return
