"""Measurements: what memory can give, what we reach, what others reach, in one run."""

from mirrorskin.bench.harness import Timing, take_turns
from mirrorskin.bench.onset import Row, run_onset

__all__ = ["Row", "Timing", "run_onset", "take_turns"]
