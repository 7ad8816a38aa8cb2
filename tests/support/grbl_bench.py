"""An emulated controller on a table: a clock that a test turns, lines in, lines out."""

from __future__ import annotations

from typing import Any

from mirrorskin.hw.emulator.port import GrblMachine


class Bench:
    def __init__(self, settings: dict[int, float] | None = None, **options: Any) -> None:
        self.now = 1000.0
        self.machine = GrblMachine(settings, clock=lambda: self.now, **options)
        self.greeting = self.hear()

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def hear(self) -> list[str]:
        return self.machine.take().decode("ascii").splitlines()

    def write(self, text: str | bytes) -> None:
        self.machine.receive(text.encode("ascii") if isinstance(text, str) else text)

    def send(self, *lines: str) -> list[str]:
        """Send lines, give each the time to be read, and return what is said to the last."""
        heard: list[str] = []
        for line in lines:
            self.write(line + "\n")
            self.wait(0.0015)
            heard = self.hear()
        return heard

    def until_rest(self) -> float:
        """Let the time pass until nothing is due any more; return how long it took."""
        began = self.now
        while (due := self.machine.next_event()) < float("inf"):
            self.now = max(self.now, due)
        return self.now - began

    def place(self, at: float | None = None) -> tuple[float, ...]:
        return tuple(self.machine.position(at).values())

    def status(self) -> dict[str, str]:
        """Ask for a report; the state is under ""."""
        self.hear()
        self.write("?")
        (line,) = self.hear()
        assert line.startswith("<")
        assert line.endswith(">")
        state, *fields = line[1:-1].split("|")
        return {"": state} | dict(field.split(":", 1) for field in fields)
