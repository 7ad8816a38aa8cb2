"""What a benchmark found, and how it is told."""

from __future__ import annotations

from dataclasses import dataclass

from mirrorskin.bench.harness import Measured


@dataclass(frozen=True, slots=True)
class Row:
    """One work of a case.

    Attributes
    ----------
    name : str
    measured : Measured
    bytes : int
        That a turn must move: for the onset the frames, each once, and nothing else; for axial rotation the
        maps that are asked for besides. 0 where none are.
    frames : int
        That a turn handles; 0 where it handles no frames.
    operations : int
        Multiply-adds of a turn, where they are what is measured.
    """

    name: str
    measured: Measured
    bytes: int
    frames: int = 0
    operations: int = 0

    @property
    def bandwidth(self) -> float:
        """Bytes per second by the host's clock."""
        return self.bytes / self.measured.wall.median

    @property
    def kernel_bandwidth(self) -> float:
        """Bytes per second by the device's account of its kernels; NaN where none ran."""
        return self.bytes / (self.measured.kernel or float("nan"))


@dataclass(frozen=True, slots=True)
class Target:
    """One aim of a case, and whether it was reached.

    Attributes
    ----------
    what : str
        That is measured: ``file to result, warm``.
    bound, measured : str
        With their units, as people read them: ``at most 1.25 times the read``, ``1.17 times``.
    met : bool
    """

    what: str
    bound: str
    measured: str
    met: bool


@dataclass(frozen=True, slots=True)
class Case:
    """All works on one stack.

    Attributes
    ----------
    name, title : str
    rows : list of Row
        First the limit of which the others are a share. Empty where only `targets` are told.
    absent : dict of str
        Peers that were not run, and why.
    notes : tuple of str
        What else was found.
    targets : tuple of Target
        What was aimed at.
    """

    name: str
    title: str
    rows: list[Row]
    absent: dict[str, str]
    notes: tuple[str, ...] = ()
    targets: tuple[Target, ...] = ()

    def share(self, row: Row) -> float:
        """Return a work's bandwidth as a share of the limit's, both by the host's clock; NaN without one."""
        limit = self.rows[0].bandwidth
        return row.bandwidth / limit if limit else float("nan")

    def kernel_share(self, row: Row) -> float:
        """Return the same share by the device's account of its kernels; NaN where none ran."""
        limit = self.rows[0].kernel_bandwidth
        return row.kernel_bandwidth / limit if limit else float("nan")
