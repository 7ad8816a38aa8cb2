"""The arithmetic of operations alone: without checks of the frames, which made-up frames would not pass."""

from itertools import pairwise

from mirrorskin.engine import ChangePoint, Onset, Run
from mirrorskin.engine.base.operation import Plan
from mirrorskin.engine.base.sources import ArraySource


class Parts(ArraySource):
    """Frames in memory that are read in parts, which end at cuts."""

    def __init__(self, frames, operation, positions, cuts):
        super().__init__(frames, operation, positions)
        self._parts = {start: stop - start for start, stop in pairwise([0, *cuts, len(frames)])}

    def read_in_place(self, limit):
        return super().read_in_place(min(limit, self._parts.get(self._next, limit)))


def bare_run(operation):
    """Return a run of an operation without its checks, for a loop of one's own."""
    return Run(Plan(operation, checked=False))


def bare(operation, frames, cuts=(), **positions):
    """Return the maps of frames that are read in parts, without checks."""
    cuts = sorted({int(edge) for edge in cuts if 0 < edge < len(frames)})
    return Run(Plan(operation, checked=False), Parts(frames, operation, positions, cuts)).complete()


def ready(operation, frames, travel):
    """Return a run that is prepared for frames of a press."""
    return Run(Plan(operation, checked=False), ArraySource(frames, operation, {"travel": travel}))


def find_onset(frames, travel, **options):
    return bare(Onset(**options), frames, travel=travel)


def find_change_point(frames, travel, **options):
    return bare(ChangePoint(**options), frames, travel=travel)
