"""A stage behind GRBL: the serial line, its words, and the moves."""

from mirrorskin.hw.grbl.stage import GrblStage

__all__ = ["GrblStage"]
