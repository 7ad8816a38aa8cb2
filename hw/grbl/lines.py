"""From bytes to lines, and from lines to the controller's small buffer."""

from __future__ import annotations

from collections import deque

from mirrorskin.hw.grbl.replies import LONGEST

BUFFER = 128
"""Bytes of a line or of several that a controller keeps while it works, unless it says otherwise."""

_WINDOW = 1.0  # seconds over which noise is counted
_BEARABLE = 256  # bytes of it


class Splitter:
    """Cuts what arrives into lines; each knows when its first byte came."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._began = 0.0

    def feed(self, data: bytes, now: float) -> list[tuple[bytes, float]]:
        """Return the lines that `data` completes, and when each began; overlong ones come in pieces."""
        found: list[tuple[bytes, float]] = []
        *whole, rest = data.replace(b"\r", b"\n").split(b"\n")
        for part in whole:
            began = self._began if self._rest else now
            found.append((bytes(self._rest + part), began))
            self._rest.clear()
        if rest and not self._rest:
            self._began = now
        self._rest += rest
        if len(self._rest) > LONGEST:
            found.append((bytes(self._rest), self._began))
            self._rest.clear()
        return [(line, began) for line, began in found if line]


class Noise:
    """Counts what cannot be understood: a little of it is borne.

    Attributes
    ----------
    total : int
        All bytes of it.
    """

    def __init__(self) -> None:
        self.total = 0
        self._heard: deque[tuple[float, int]] = deque()
        self._recent = 0

    def add(self, size: int, now: float) -> bool:
        """Note so many bytes of noise; return whether it is too much within a second."""
        self._heard.append((now, size))
        self.total += size
        self._recent += size
        while self._heard[0][0] < now - _WINDOW:
            self._recent -= self._heard.popleft()[1]
        return self._recent > _BEARABLE


class Window:
    """Character counting: sends ahead as many lines as the controller's buffer holds, and no byte more.

    Attributes
    ----------
    size : int
        Bytes of the controller's buffer.
    done : int
        How many lines were answered.
    """

    def __init__(self, size: int = BUFFER) -> None:
        self.size = size
        self.done = 0
        self._waiting: deque[bytes] = deque()
        self._sent: deque[bytes] = deque()
        self._filled = 0

    @property
    def busy(self) -> bool:
        """Whether any line waits or is unanswered."""
        return bool(self._waiting or self._sent)

    @property
    def unanswered(self) -> int:
        """Bytes that may lie in the controller's buffer."""
        return self._filled

    def add(self, line: str) -> int:
        """Let a line wait for its turn; return the value of `done` once it is answered.

        Raises
        ------
        ValueError
            It is longer than the buffer.
        """
        data = line.encode("ascii") + b"\n"
        if len(data) > self.size:
            raise ValueError(f"a line of {len(data)} bytes does not fit a buffer of {self.size}")
        self._waiting.append(data)
        return self.done + len(self._sent) + len(self._waiting)

    def next(self) -> bytes | None:
        """Return the next line, to be sent now, if the buffer has room for it."""
        if not self._waiting or self._filled + len(self._waiting[0]) > self.size:
            return None
        data = self._waiting.popleft()
        self._sent.append(data)
        self._filled += len(data)
        return data

    def answer(self) -> str | None:
        """Note that the oldest line sent was answered, and return it; None if none was sent."""
        if not self._sent:
            return None
        data = self._sent.popleft()
        self._filled -= len(data)
        self.done += 1
        return data.decode("ascii").strip()

    def clear(self) -> None:
        """Forget all lines: the controller was reset."""
        self._waiting.clear()
        self._sent.clear()
        self._filled = 0
