"""Common parts of the tests of hardware: stages on simulated time."""

import pytest
from scripted_grbl import ScriptedGrbl, stage_settings

from mirrorskin.hw.stages.grbl import GrblStage


@pytest.fixture
def opened(clock):
    """Open a GRBL stage on a scripted port, return both, and close it in the end."""
    stages = []

    def open_stage(port=None, *, unlock=False, **changes):
        port = ScriptedGrbl(clock) if port is None else port
        stages.append((GrblStage(stage_settings(**changes), port, unlock=unlock, clock=clock), port))
        return stages[-1]

    yield open_stage
    for stage, port in stages:
        stage.close()
        assert port.closed
