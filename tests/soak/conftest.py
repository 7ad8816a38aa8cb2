"""Recordings, the results of an undisturbed batch, and the table of disturbances."""

from __future__ import annotations

import os

import pytest
import soak

from mirrorskin.engine.batch.jobs import Plan, make_jobs
from mirrorskin.engine.batch.local import default_devices, run_local


@pytest.fixture(scope="session")
def recordings(tmp_path_factory):
    return soak.make_recordings(tmp_path_factory.mktemp("recordings"))


@pytest.fixture(scope="session")
def undisturbed(recordings, tmp_path_factory):
    """All data of the results of a batch that nobody disturbs."""
    folder = tmp_path_factory.mktemp("undisturbed")
    outcomes = list(run_local(make_jobs(recordings, folder), Plan(), default_devices()))
    assert {outcome.state for outcome in outcomes} == {"done"}
    return soak.all_data(folder)


def pytest_terminal_summary(terminalreporter):
    if os.environ.get("MIRRORSKIN_SOAK"):
        terminalreporter.section(f"soak, MIRRORSKIN_SOAK_SEED={os.environ['MIRRORSKIN_SOAK_SEED']}")
        for line in soak.table():
            terminalreporter.write_line(line)
