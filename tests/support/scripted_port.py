"""A serial port in memory with a script at its other end, on the clock of the test."""

from __future__ import annotations

import math

import serial

from mirrorskin.hw.stages.report_times import SLICE


class ScriptedPort:
    """Stands in for an open port; a subclass is the machine behind it.

    It may be ``silent``, or ``gone`` as when its plug is pulled, and be told what to ``say``. As with
    `GrblLine`, ``heard`` and ``said`` may change any byte from the host and any reply, by their numbers.
    """

    timeout = SLICE

    def __init__(self, clock):
        self.clock = clock
        self.bytes = bytearray()  # all that was written
        self.silent = self.gone = self.closed = False
        self.heard = self.said = lambda number, what: what
        self._count = {"heard": 0, "said": 0}
        self._out, self._change = bytearray(), clock.condition()

    def take(self, data):
        """Take what was written."""
        raise NotImplementedError

    def advance(self):
        """Do what has become due, and return the seconds until the next thing is."""
        return math.inf

    @property
    def in_waiting(self):
        self._present()
        self.advance()
        return len(self._out)

    def read(self, size=1):
        end = self.clock.now() + self.timeout
        with self._change:
            while True:
                self._present()
                due, rest = self.advance(), end - self.clock.now()
                if self._out or rest <= 0:
                    data = bytes(self._out[:size])
                    del self._out[:size]
                    return data
                self._change.wait(min(due, rest))

    def write(self, data):
        self._present()
        self.advance()
        self.bytes += data
        self.take(b"".join(self._passed("heard", bytes([byte])) for byte in data))
        self.advance()
        self._wake()
        return len(data)

    def flush(self):
        pass

    def open(self):
        self.closed = False
        return self

    def close(self):
        self.closed = True

    def unplug(self):
        self.gone = True
        self._wake()

    def say(self, *lines):
        self.inject(b"".join(self._passed("said", f"{line}\r\n".encode("latin-1")) for line in lines))

    def inject(self, data):
        if not self.silent:
            self._out += data
            self._wake()

    def until(self, condition, seconds=60.0):
        """Let time pass until something is so, to a millisecond."""
        end = self.clock.now() + seconds
        while not condition():
            assert self.clock.now() < end, "it never came to be so"
            self.clock.sleep(0.001)

    def _passed(self, direction, what):
        self._count[direction] += 1
        return getattr(self, direction)(self._count[direction], what)

    def _present(self):
        if self.gone:
            raise serial.SerialException("device reports readiness to read but returned no data")
        if self.closed:
            raise TypeError("an integer is required")

    def _wake(self):
        with self._change:
            self._change.notify_all()
